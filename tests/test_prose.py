"""The language of the project: words that a native engineer would stop at appear nowhere that people read."""

import io
import re
import subprocess
import tokenize
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent
# Words that make persons of things, and phrases that no engineer says to a colleague.
ODD = re.compile(
    r"\b(?:whom|nobody|everybody|whoever|himself|herself|by lot|dear to|what stands in|mend(?:s|ed|ing)?"
    r"|(?:is|are|was|were) told|(?:be|been|was|were) had|(?:lies|lie|lay) (?:in|on) the)\b",
    re.IGNORECASE,
)
# Old values of densifier.reset, which are refused; the changelog and the test of the refusal name them.
OLD_VALUES = re.compile(r"reset=(?:everybody|nobody)|\"(?:everybody|nobody)\"")
PROSE = (".md", ".yaml", ".html", ".jinja", ".css", ".js", ".toml", ".txt", ".svg")
KERNELS = (".cpp", ".h", ".cu", ".cuh")


def tracked_files() -> list[Path]:
    """Return the files of the repository as git lists them, or as they are on disk outside a checkout."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return [path for name in done.stdout.split("\n") if (path := REPOSITORY / name).is_file()]
    folders = ("cadam3d", "configs", "docs", "scripts", "tests")
    return [path for folder in folders for path in (REPOSITORY / folder).rglob("*") if path.is_file()]


def readable(path: Path) -> str:
    """Return what people read in a file: of Python its comments, strings and names, else everything."""
    text = path.read_text(encoding="utf-8")
    return in_words(text) if path.suffix == ".py" else text


def in_words(source: str) -> str:
    """Return Python source with names such as ``test_nobody_waits`` split into words."""
    lines = source.splitlines(keepends=True)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME and "_" in token.string:
            (row, start), (_, end) = token.start, token.end
            lines[row - 1] = lines[row - 1][:start] + token.string.replace("_", " ") + lines[row - 1][end:]
    return "".join(lines)


def odd_lines(text: str) -> list[str]:
    """Return the lines with an odd word, each with its number."""
    lines = enumerate(text.splitlines(), 1)
    return [f"{number}: {line.strip()}" for number, line in lines if ODD.search(OLD_VALUES.sub("", line))]


SUFFIXES = (".py", *PROSE, *KERNELS)
FILES = [
    path
    for path in tracked_files()
    if (path.suffix in SUFFIXES or path.name == "Makefile") and path != Path(__file__)
]


def test_the_project_is_written_in_plain_english():
    assert len(FILES) > 300, "the files of the project were not found"
    found = {str(path.relative_to(REPOSITORY)): odd_lines(readable(path)) for path in FILES}
    assert not {name: lines for name, lines in found.items() if lines}


@pytest.mark.parametrize(
    "line",
    [
        "# the Gaussians whom refine prunes",
        "def test_nobody_waits(): ...",
        '"""Growth by lot."""',
        'raise UserError("the file lies in the folder")',
    ],
)
def test_an_odd_word_is_noticed_in_comments_names_and_strings(line):
    assert odd_lines(in_words(line + "\n"))


def test_ordinary_words_are_not_mistaken_for_odd_ones():
    text = "recommended amendments; a slot machine; everything that the user had; a parallel lane"
    assert not odd_lines(text)


DOCSTRING_NOUN = re.compile(r'^\s+"""(What|How|Whether|Who|Where|Why)\b', re.MULTILINE)


def test_docstrings_of_functions_begin_with_a_verb():
    """``What is shown`` says less than ``Return the pictures that are shown``."""
    found = {
        f"{path.relative_to(REPOSITORY)}": DOCSTRING_NOUN.findall(path.read_text(encoding="utf-8"))
        for path in (REPOSITORY / "cadam3d").rglob("*.py")
    }
    assert not {name: words for name, words in found.items() if words}
