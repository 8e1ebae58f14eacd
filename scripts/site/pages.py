"""Hooks of MkDocs: pages from outside of docs/, links that work on the site too, and notebooks as pages.

``mkdocs.yml`` names this file. The pages in docs/ are written for a code host, where links are paths to files
of the repository. Here such a link becomes a link to the page that the site makes of the file.
"""

import html
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

REPOSITORY = Path(__file__).parent.parent.parent
DOCS = REPOSITORY / "docs"
# Files outside of docs/ that are pages of the site.
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
# A link or a picture with a path, possibly with an anchor.
LINK = re.compile(r"(!?\[[^\[\]]*\])\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")
MODULE = re.compile(r"^::: cadam3d\.(\S+)$", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside of docs/, and a page for each notebook beside the notebook itself."""
    for name, page in PAGES.items():
        if page not in files.src_uris:
            files.append(File.generated(config, page, abs_src_path=str(REPOSITORY / name)))
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            name = Path(file.src_uri).name
            download = f'<a href="{name}" download>Download this notebook</a>'
            text = "\n\n".join([*cells(json.loads(file.content_string)), download])
            page = file.src_uri.removesuffix(".ipynb") + ".md"
            files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page with links that lead to pages of the site, and with Markdown inside ``<details>``."""
    if page.is_homepage:
        page.meta["hide"] = ["navigation", "toc"]  # it has no neighbours, and is short
    origin = Path(page.file.abs_src_path or DOCS / page.file.src_uri)
    here = Path(page.file.src_uri).parent

    def link(found: re.Match[str]) -> str:
        text, path, anchor = found[1], found[2], found[3] or ""
        target = Path(os.path.normpath(origin.parent / path))
        if not target.is_relative_to(REPOSITORY) or not target.exists():
            uri = path  # MkDocs reports it
        elif target.is_relative_to(DOCS):
            name = re.sub(r"\.ipynb$", ".md", str(target.relative_to(DOCS)))
            uri = os.path.relpath(name, here)
        elif name := PAGES.get(str(target.relative_to(REPOSITORY))):
            uri = os.path.relpath(name, here)
        else:
            return text.lstrip("!")[1:-1]  # the site has no page for other files of the repository
        return f"{text}({uri}{anchor})"

    markdown = LINK.sub(link, markdown).replace("<details>", '<details markdown="1">')
    # The contents of a page of the reference name modules with their packages: prior.base, not base.
    return MODULE.sub(r"\g<0>\n    options: {toc_label: \1}", markdown)


def cells(notebook: dict[str, Any]) -> Iterator[str]:
    """Return the cells of a notebook as Markdown, each followed by its outputs."""
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            yield source
        elif cell["cell_type"] == "code" and source:
            yield f"```python\n{source}\n```"
            yield from map(shown, cell["outputs"])


def shown(output: dict[str, Any]) -> str:
    """Return an output of a cell as a part of a page: a picture or HTML if it has such a form, else text."""
    forms = output.get("data", {})
    if picture := forms.get("image/png"):
        return f'<img alt="output" src="data:image/png;base64,{"".join(picture).strip()}">'
    for form in ("image/svg+xml", "text/html"):
        if form in forms:
            return f"<div>\n{''.join(forms[form])}\n</div>"
    text = forms.get("text/plain") or output.get("text") or output.get("traceback") or ""
    plain = html.escape(re.sub(r"\x1b\[[0-9;]*m", "", "".join(text)).rstrip())
    return f'<pre class="output"><code>{plain}</code></pre>'
