"""The Gaussians that a run records, for the slider of its report."""

import struct
from pathlib import Path

import pytest

from cadam3d.callback.snapshots import Snapshots
from cadam3d.io.run_folder import snapshots

LINE = ("steps=7", "densifier.min_age=0")


def count(path: Path) -> int:
    """Return the number of Gaussians in a snapshot, as its header states it."""
    return struct.unpack("<I", path.read_bytes()[12:16])[0]


@pytest.fixture(scope="module")
def recorded(train, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    (folder / "snapshots").mkdir()
    (folder / "snapshots/step_0000900.bin").write_bytes(b"of a killed run")
    (folder / "snapshots/notes.txt").write_text("mine")
    return folder, train(folder, *LINE, callbacks=[Snapshots(every=4, largest=1000)])[0]


def test_the_start_the_multiples_and_the_last_step_are_recorded_and_no_later_one_is_left(recorded):
    folder, state = recorded
    paths = snapshots(folder)
    assert list(paths) == [0, 4, 7]
    assert (folder / "snapshots/notes.txt").exists()
    assert count(paths[0]) == 30
    assert count(paths[7]) == len(state.gaussians)


def test_a_snapshot_has_the_scores_of_the_densifier_and_the_age(recorded):
    content = snapshots(recorded[0])[7].read_bytes()
    for name in (b"drift", b"noise", b"snr", b"age", b"selected"):
        assert name in content


def test_recording_does_not_change_the_run(recorded, plain, alike):
    alike(recorded[1], plain)


def test_a_large_population_is_not_recorded(train, tmp_path):
    train(tmp_path, "steps=1", callbacks=[Snapshots(every=4, largest=29)])
    assert snapshots(tmp_path) == {}


def test_a_folder_that_cannot_be_written_costs_the_snapshots_and_not_the_run(train, tmp_path, caplog):
    (tmp_path / "snapshots").write_text("a file")
    assert train(tmp_path, "steps=1", callbacks=[Snapshots(every=4, largest=1000)])[0].step == 1
    assert "no snapshot of step 1" in caplog.text
