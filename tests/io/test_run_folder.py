"""The run folder: how a run is recognised, how a folder is claimed, and how paths are shown."""

from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import (
    checkpoint_name,
    claim,
    has_checkpoint,
    holds_run,
    numbered,
    shown,
)


@pytest.mark.parametrize("name", ["summary.json", "checkpoints"])
def test_a_folder_with_results_or_checkpoints_holds_a_run(name, tmp_path):
    (tmp_path / "train.log").touch()
    assert not holds_run(tmp_path)
    (tmp_path / name).mkdir()
    assert holds_run(tmp_path)


def test_names_of_checkpoints_sort_as_steps_do(tmp_path):
    steps = [2, 10, 999, 12_345]
    assert sorted(map(checkpoint_name, steps)) == [checkpoint_name(step) for step in steps]
    assert not has_checkpoint(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    assert not has_checkpoint(tmp_path)
    (tmp_path / "checkpoints" / checkpoint_name(3)).touch()
    assert has_checkpoint(tmp_path)


@pytest.mark.parametrize("content", [None, "", "[1]", "{"])
def test_a_summary_that_cannot_be_read_is_empty(content, tmp_path):
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    assert read_summary(tmp_path) == {}


def test_a_chosen_folder_is_used_unchanged_and_another_gets_a_number(tmp_path):
    folder = tmp_path / "a" / "run"
    assert claim(folder, "key", is_chosen=False) == folder
    assert claim(folder, "key", is_chosen=True) == folder
    assert claim(folder, "key", is_chosen=False) == folder.with_name("run-2")
    assert numbered(folder) == folder.with_name("run-3")


def test_a_place_that_cannot_be_written_is_a_user_error_with_its_key():
    with pytest.raises(UserError, match=r"^hydra.run.dir: cannot write to /dev/null/x"):
        claim(Path("/dev/null/x"), "hydra.run.dir", is_chosen=True)


def test_paths_are_shown_relative_to_the_current_folder_if_they_are_inside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert shown(tmp_path / "a" / "b") == Path("a/b")
    assert shown(tmp_path.parent) == tmp_path.parent
