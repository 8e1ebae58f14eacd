"""The snapshots and numbers that a run writes while a page is open."""

import os
import struct
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from cadam3d.callback.base import Callback
from cadam3d.callback.live import Live
from cadam3d.io import live

STEPS = 12


@dataclass
class Page(Callback):
    """Touches the file of a page before every step, and keeps what the run has written."""

    live: Live
    folder: Path
    is_open: bool

    def __post_init__(self):
        self.snapshots, self.rows = [], []

    def on_start(self, context, state):
        self._touch(0)

    def on_step(self, context, state, report):
        path = self.folder / "live/snapshot.bin"
        self.snapshots.append(path.read_bytes() if path.exists() else None)
        self.rows.append(
            (
                state.step,
                self.live._born.clone(),
                self.live._is_selected.clone(),
                len(state.gaussians),
            )
        )
        self._touch(state.step)

    def _touch(self, step):
        if self.is_open:
            live.touch_watched(self.folder)
            os.utime(self.folder / "live/watched", (step, step))


@pytest.fixture(scope="module")
def watch(train):
    """Return a function that trains a few steps, with an open page or without, and returns state and page."""

    def run(folder: Path, *line: str, with_live=True, is_open=True, share=1.0):
        callback = Live(seconds=0.1, share=share)
        callback.seconds = 0.0
        page = Page(callback, folder, is_open)
        line = (f"steps={STEPS}", "refine.interval=4", *line)
        return train(folder, *line, callbacks=[callback, page] if with_live else [])[0], page

    return run


@pytest.fixture(scope="module")
def opened(watch, tmp_path_factory):
    """Return the folder of a run with an open page, its state and the page."""
    folder = tmp_path_factory.mktemp("opened")
    return folder, *watch(folder)


@pytest.fixture(scope="module")
def closed(watch, tmp_path_factory):
    """Return the same of a run without an open page."""
    folder = tmp_path_factory.mktemp("closed")
    return folder, *watch(folder, is_open=False)


def test_the_run_is_the_same_with_and_without_live_and_with_an_open_page(watch, opened, closed, tmp_path):
    off, _ = watch(tmp_path, with_live=False)
    for other in (opened[1], closed[1]):
        assert torch.equal(other.gaussians.means, off.gaussians.means)
        assert torch.equal(other.gaussians.sh, off.gaussians.sh)
        for name, generator in other.generators.items():
            assert torch.equal(generator.get_state(), off.generators[name].get_state())


def test_without_a_page_no_snapshot_is_written(closed):
    folder, _, page = closed
    assert page.snapshots == [None] * STEPS
    assert sorted(path.name for path in (folder / "live").iterdir()) == ["state.json"]


def test_an_open_page_gets_snapshots_that_change_with_the_layers_of_the_densifier(opened):
    _, state, page = opened
    assert len(set(page.snapshots)) > STEPS // 2
    assert struct.unpack_from("<I", page.snapshots[-1], 12) == (len(state.gaussians),)
    for layer in (b"snr", b"drift", b"age", b"selected"):
        assert layer in page.snapshots[-1]


def test_the_rows_know_their_age_and_the_children_and_surviving_parents_are_selected(watch, tmp_path):
    # The scale above which a parent is replaced is so large that each one survives.
    _, page = watch(tmp_path, "densifier=random", "refine.tau_scale=100")
    for step, born, selected, n in page.rows:
        assert len(born) == len(selected) == n
        # Newborns are the last rows, and no row is older than the run.
        assert born.equal(born.sort().values)
        assert set(born.tolist()) <= {0, *range(4, step + 1, 4)}
    _, born, selected, _ = page.rows[-1]
    assert {0, 4, 8, 12} == set(born.tolist())
    assert selected[born == STEPS].all()
    assert int(selected.sum()) == 2 * int((born == STEPS).sum()) > 0


def test_the_last_numbers_say_that_training_has_ended(opened):
    folder, state, _ = opened
    written = live.read_state(folder)
    assert written is not None
    assert written["has_ended"]
    assert (written["step"], written["num_gaussians"]) == (STEPS, len(state.gaussians))
    assert "snr_p50" in written["statistics"]


def test_a_snapshot_that_takes_long_is_followed_by_a_long_time_without_one(watch, tmp_path):
    _, page = watch(tmp_path, share=1e-6)
    assert len(set(page.snapshots)) <= 2


def test_a_folder_that_cannot_be_written_ends_the_live_view_and_not_the_run(watch, tmp_path, monkeypatch):
    (tmp_path / "live").write_text("in the way")
    monkeypatch.setattr(live, "touch_watched", lambda run: None)
    state, page = watch(tmp_path, is_open=False)
    assert state.step == STEPS
    assert not page.live._works
