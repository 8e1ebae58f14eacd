"""The help of a command lists all choices, that of an option all its settings, and lines fit the terminal."""

import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from cadam3d import cli
from cadam3d.core.errors import UserError
from cadam3d.settings.documentation import Library
from cadam3d.settings.help_page import help_text
from cadam3d.settings.options import config_dir

REPOSITORY = Path(__file__).parents[2]
LIBRARY = Library([config_dir()])
NO_FLAGS = Namespace(config_dir=None, config_path=None, config_name=None)


def page(*words: str, command: str = "train", flags: Namespace = NO_FLAGS) -> str:
    return help_text(command, words, flags)


def flat(text: str) -> str:
    return " ".join(text.split())


def test_the_page_of_a_command_lists_every_option_with_its_description():
    text = flat(page())
    for group in LIBRARY.groups("train"):
        assert f"{group.name}: {group.words}" in text
        for name in LIBRARY.options[group.name]:
            mark = "* " if name in group.chosen else ""
            assert f" {mark}{name} {LIBRARY.summary(group.name, name)}".rstrip() in text


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_the_page_of_a_command_lists_its_settings(command):
    text = page(command=command)
    about = LIBRARY.command(command)
    assert text.startswith(about.about[:20])
    for each in about.settings:
        assert f"\n  {each.key}{'=' if each.value else ''}{each.value}" in text
        assert flat(each.words) in flat(text)


def test_the_page_of_an_option_lists_its_settings():
    text = page("camera=orbit", "guidance=ism", "prompt='a cube'", "steps=7")
    for group, name in (("camera", "orbit"), ("guidance", "ism")):
        for each in LIBRARY.option(group, name).settings:
            assert each.key in text
            assert each.words in flat(text)
    assert "camera.fov_y_deg=[40.0,45.0]" in text
    assert "guidance.t_max: Linear(start=0.98, end=0.5, steps=${cadam3d.parts:10,12,${steps}})" in text
    assert "densifier" not in text.replace("densifier.tau_pos", "")


def test_the_page_of_a_variant_lists_what_it_changes():
    text = page("prior=sdxl")
    assert "Builds on prior=stable_diffusion and changes ids, size." in text
    assert "prior.size=1024" in text
    assert "prior.tiling=false" in text


def test_several_options_of_a_group_can_be_listed_at_once():
    text = page("metric=[fidelity,size]")
    assert "metric=fidelity" in text
    assert "metric=size" in text
    assert "It has no settings." in text


def test_the_name_of_a_group_lists_its_options():
    text = page("background")
    assert all(f" {name} " in text for name in LIBRARY.options["background"])
    assert "camera:" not in text


@pytest.mark.parametrize("columns", [40, 72, 200])
def test_lines_fit_into_the_terminal(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = page("camera", "guidance=ism").splitlines() + page().splitlines()
    prose = [line for line in lines if "=" not in line and "cadam3d" not in line]
    assert max(map(len, prose)) <= min(max(columns, 60), 120)


def test_options_of_a_user_folder_are_listed_too(tmp_path):
    (tmp_path / "densifier").mkdir()
    mine = tmp_path / "densifier" / "mine.yaml"
    mine.write_text("# Grow what I like.\n_target_: mine.Mine\nshare: 0.1 # in (0, 1)\n", encoding="utf-8")
    flags = Namespace(config_dir=str(tmp_path), config_path=None, config_name=None)
    assert "Grow what I like." in page(flags=flags)
    assert "densifier.share=0.1  in (0, 1)" in page("densifier=mine", flags=flags)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("densifier=cadamm",), r"got 'cadamm'. Try: cadam3d train --help densifier=cadam$"),
        (("densifer",), r"Try: cadam3d train --help densifier$"),
        (("densifier.tau_Q",), r"Try: cadam3d train --help densifier$"),
        (("grid=thresholds",), r"^'grid=thresholds': expected a group of cadam3d train "),
    ],
)
def test_the_message_for_an_unknown_name_suggests_a_similar_one(words, message):
    with pytest.raises(UserError, match=message):
        page(*words)


def test_a_config_that_does_not_exist_is_named():
    flags = Namespace(config_dir=None, config_path=None, config_name="mine")
    with pytest.raises(UserError, match=r"^mine\.yaml: expected this file in "):
        page(flags=flags)


def test_a_group_is_refused_by_a_command_without_groups():
    with pytest.raises(UserError, match=r"has no groups\. Try: cadam3d doctor --help"):
        page("camera", command="doctor")


def test_help_is_printed_at_once_and_without_torch():
    code = (
        "import sys, time; start = time.process_time()\n"
        "from cadam3d.cli import dispatch\n"
        "dispatch(['train', '--help']); dispatch(['train', 'experiment=smoke', '--help'])\n"
        "assert time.process_time() - start < 2\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY, timeout=60, capture_output=True)
