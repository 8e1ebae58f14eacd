"""Every key of the configuration is described in one place, and docs/components.md is generated from that."""

import importlib.util
from pathlib import Path

import pytest

from cadam3d import cli
from cadam3d.core.errors import UserError
from cadam3d.settings.documentation import Library, first_sentence, read_page
from cadam3d.settings.options import config_dir

REPOSITORY = Path(__file__).parents[2]
LIBRARY = Library([config_dir()])
OPTIONS = [(group, name) for group, names in LIBRARY.options.items() for name in names]
DOCUMENTED = [(group, name) for group, name in OPTIONS if group != "grid"]  # a grid lists runs
NAMES = ["/".join(option) for option in DOCUMENTED]


def library(folder: Path, **files: str) -> Library:
    """Write files such as ``camera__orbit``, and read them."""
    for name, text in files.items():
        path = folder / f"{name.replace('__', '/')}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return Library([folder])


# --- our own files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("group", "name"), OPTIONS, ids=map("/".join, OPTIONS))
def test_every_option_has_a_description(group, name):
    assert len(LIBRARY.summary(group, name)) > 10


@pytest.mark.parametrize(("group", "name"), DOCUMENTED, ids=NAMES)
def test_every_setting_of_an_option_has_a_description(group, name):
    assert not [each.key for each in LIBRARY.option(group, name).settings if not each.words]


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_every_setting_and_every_group_of_a_command_has_a_description(command):
    about = LIBRARY.command(command)
    assert f"\n  cadam3d {command}" in about.about
    assert not [each.key for each in about.settings if not each.words]
    assert not [group.name for group in LIBRARY.groups(command) if not group.words]


@pytest.mark.parametrize(("group", "name"), DOCUMENTED, ids=NAMES)
def test_an_option_does_not_repeat_descriptions_of_its_base(group, name):
    """A second copy could disagree with the first. A note about the new value is not a copy."""
    page = LIBRARY.page(f"{group}/{name}")
    for base in page.bases:
        place, _, base_name = base.rpartition("/")
        known = LIBRARY.page(f"{place or group}/{base_name}").words
        copies = [key for key, note in page.words.items() if _opening(note) == _opening(known.get(key, ""))]
        assert not copies


def _opening(words: str) -> str:
    """Return the beginning of a description, which is about the key; the rest may be about the value."""
    return words.lower().partition(";")[0].partition(",")[0]


def test_the_page_of_components_is_up_to_date():
    path = REPOSITORY / "scripts" / "write_components.py"
    spec = importlib.util.spec_from_file_location("write_components", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    text = script.PAGE.read_text(encoding="utf-8")
    assert {name for _, name, _ in script.PART.findall(text)} >= {
        group for group in LIBRARY.options if "/" not in group
    }
    assert script.written(text) == text, "Try: python scripts/write_components.py"


# --- reading comments -------------------------------------------------------------------------------------


def test_a_description_is_beside_its_key_or_directly_above_it():
    page = read_page(
        "# What it is.\n"
        "_target_: a.B\n"
        "one: 1 # beside\n"
        "\n"
        "# a heading\n"
        "\n"
        "# above,\n"
        "# in two lines\n"
        "two: 2\n"
        "# Above.\n"
        "three: 3 # and beside\n"
        "four: 4 # beside,\n"
        "        # and below\n"
        "five: '#5' # quoted\n"
        "six: [1, 2] # a list\n"
        "seven: a#b\n"
    )
    assert page.about == "What it is."
    assert page.words == {
        "one": "beside",
        "two": "above, in two lines",
        "three": "Above. And beside",
        "four": "beside, and below",
        "five": "quoted",
        "six": "a list",
    }
    assert page.values["seven"] == "a#b"


def test_the_first_comment_may_have_paragraphs_and_examples():
    page = read_page(
        "# One\n# line.\n#\n#   cadam3d one\n#   cadam3d two\n#\n# Two (sec. 3). Three.\nkey: 1 # words\n"
    )
    assert page.about == "One line.\n\n  cadam3d one\n  cadam3d two\n\nTwo (sec. 3). Three."
    assert first_sentence(page.about) == "One line."
    assert first_sentence("Two (sec. 3) et al. 4. Three.") == "Two (sec. 3) et al. 4."


def test_the_first_comment_does_not_belong_to_the_first_key():
    assert not read_page("# What it is.\nkey: 1\n").words
    assert not read_page("# @package _global_\n# What it is.\nkey: 1\n").words
    assert read_page("# @package callback.mine\n# What it is.\nkey: 1\n").package == "callback.mine"


def test_text_blocks_have_no_comments():
    page = read_page("text: |-\n  a # no comment\n  b\nkey: 1 # words\n")
    assert page.words == {"key": "words"}


def test_an_option_inherits_the_descriptions_of_its_base(tmp_path):
    base = "# Base.\n_target_: a.B\nsize: 1 # pixels\nrate: 2 # per step\nkept: 3 # as it is\n"
    derived = "# Derived.\ndefaults: [base, _self_]\nsize: 4\nrate: 5 # small\n"
    option = library(tmp_path, thing__base=base, thing__derived=derived).option("thing", "derived", "none")
    assert {each.key: (each.value, each.words) for each in option.settings} == {
        "thing.size": ("4", "pixels"),
        "thing.rate": ("5", "per step. Here: small"),
        "thing.kept": ("3", "as it is"),
    }
    assert (option.base, option.target) == ("base", "a.B")
    assert option.own_keys == {"thing.size", "thing.rate"}


def test_a_key_without_a_description_has_that_of_the_same_class(tmp_path):
    one = (
        "# One.\n_target_: a.B\nsize: 1 # pixels\ninner:  # an object\n  _target_: a.C\n  size: 2 # metres\n"
    )
    two = "# Two.\n_target_: a.B\nsize: 3\ninner:\n  _target_: a.C\n  size: 4\n"
    option = library(tmp_path, thing__one=one, thing__two=two).option("thing", "two", "none")
    assert [each.words for each in option.settings] == ["pixels", "an object", "metres"]


def test_a_schedule_is_one_value(tmp_path):
    schedule = "  _target_: cadam3d.core.schedule.Linear\n  start: 1\n  end: 0\n"
    text = f"# It.\n_target_: a.B\nrate: # per step\n{schedule}"
    [rate] = library(tmp_path, thing__it=text).option("thing", "it", "none").settings
    assert (rate.key, rate.value) == ("thing.rate", "Linear(start=1, end=0)")


def test_a_recipe_has_the_descriptions_of_the_settings_that_it_changes():
    settings = {each.key: each for each in LIBRARY.option("experiment", "bench").settings}
    orbit = {each.key: each.words for each in LIBRARY.option("camera", "orbit").settings}
    assert settings["camera.size"].value == "96"
    assert settings["camera.size"].words == orbit["camera.size"]
    assert settings["exporter"].value == "[ply,preview]"


def test_the_first_of_two_folders_takes_precedence(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    library(tmp_path / "a", thing__it="# First.\n")
    library(tmp_path / "b", thing__it="# Second.\n", thing__other="# Other.\n")
    both = Library([tmp_path / "a", tmp_path / "b"])
    assert both.options == {"thing": ["it", "other"]}
    assert both.summary("thing", "it") == "First."


def test_a_file_that_is_not_yaml_is_named(tmp_path):
    with pytest.raises(UserError, match=r"it\.yaml: expected YAML"):
        library(tmp_path, thing__it="key: [1\n").page("thing/it")
