"""The documentation as a site: it builds without a warning, and requests nothing from other hosts."""

import html
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).parent.parent
# An element or a style that loads something, with an address on another host.
REQUEST = re.compile(
    r"<(?!a\b)\w+\b[^>]*?\b(?:src|href|srcset|data|action|poster)=[\"']?(?:https?:)?//[^\s>]*"
    r"|(?:url\(|@import)\s*[\"']?(?:https?:)?//[^\s)]*"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Build the site strictly, as ``make docs`` does: MkDocs ends with an error if there was a warning.

    With ``--quiet``, it would count no warnings.
    """
    for module in ("mkdocs", "material", "mkdocstrings_handlers.python"):
        pytest.importorskip(module)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages():
    """Return the module with the hooks of MkDocs."""
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location("pages", REPOSITORY / "scripts/site/pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def texts(site: Path, *suffixes: str) -> dict[str, str]:
    """Return the files of the site with one of the suffixes: path to content."""
    files = [path for path in site.rglob("*.*") if path.suffix in suffixes]
    return {str(path.relative_to(site)): path.read_text(encoding="utf-8") for path in files}


@pytest.mark.slow
def test_every_page_is_a_page_of_the_site(site):
    docs = [path.relative_to(REPOSITORY / "docs") for path in (REPOSITORY / "docs").rglob("*.*")]
    made = {str(path.with_suffix(".html")) for path in docs if path.suffix in (".md", ".ipynb")}
    made |= {"changelog.html", "contributing.html", "security.html"}
    assert made <= set(texts(site, ".html"))


@pytest.mark.slow
def test_the_site_requests_nothing_from_another_host(site):
    files = texts(site, ".html", ".css")
    assert len(files) > 30
    assert not {name: found for name, text in files.items() if (found := REQUEST.findall(text))}
    # The theme would load these from another host for pages that need them.
    assert not [name for name, text in files.items() if 'class="mermaid"' in text or "MathJax" in text]


@pytest.mark.slow
def test_the_reference_has_shapes_comments_of_fields_and_docstrings(site):
    page = (site / "reference/densifiers.html").read_text(encoding="utf-8")
    words = html.unescape(re.sub(r"<[^>]*>", "", page)).split()
    plain = " ".join(words).replace("( ", "(").replace(" )", ")")
    assert 'means Float[Tensor, "n 3"] dLoss/dmeans, loss per world unit: CAdam\'s evidence' in plain
    assert 'select(state: State, step: int, generator: Generator) -> Bool[Tensor, "n"]' in plain
    assert "Return the mask of Gaussians to grow: the one real difference between densifiers." in plain


@pytest.mark.parametrize("tag", ['<script src="https://a.example/x.js">', "@import '//a.example/x.css'"])
def test_a_request_is_noticed(tag):
    assert REQUEST.search(tag)


class Page:
    """What the hooks read of a page."""

    def __init__(self, uri: str, source: Path):
        self.file = self
        self.src_uri, self.abs_src_path, self.is_homepage = uri, str(source), False


@pytest.mark.parametrize(
    ("page", "source", "link", "shown"),
    [
        ("quickstart.md", "docs/quickstart.md", "[a](priors.md#memory)", "[a](priors.md#memory)"),
        ("quickstart.md", "docs/quickstart.md", "[a](../SECURITY.md#promise)", "[a](security.md#promise)"),
        ("quickstart.md", "docs/quickstart.md", "[a](../README.md)", "[a](index.md)"),
        ("quickstart.md", "docs/quickstart.md", "see [`a.py`](../tests/test_site.py).", "see `a.py`."),
        ("quickstart.md", "docs/quickstart.md", "![a](images/logo.svg)", "![a](images/logo.svg)"),
        ("quickstart.md", "docs/quickstart.md", "[a](gone.md)", "[a](gone.md)"),  # MkDocs reports it
        ("contributing.md", "CONTRIBUTING.md", "[a](docs/priors.md#memory)", "[a](priors.md#memory)"),
        ("contributing.md", "CONTRIBUTING.md", "[a](CHANGELOG.md)", "[a](changelog.md)"),
        ("reference/core.md", "docs/reference/core.md", "[a](../../SECURITY.md)", "[a](../security.md)"),
    ],
)
def test_a_link_of_a_code_host_leads_to_a_page_of_the_site(pages, page, source, link, shown):
    assert pages.on_page_markdown(link, Page(page, REPOSITORY / source), None, None) == shown


def test_a_notebook_becomes_text_code_and_outputs(pages):
    code = {"cell_type": "code", "source": ["1 + 1"]}
    printed = {"output_type": "stream", "text": ["\x1b[31ma < b\x1b[0m\n"]}
    picture = {"data": {"image/png": "AAAA\n", "text/plain": "<Figure>"}}
    viewer = {"data": {"text/html": ["<iframe></iframe>"], "text/plain": "Asset"}}
    notebook = {
        "cells": [
            {"cell_type": "markdown", "source": ["# Title\n", "text"]},
            {**code, "outputs": [printed, picture, viewer]},
        ]
    }
    assert list(pages.cells(notebook)) == [
        "# Title\ntext",
        "```python\n1 + 1\n```",
        '<pre class="output"><code>a &lt; b</code></pre>',
        '<img alt="output" src="data:image/png;base64,AAAA">',
        "<div>\n<iframe></iframe>\n</div>",
    ]


def test_the_two_citations_agree():
    cff = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
    page = (REPOSITORY / "docs/index.md").read_text(encoding="utf-8")
    bibtex = re.sub(r"[{}]", "", page)
    paper = cff["preferred-citation"]
    names = " and ".join(f"{each['family-names']}, {each['given-names']}" for each in paper["authors"])
    assert f"author    = {names}," in bibtex
    for key in ("title", "doi", "isbn", "year"):
        assert str(paper[key]) in bibtex
    assert " ".join(paper["collection-title"].split()) in " ".join(bibtex.split())
