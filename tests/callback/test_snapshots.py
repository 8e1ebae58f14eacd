"""The Gaussians that a run records, for the slider of its report."""

import struct
from pathlib import Path

import pytest

from cadam3d.callback.snapshots import Snapshots
from cadam3d.io.run_folder import snapshots

TEN = ("steps=10", "densifier.min_age=0")


def count(path: Path) -> int:
    """Return the number of Gaussians in a snapshot, as its header states it."""
    return struct.unpack("<I", path.read_bytes()[12:16])[0]


@pytest.fixture(scope="module")
def recorded(train, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, train(folder, *TEN, callbacks=[Snapshots(every=4, largest=1000)])[0]


def test_the_start_the_multiples_and_the_last_step_are_recorded(recorded):
    folder, state = recorded
    paths = snapshots(folder)
    assert list(paths) == [0, 4, 8, 10]
    assert count(paths[0]) == 30
    assert count(paths[10]) == len(state.gaussians)


def test_a_snapshot_has_the_scores_of_the_densifier_and_the_age(recorded):
    content = snapshots(recorded[0])[10].read_bytes()
    for name in (b"drift", b"noise", b"snr", b"age", b"selected"):
        assert name in content


def test_recording_does_not_change_the_run(recorded, train, alike, tmp_path):
    alike(recorded[1], train(tmp_path, *TEN)[0])


def test_a_large_population_is_not_recorded(train, tmp_path):
    train(tmp_path, "steps=4", callbacks=[Snapshots(every=4, largest=29)])
    assert snapshots(tmp_path) == {}


def test_a_folder_that_cannot_be_written_costs_the_snapshots_and_not_the_run(train, tmp_path, caplog):
    (tmp_path / "snapshots").write_text("a file")
    assert train(tmp_path, "steps=4", callbacks=[Snapshots(every=4, largest=1000)])[0].step == 4
    assert "no snapshot of step 4" in caplog.text


def test_a_resumed_run_removes_what_was_recorded_after_its_checkpoint(train, tmp_path):
    train(tmp_path, "steps=4", callbacks=[Snapshots(every=2, largest=1000)])
    stale = tmp_path / "snapshots/step_0000900.bin"
    stale.write_bytes(b"")
    (tmp_path / "snapshots/notes.txt").write_text("mine")
    train(tmp_path, "steps=4", callbacks=[Snapshots(every=2, largest=1000)])
    assert not stale.exists()
    assert (tmp_path / "snapshots/notes.txt").exists()
