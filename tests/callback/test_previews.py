"""Previews: contact sheets, written without changing the run."""

import imageio.v3 as imageio
import numpy as np
import pytest

from cadam3d.settings.compose import compose

LINE = ("densifier.min_age=0", "callback=[previews]", "callback.previews.size=16")


@pytest.fixture(scope="module")
def drawn(train, tmp_path_factory):
    """Return the folder of a run with sheets, in which a killed run has left a later one, and its state."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "previews").mkdir()
    (folder / "previews/step_000099.png").write_bytes(b"old")
    return folder, train(folder, *LINE, "callback.previews.every=3")[0]


def names(folder) -> list[str]:
    return sorted(path.name for path in (folder / "previews").glob("*"))


def test_by_default_no_previews_are_written(train, tmp_path):
    assert "previews" in compose(["prompt=a red cube"]).callback
    train(tmp_path, *LINE, "steps=1")
    assert not (tmp_path / "previews").exists()


def test_one_setting_turns_previews_on_and_sheets_of_a_killed_run_are_deleted(drawn):
    assert names(drawn[0]) == ["step_000003.png", "step_000006.png"]


def test_a_sheet_shows_the_object_from_all_sides_in_one_row(drawn):
    sheet = imageio.imread(drawn[0] / "previews/step_000006.png")
    assert sheet.shape == (16, 4 * 16, 3)
    views = sheet.reshape(16, 4, 16, 3).swapaxes(0, 1)
    assert all((view[4:12, 4:12] < 250).any() for view in views)
    assert not np.array_equal(views[0], views[2])


def test_a_run_with_the_callback_equals_one_without(drawn, plain, alike):
    alike(drawn[1], plain)
