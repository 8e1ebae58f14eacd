"""The language of the project: words that a native engineer would stop at appear nowhere that people read."""

import re
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent
# Words that make persons of things, and phrases that no engineer says to a colleague.
ODD = re.compile(
    r"(?:\b|_)(?:whom|nobody|everybody|whoever|by lot|dear to|what stands in|mend(?:s|ed|ing)?"
    r"|(?:is|are|was|were) told|(?:be|been|was|were) had|(?:lies|lie|lay) (?:in|on) the)(?:\b|_)",
    re.IGNORECASE,
)
# Old values of densifier.reset, which the changelog names.
OLD_VALUES = re.compile(r"reset=(?:everybody|nobody)|\"(?:everybody|nobody)\"")
DOCSTRING_NOUN = re.compile(r'^\s+"""(?:What|How|Whether|Who|Where|Why)\b', re.MULTILINE)
SUFFIXES = (".py", ".md", ".yaml", ".html", ".jinja", ".css", ".js", ".toml", ".cpp", ".h", ".cu", ".cuh")


def odd_lines(text: str) -> list[str]:
    """Return the lines with an odd word."""
    return [line.strip() for line in text.splitlines() if ODD.search(OLD_VALUES.sub("", line))]


def test_the_project_is_written_in_plain_english():
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("outside of a checkout")
    files = [REPOSITORY / name for name in done.stdout.splitlines() if name.endswith(SUFFIXES)]
    files = [path for path in files if path.is_file() and path != Path(__file__)]
    assert len(files) > 300, "the files of the project were not found"
    found = {path.name: odd_lines(path.read_text(encoding="utf-8")) for path in files}
    assert not {name: lines for name, lines in found.items() if lines}


@pytest.mark.parametrize("line", ["# the Gaussians whom refine prunes", "def test_nobody_waits(): ..."])
def test_an_odd_word_is_noticed(line):
    assert odd_lines(line)
    assert not odd_lines("recommended amendments; a slot machine; everything that the user had")


def test_docstrings_of_functions_begin_with_a_verb():
    """``What is shown`` says less than ``Return the pictures that are shown``."""
    sources = (REPOSITORY / "cadam3d").rglob("*.py")
    assert not [path for path in sources if DOCSTRING_NOUN.search(path.read_text(encoding="utf-8"))]
