"""Every example in the documentation works: command lines in real shells, settings, YAML and Python."""

import re
import runpy
import shlex
import shutil
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from declarations import declared

from cadam3d import cli
from cadam3d.io.jsonl import write_json
from cadam3d.sweep import plan
from cadam3d.sweep.grid import Job, expand

REPOSITORY = Path(__file__).parent.parent
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CHANGELOG.md",
    REPOSITORY / "CONTRIBUTING.md",
    *sorted((REPOSITORY / "docs").rglob("*.md")),
]
PROGRAMS = (
    "cadam3d",
    "pip",
    "make",
    "python",
    "python3",
    "git",
    "hf",
    "ruff",
    "pyright",
    "compute-sanitizer",
)
CALL = rf"(?:\w+=\S* )*(?:\.venv/bin/)?(?:{'|'.join(PROGRAMS)}) "
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^ {4}\S.*$", re.MULTILINE)
NAMED_BLOCK = re.compile(
    r"`([\w./]+\.(?:py|yaml|toml|txt))`[^`\n]*:\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL
)

# This program only writes the words of its command line to the file RECORD.
STAND_IN = """#!/bin/sh
{ for word in "${0##*/}" "$@"; do printf '%s\\0' "$word"; done; printf '\\036\\0'; } >> "$RECORD"
"""


@dataclass(frozen=True)
class Line:
    """A command line that a page shows."""

    page: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}: {self.text}"


def lines_of(page: Path) -> list[Line]:
    """Return the command lines in the blocks (fenced or indented) and in the prose of a page."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = [body for language, body in FENCE.findall(text) if language in ("", "sh", "bash")]
    blocks += INDENTED.findall(FENCE.sub("", text))
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    return [Line(page.name, line) for line in [*lines, *spans_of(page)] if re.match(CALL, line)]


def spans_of(page: Path) -> list[str]:
    """Return the pieces of code in the prose of a page."""
    prose = INDENTED.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))
    paragraphs = re.split(r"\n\s*\n", prose)
    return [" ".join(span.split()) for text in paragraphs for span in re.findall(r"`([^`]+)`", text)]


def help_lines() -> list[Line]:
    """Return the command lines in the help of the program and in the comments of the YAML files."""
    found = [Line("cadam3d --help", example) for _, example in cli.COMMANDS.values()]
    for file in sorted((REPOSITORY / "configs").rglob("*.yaml")):
        text = file.read_text(encoding="utf-8")
        shown = re.findall(rf"^[\s#]*(cadam3d (?:{'|'.join(cli.COMMANDS)})\b.*)$", text, re.MULTILINE)
        found += [Line(file.name, line) for line in shown]
    return found


LINES = list(dict.fromkeys([line for page in PAGES for line in lines_of(page)] + help_lines()))
DISTINCT = list({line.text: line for line in LINES}.values())


def named_blocks(page: Path) -> dict[str, str]:
    """Return the files that the reader of a page writes: name to content."""
    return dict(NAMED_BLOCK.findall(page.read_text(encoding="utf-8")))


@cache
def split(line: str, place: Path) -> list[list[str]]:
    """Run ``line`` in a shell with a stand-in for every program, and return the words of each call."""
    record = place / "record"
    record.unlink(missing_ok=True)
    environment = {"PATH": str(place / "bin"), "HOME": str(place), "RECORD": str(record)}
    command = [shutil.which("bash"), "--noprofile", "--norc", "-c", line]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{line}\n{done.stderr}"
    calls = record.read_text(encoding="utf-8").split("\036\0")[:-1] if record.is_file() else []
    return [call.split("\0")[:-1] for call in calls]


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Return a folder with a run, a sweep, and the files that a reader writes, as the pages assume it."""
    place = tmp_path_factory.mktemp("place")
    for folder in ("bin", ".venv/bin"):
        (place / folder).mkdir(parents=True)
        for program in PROGRAMS:
            stand_in = place / folder / program
            stand_in.write_text(STAND_IN, encoding="utf-8")
            stand_in.chmod(stand_in.stat().st_mode | stat.S_IXUSR)
    (place / ".venv/bin/activate").touch()
    (place / "cadam3d").mkdir()
    run = place / "outputs" / "latest"
    (run / ".hydra").mkdir(parents=True)
    (run / ".hydra/overrides.yaml").write_text("- prompt='a cube'\n", encoding="utf-8")
    (run / "config.yaml").touch()
    write_sweep(place / "multirun" / "mine")
    for page in PAGES:
        for name, content in named_blocks(page).items():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(content, encoding="utf-8")
    return place


def write_sweep(folder: Path) -> None:
    """Write the files of a sweep of two densifiers over three prompts that tables are made from."""
    jobs = []
    for prompt in ("a cube", "a torus", "a cone"):
        for arm, count, psnr in (("baseline", 20000, 22.0), ("cadam", 1000, 22.5)):
            job = folder / f"{arm}_{prompt.split()[1]}"
            overrides = [f"densifier={arm}", f"prompt='{prompt}'", "seed=0"]
            swept = {"densifier": arm, "prompt": prompt, "seed": 0}
            jobs.append({"arm": arm, "name": job.name, "overrides": overrides, "swept": swept})
            facts = {"prompt": prompt, "seed": 0, "outcome": "finished", "warnings": [], "steps": 600}
            counts = {"num_gaussians": count, "num_gaussians_initial": 300, "asset_bytes": 68 * count}
            numbers = {"psnr": psnr, "ssim": 0.9, "seconds": 1.0}
            write_json(job / "summary.json", declared({**facts, **counts, **numbers}))
            (job / ".hydra").mkdir()
            (job / ".hydra/overrides.yaml").write_text(yaml.safe_dump(overrides), encoding="utf-8")
    write_json(folder / "jobs.json", {"cwd": str(folder), "flags": [], "threads": None, "jobs": jobs})


