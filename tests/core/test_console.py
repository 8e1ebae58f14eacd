"""No text from elsewhere steers the terminal: everything is printed in one place, which spells it out."""

import ast
import logging
from pathlib import Path

import pytest

import cadam3d
from cadam3d.commands.beginning import logged_to
from cadam3d.core import console

CLEARS = "\x1b[2J"  # clears the screen
PACKAGE = Path(cadam3d.__file__).parent


@pytest.mark.parametrize("letter", ["\x1b", "\r", "\b", "\x9b", "\x7f", "\u202e", "\u2028", "\udcff", "\0"])
def test_characters_that_a_terminal_obeys_are_spelled_out(letter):
    assert console.visible(f"a{letter}b") == f"a{ascii(letter)[1:-1]}b"


def test_words_of_all_languages_and_tables_stay_as_they_are():
    text = "ein Würfel\n\t立方体 🧊👨\u200d👩 \N{NO-BREAK SPACE}مكعب"
    assert console.visible(text) == text


def test_only_the_console_prints():
    # The plugins belong to other programs, which have no console of ours.
    files = {path for path in PACKAGE.rglob("*.py") if path.parent.name != "plugins"}
    printing = {
        path.name
        for path in files
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert printing == {"console.py"}


def test_results_errors_and_messages_are_spelled_out(capsys):
    for tell in (console.show, console.complain, console.say):
        tell(CLEARS)
    printed = capsys.readouterr()
    assert printed.out == "\\x1b[2J\n"
    assert printed.err == "cadam3d: \\x1b[2J\n\\x1b[2J\n"


def test_a_second_line_of_an_error_is_no_message_of_ours(capsys):
    console.complain("no\ncadam3d: type this")
    assert capsys.readouterr().err == "cadam3d: no\n  cadam3d: type this\n"


def test_the_log_of_a_run_is_spelled_out(tmp_path):
    with logged_to(tmp_path / "train.log"):
        logging.getLogger("cadam3d.test").info("%s", CLEARS)
    assert (tmp_path / "train.log").read_text(encoding="utf-8").endswith("\\x1b[2J\n")


@pytest.mark.parametrize(("place", "target"), [("asset.ply", f"/nowhere{CLEARS}"), (f"{CLEARS}/link", "/")])
def test_the_names_in_a_strangers_folder_do_not_reach_the_terminal(place, target, type_line, tmp_path):
    (tmp_path / "run" / place).parent.mkdir(parents=True)
    (tmp_path / "run" / place).symlink_to(target)
    ended = type_line("eval", "run=run")
    assert ended.code == 1
    assert "\x1b" not in ended.err
    assert "\\x1b[2J" in ended.err
