"""Every key of the configuration is described once, in its YAML file, and the help shows all descriptions."""

import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d import cli
from cadam3d.core.errors import UserError
from cadam3d.settings.help import Library, about_of, help_text, words_in
from cadam3d.settings.options import config_dir

REPOSITORY = Path(__file__).parents[2]
LIBRARY = Library([config_dir()])
OPTIONS = [(group, name) for group, names in LIBRARY.options.items() for name in names]
# Options of these groups change settings of other groups, which are described there.
RECIPES = ("experiment", "noise", "vram", "for")


def page(*words: str, command: str = "train", folders: tuple[Path, ...] = ()) -> str:
    return help_text(command, words, [*folders, config_dir()])


def flat(text: str) -> str:
    return " ".join(text.split())


def library(folder: Path, **files: str) -> Library:
    """Write files such as ``camera__orbit``, and read them together with those of the package."""
    for name, text in files.items():
        path = folder / f"{name.replace('__', '/')}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return Library([folder, config_dir()])


# --- our own files ----------------------------------------------------------------------------------------


def test_every_option_and_every_setting_of_it_has_a_description():
    for group, name in OPTIONS:
        assert len(LIBRARY.summary(group, name)) > 10
        if group not in ("grid", *RECIPES):
            own = [each for each in LIBRARY.option(group, name).settings if each.key.startswith(f"{group}.")]
            assert not [each.key for each in own if not each.words]


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_every_setting_and_every_group_of_a_command_has_a_description(command):
    about = LIBRARY.command(command)
    assert f"\n  cadam3d {command}" in about.about
    assert not [each.key for each in about.settings if not each.words]
    assert not [name for name, group in LIBRARY.groups(command).items() if not group.words]


# --- reading comments -------------------------------------------------------------------------------------


def test_a_description_is_beside_its_key_or_directly_above_it(tmp_path):
    text = (
        "# What it is.\n_target_: a.B\none: 1 # beside\n\n# a heading\n\n# above,\n# in two lines\n"
        "two: 2\n# Above.\nthree: 3 # and beside\nfive: '#5' # quoted\nsix: [1, 2] # a list\nseven: a#b\n"
        "inner: # a dict\n  eight: 8 # inside\nnine: 9 # outside\n"
    )
    path = tmp_path / "it.yaml"
    path.write_text(text)
    assert about_of(path) == "What it is."
    assert words_in(path) == {
        "one": "beside",
        "two": "above, in two lines",
        "three": "Above. And beside",
        "five": "quoted",
        "six": "a list",
        "inner": "a dict",
        "inner.eight": "inside",
        "nine": "outside",
    }


def test_the_first_comment_may_have_paragraphs_and_examples_and_belongs_to_no_key(tmp_path):
    text = "# One\n# line.\n#\n#   cadam3d one\n#   cadam3d two\n#\n# Two (sec. 3). Three.\nkey: 1\n"
    path = tmp_path / "it.yaml"
    path.write_text(text)
    assert about_of(path) == "One line.\n\n  cadam3d one\n  cadam3d two\n\nTwo (sec. 3). Three."
    assert not words_in(path)
    path.write_text("# @package callback.mine\n# What it is.\nkey: 1\n")
    assert about_of(path) == "What it is."


def test_an_option_inherits_the_descriptions_of_its_base(tmp_path):
    base = "# Base.\n_target_: a.B\nsize: 1 # pixels\nrate: 2 # per step\nkept: 3 # as it is\n"
    derived = "# Derived.\ndefaults: [base, _self_]\nsize: 4\nrate: 5 # small\n"
    option = library(tmp_path, thing__base=base, thing__derived=derived).option("thing", "derived")
    assert {each.key: (each.value, each.words) for each in option.settings} == {
        "thing.size": ("4", "pixels"),
        "thing.rate": ("5", "per step. Here: small"),
        "thing.kept": ("3", "as it is"),
    }
    assert option.base == "base"


def test_a_place_inside_an_option_inherits_the_descriptions_of_the_option_that_it_builds_on(tmp_path):
    base = "# Base.\n_target_: a.B\nsize: 1 # pixels\n"
    derived = "# It.\ndefaults: [/thing/base@inner, _self_]\n_target_: a.C\ninner:\n  size: 2\n"
    option = library(tmp_path, thing__base=base, other__it=derived).option("other", "it")
    assert {each.key: each.words for each in option.settings} == {"other.inner.size": "pixels"}