def without_missing_launcher(words: list[str]) -> list[str]:
    """Leave out a launcher that is not installed, and its settings. Only joblib is always installed."""
    name = next((word.partition("=")[2] for word in words if word.startswith("launcher=")), "joblib")
    if name == "joblib" or find_spec(f"hydra_plugins.hydra_{name}_launcher"):
        return words
    return [word for word in words if not word.startswith("launcher")]


def some_jobs(*arguments: Any) -> list[Job]:
    """Return two jobs of a sweep. The tests of the settings compose every arm of every grid."""
    jobs = expand(*arguments)
    return [jobs[0], *jobs[1:][-1:]]


@pytest.mark.parametrize("line", DISTINCT, ids=str)
def test_a_documented_line_composes(line, place, monkeypatch, capsys):
    """Each page has lines that can be pasted: an interactive zsh passes a comment on to the command."""
    monkeypatch.setattr(plan, "expand", some_jobs)
    assert shlex.split(line.text, comments=True) == shlex.split(line.text)
    calls = split(line.text, place)
    assert calls, "no program was called"
    for words in calls:
        if words[0] == "python":
            # A line that begins with ../ runs a script of another commit, checked out beside this one.
            files = [word for word in words if word.endswith(".py") or word.startswith("tests/")]
            assert all(file.startswith("../") or (REPOSITORY / file).exists() for file in files)
        if words[0] != "cadam3d" or (len(words) == 2 and words[1] != "doctor"):
            continue  # another program, or only the name of a command
        is_only_printed = words[1] not in cli.COMMANDS or "--help" in words or "--cfg" in words
        flags = [] if is_only_printed else ["--cfg", "job"]
        monkeypatch.chdir(place)
        monkeypatch.setattr(sys, "argv", [*without_missing_launcher(words), *flags])
        # A thread halves the time. Composing recurses deeply, and at the depth of a test CPython 3.11 would
        # allocate and free the next piece of its stack again and again.
        with pytest.raises(SystemExit) as ended, ThreadPoolExecutor(1) as thread:
            thread.submit(cli.main).result()
        assert not ended.value.code, capsys.readouterr().err


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_python_of_a_page_runs(page, place, monkeypatch):
    """Run the scripts of a page. The blocks that belong to a named file are run by test_extending."""
    text = NAMED_BLOCK.sub("", page.read_text(encoding="utf-8"))
    monkeypatch.chdir(place)
    for number, (language, body) in enumerate(FENCE.findall(text)):
        if language == "python":
            script = place / f"{page.stem}_{number}.py"
            script.write_text(body, encoding="utf-8")
            runpy.run_path(str(script))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_yaml_of_a_page_names_its_file(page):
    """With a name, the test of command lines can write the file, so that the lines compose with it."""
    text = NAMED_BLOCK.sub("", page.read_text(encoding="utf-8"))
    assert not [body for language, body in FENCE.findall(text) if language == "yaml"]


def test_a_user_reads_at_most_fourteen_pages():
    pages = sorted(path.stem for path in (REPOSITORY / "docs").glob("*.md") if path.stem != "components")
    assert len(pages) <= 14, pages


def test_every_note_names_its_date_and_its_commit():
    for page in (REPOSITORY / "docs" / "notes").glob("*.md"):
        dated = page.read_text(encoding="utf-8").splitlines()[2]
        assert re.search(r"\b20\d\d\b.*\b[0-9a-f]{7}\b", dated), page.name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_files_and_headings_lead_somewhere(page):
    links = re.findall(r"\]\((?!https?://|mailto:)([^)#]*)#?([^)]*)\)", page.read_text(encoding="utf-8"))
    for file, heading in links:
        target = page.parent / file if file else page
        assert target.exists(), file
        assert not heading or heading in headings_of(target), f"{file}#{heading}"


def headings_of(page: Path) -> list[str]:
    """Return the headings of a page in the form in which links name them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]


def test_quoted_messages_are_in_the_source():
    """Look up the quoted messages of troubleshooting.md; each piece between dots must be in the source."""
    page = (REPOSITORY / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    source = "".join(file.read_text(encoding="utf-8") for file in (REPOSITORY / "cadam3d").rglob("*.py"))
    quotes = re.findall(r'^\*\*"(.+?)"\.\*\*', page, re.MULTILINE)
    assert quotes
    assert not [quote for quote in quotes if any(piece.strip() not in source for piece in quote.split("..."))]


def test_documented_files_exist():
    """Look up all paths in backticks that begin with a folder of the repository."""
    missing = []
    for page in PAGES:
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for path in re.findall(r"`((?:cadam3d|configs|docs|scripts|tests)/[\w./-]+\.\w+)`", text):
            if "mine" not in path and not (REPOSITORY / path).exists():
                missing.append(f"{page.name}: {path}")
    assert not missing
