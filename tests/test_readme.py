"""Every command line in the documentation is one that works: it parses and its configuration composes."""

import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from cadam3d import cli

REPOSITORY = Path(__file__).parent.parent
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
    *sorted((REPOSITORY / "docs").glob("*.md")),
]
PROGRAM = re.compile(r"^\s*(?:\$ )?(?:\.venv/bin/)?(cadam3d\s.*)$")


def lines_of(page: Path) -> list[str]:
    """The lines of code blocks (fenced or indented) that call the program, continued lines joined."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```[^\n]*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^ {4}\S.*$", text, re.MULTILINE)
    candidates = [line for block in blocks for line in block.splitlines()] + indented
    return [match.group(1) for line in candidates if (match := PROGRAM.match(line))]


COMMAND_LINES = [(page.name, line) for page in PAGES if page.is_file() for line in lines_of(page)]


def without_missing_launcher(words: list[str]) -> list[str]:
    """Launchers are plugins, of which only joblib's is sure to be installed: the rest of the line must do."""
    name = next((word.partition("=")[2] for word in words if word.startswith("launcher=")), "joblib")
    if name == "joblib" or find_spec(f"hydra_plugins.hydra_{name}_launcher"):
        return words
    return [word for word in words if not word.startswith("launcher")]


@pytest.fixture
def workplace(tmp_path, monkeypatch) -> Path:
    """A folder as the documentation assumes it, with a run and with a config folder of the user's own."""
    run = tmp_path / "outputs" / "latest"
    (run / ".hydra").mkdir(parents=True)
    (run / ".hydra" / "overrides.yaml").write_text("- prompt='a cube'\n", encoding="utf-8")
    (run / "config.yaml").touch()
    own = tmp_path / "myconfigs" / "densifier"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("_target_: mypackage.Mine\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("page", "line"), COMMAND_LINES, ids=[f"{p}: {line}" for p, line in COMMAND_LINES])
def test_a_documented_line_composes(page, line, workplace, monkeypatch, capsys):
    words = without_missing_launcher(shlex.split(line, comments=True))
    if len(words) > 1 and words[1] in cli.COMMANDS and "--help" not in words and "--cfg" not in words:
        words += ["--cfg", "job"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code, capsys.readouterr().err


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_the_line_that_the_help_shows_composes(command, workplace, monkeypatch, capsys):
    _, example = cli.COMMANDS[command]
    test_a_documented_line_composes("help", example, workplace, monkeypatch, capsys)


def test_the_readme_shows_the_two_commands():
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    assert "make demo" in text
    assert re.search(r'cadam3d train prompt="', text)


@pytest.mark.parametrize("page", [page for page in PAGES if page.is_file()], ids=lambda page: page.name)
def test_links_to_files_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\((?!https?://|#|mailto:)([^)#]+)(?:#[^)]*)?\)", text)
    assert not [target for target in targets if not (page.parent / target).exists()]


def test_documented_files_exist():
    """Paths in backticks that look like ours are real: documentation must not outlive what it describes."""
    missing = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8") if page.is_file() else ""
        text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
        for path in re.findall(r"`((?:cadam3d|configs|docs|scripts)/[\w./-]+\.\w+)`", text):
            if "mine" not in path and not (REPOSITORY / path).exists():
                missing.append(f"{page.name}: {path}")
    assert not missing