def test_a_schedule_is_one_value(tmp_path):
    schedule = "  _target_: cadam3d.core.schedule.Linear\n  start: 1\n  end: 0\n"
    text = f"# It.\n_target_: a.B\nrate: # per step\n{schedule}"
    [rate] = library(tmp_path, thing__it=text).option("thing", "it").settings
    assert (rate.key, rate.value) == ("thing.rate", "Linear(start=1, end=0)")


def test_a_recipe_lists_what_it_chooses_and_changes():
    settings = {each.key: each.value for each in LIBRARY.option("experiment", "bench").settings}
    assert (settings["camera.size"], settings["exporter"]) == ("96", "[ply,preview]")


def test_the_first_of_two_folders_takes_precedence(tmp_path):
    both = library(tmp_path, camera__orbit="# First.\n", camera__other="# Other.\n")
    assert {"orbit", "other", "sphere"} <= set(both.options["camera"])
    assert both.summary("camera", "orbit") == "First."


# --- pages ------------------------------------------------------------------------------------------------


def test_the_page_of_a_command_lists_every_option_with_its_description():
    text = flat(page())
    for group_name, group in LIBRARY.groups("train").items():
        assert f"{group_name}: {group.words}" in text
        for name in LIBRARY.options[group_name]:
            mark = "* " if name in group.chosen else ""
            assert f" {mark}{name} {LIBRARY.summary(group_name, name)}".rstrip() in text


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_the_page_of_a_command_lists_its_settings(command):
    text = page(command=command)
    about = LIBRARY.command(command)
    assert text.startswith(about.about[:20])
    for each in about.settings:
        assert f"\n  {each.key}{'=' if each.value else ''}{each.value}" in text
        assert flat(each.words) in flat(text)


def test_the_page_of_an_option_lists_its_settings():
    text = page("camera=orbit", "guidance=ism", "metric=[size]", "prompt='a cube'", "steps=7")
    for group, name in (("camera", "orbit"), ("guidance", "ism")):
        for each in LIBRARY.option(group, name).settings:
            assert each.key in text
            assert each.words in flat(text)
    assert "camera.fov_y_deg=[40.0,45.0]" in text
    assert "guidance.t_max: Linear(start=0.98, end=0.5, steps=${cadam3d.parts:10,12,${steps}})" in text
    assert "It has no settings." in text
    assert "densifier" not in text.replace("densifier.tau_pos", "")


def test_the_page_of_a_variant_lists_what_it_changes():
    text = page("prior=sdxl")
    assert "Builds on prior=stable_diffusion and changes ids, size." in text
    assert "prior.size=1024" in text
    assert "prior.compile=false" in text


@pytest.mark.parametrize("columns", [40, 72, 200])
def test_lines_fit_into_the_terminal(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = page("camera", "guidance=ism").splitlines() + page().splitlines()
    prose = [line for line in lines if "=" not in line and "cadam3d" not in line]
    assert max(map(len, prose)) <= min(max(columns, 60), 120)


def test_options_of_a_user_folder_are_listed_too(tmp_path):
    library(tmp_path, densifier__mine="# Grow it.\n_target_: mine.Mine\nshare: 0.1 # in (0, 1)\n")
    assert "Grow it." in page(folders=(tmp_path,))
    assert "densifier.share=0.1 in (0, 1)" in flat(page("densifier=mine", folders=(tmp_path,)))


@pytest.mark.parametrize(
    ("words", "command", "message"),
    [
        (("densifier=cadamm",), "train", r"got 'cadamm'.* Try: densifier=cadam$"),
        (("densifer",), "train", r"got 'densifer'\. Try: cadam3d train --help densifier$"),
        (("grid=thresholds",), "train", r"got 'grid'"),
        (("camera",), "doctor", r"got 'camera'"),
    ],
)
def test_the_message_for_an_unknown_name_suggests_a_similar_one(words, command, message):
    with pytest.raises(UserError, match=message):
        page(*words, command=command)


def test_help_is_printed_at_once_and_without_torch():
    code = (
        "import sys, time; start = time.process_time()\n"
        "from cadam3d.cli import dispatch\n"
        "dispatch(['train', '--help']); dispatch(['train', 'experiment=smoke', '--help'])\n"
        "assert time.process_time() - start < 2\n"
        "assert not {'torch', 'pydantic'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY, timeout=60, capture_output=True)
