"""Previews: contact sheets, written without changing the run."""

import imageio.v3 as imageio
import numpy as np

from cadam3d.settings.compose import compose

LINE = ("densifier.min_age=0", "callback=[previews]", "callback.previews.size=16")
SETTINGS = {
    "every": 3,
    "views": 4,
    "elevation_deg": 15.0,
    "distance": 3.0,
    "fov_y_deg": 40.0,
    "size": 16,
    "background": [1.0, 1.0, 1.0],
}


def names(folder) -> list[str]:
    return sorted(path.name for path in (folder / "previews").glob("*"))


def test_by_default_no_previews_are_written(train, tmp_path):
    train(tmp_path, *LINE)
    assert not (tmp_path / "previews").exists()


def test_one_setting_turns_previews_on(train, tmp_path):
    assert "previews" in compose(["prompt=a red cube"]).callback
    train(tmp_path, *LINE, "callback.previews.every=3")
    assert names(tmp_path) == ["step_000003.png", "step_000006.png"]


def test_a_sheet_shows_the_object_from_all_sides_in_one_row(train, tmp_path):
    state, _ = train(tmp_path, *LINE, "callback.previews.every=7", "callback.previews.views=4")
    sheet = imageio.imread(tmp_path / "previews/step_000007.png")
    assert sheet.shape == (16, 4 * 16, 3)
    assert len(state.gaussians) > 0
    views = sheet.reshape(16, 4, 16, 3).swapaxes(0, 1)
    assert all((view[4:12, 4:12] < 250).any() for view in views)
    assert not np.array_equal(views[0], views[2])


def test_a_run_with_the_callback_equals_one_without(train, alike, tmp_path):
    alike(
        train(tmp_path, *LINE, "callback.previews.every=1")[0],
        train(tmp_path / "other", "densifier.min_age=0")[0],
    )


def test_pictures_of_a_killed_run_after_its_checkpoint_are_deleted(train, tmp_path):
    (tmp_path / "previews").mkdir()
    (tmp_path / "previews/step_000099.png").write_bytes(b"old")
    train(tmp_path, *LINE, "callback.previews.every=5")
    assert names(tmp_path) == ["step_000005.png"]
