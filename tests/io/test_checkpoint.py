"""Checkpoints are read as they were written, or an error is raised."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.io import checkpoint
from cadam3d.io.checkpoint import latest_checkpoint, load_checkpoint, prune_checkpoints, save_checkpoint


def latest(folder: Path) -> Path | None:
    found = latest_checkpoint(folder, load_checkpoint, lambda error: None)
    return None if found is None else found[0]


PAYLOAD = {
    "step": 7,
    "seconds": 1.5,
    "name": "a torus",
    "nothing": None,
    "flag": True,
    "gaussians": {"means": torch.arange(6.0).reshape(2, 3)},
    "optimizer": {"means": {"exp_avg": torch.ones(2, 3), "step": torch.tensor(7)}, "rates": [1e-3, (2, 3)]},
    "generators": {"camera": torch.Generator().manual_seed(1).get_state()},
}


def flatten(value, prefix=""):
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in items:
        if isinstance(item, (dict, list, tuple)):
            yield from flatten(item, f"{prefix}/{key}")
        else:
            yield f"{prefix}/{key}", item


def assert_same(actual, expected) -> None:
    left, right = dict(flatten(actual)), dict(flatten(expected))
    assert left.keys() == right.keys()
    for key, value in right.items():
        if isinstance(value, torch.Tensor):
            assert left[key].dtype == value.dtype
            assert torch.equal(left[key], value), key
        else:
            assert left[key] == value, key


def test_the_payload_is_read_as_it_was_written(tmp_path):
    save_checkpoint(tmp_path / "deep" / "step_0000007.pt", PAYLOAD)
    assert_same(load_checkpoint(tmp_path / "deep" / "step_0000007.pt"), PAYLOAD)


def test_tensors_that_require_gradients_are_saved_as_plain_tensors(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"means": torch.nn.Parameter(torch.ones(3))})
    means = load_checkpoint(tmp_path / "a.pt")["means"]
    assert type(means) is torch.Tensor
    assert not means.requires_grad


def test_the_file_does_not_hold_the_whole_storage_of_a_view(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"view": torch.zeros(1_000_000)[:4]})
    assert (tmp_path / "a.pt").stat().st_size < 10_000


@pytest.mark.parametrize("value", [object(), {1, 2}, {"deep": [object()]}, {object(): 1}])
def test_what_a_safe_load_would_refuse_is_refused_when_saving(tmp_path, value):
    with pytest.raises(ValueError, match="plain"):
        save_checkpoint(tmp_path / "a.pt", {"value": value})
    assert list(tmp_path.iterdir()) == []


def test_nothing_in_the_file_is_executed(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'executed'}",)

    content = {"format": checkpoint.FORMAT, "version": checkpoint.VERSION, "payload": Evil()}
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(UserError):
        load_checkpoint(tmp_path / "a.pt")
    assert not (tmp_path / "executed").exists()


def test_a_single_flipped_bit_is_noticed(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"means": torch.zeros(100_000)})
    content = bytearray((tmp_path / "a.pt").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "a.pt").write_bytes(content)
    with pytest.raises(UserError, match="checksum"):
        load_checkpoint(tmp_path / "a.pt")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_file_is_a_user_error(tmp_path, share):
    save_checkpoint(tmp_path / "a.pt", PAYLOAD)
    content = (tmp_path / "a.pt").read_bytes()
    (tmp_path / "a.pt").write_bytes(content[: int(share * len(content))])
    with pytest.raises(UserError, match="resume=RUN"):
        load_checkpoint(tmp_path / "a.pt")


def test_a_missing_file_is_a_user_error(tmp_path):
    with pytest.raises(UserError, match="No such file"):
        load_checkpoint(tmp_path / "a.pt")


def test_other_torch_files_and_other_versions_are_refused(tmp_path):
    torch.save({"weights": torch.ones(3)}, tmp_path / "other.pt")
    with pytest.raises(UserError, match="cannot be read as a checkpoint"):
        load_checkpoint(tmp_path / "other.pt")
    torch.save({"format": checkpoint.FORMAT, "version": 999, "payload": {}}, tmp_path / "new.pt")
    with pytest.raises(UserError, match="version"):
        load_checkpoint(tmp_path / "new.pt")


def test_a_save_that_fails_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    save_checkpoint(tmp_path / "a.pt", {"step": 1})

    def fails(path, content):
        with path.open("wb") as file:
            file.write(content[:4])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fails)
    with pytest.raises(UserError, match="No space left"):
        save_checkpoint(tmp_path / "a.pt", {"step": 2})
    assert load_checkpoint(tmp_path / "a.pt") == {"step": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


def test_the_latest_is_the_one_with_the_most_steps(tmp_path):
    for step in (100, 1000, 200):
        save_checkpoint(tmp_path / f"step_{step:07d}.pt", {"step": step})
    assert latest(tmp_path) == tmp_path / "step_0001000.pt"


def test_a_damaged_latest_falls_back_to_the_one_before(tmp_path):
    for step in (100, 200, 300):
        save_checkpoint(tmp_path / f"step_{step:07d}.pt", {"step": step})
    (tmp_path / "step_0000300.pt").write_bytes(b"")
    assert latest(tmp_path) == tmp_path / "step_0000200.pt"


def test_without_any_checkpoint_there_is_no_latest(tmp_path):
    assert latest(tmp_path) is None
    assert latest(tmp_path / "missing") is None


def test_only_damaged_checkpoints_are_an_error_not_a_fresh_start(tmp_path):
    (tmp_path / "step_0000100.pt").write_bytes(b"older")
    (tmp_path / "step_0000200.pt").write_bytes(b"newer")
    with pytest.raises(UserError, match="step_0000200"):
        latest(tmp_path)


def test_pruning_keeps_the_newest_and_removes_leftovers_of_a_kill(tmp_path):
    for step in (1, 2, 3, 4):
        save_checkpoint(tmp_path / f"step_{step:07d}.pt", {"step": step})
    (tmp_path / ".tmp-123-step_0000005.pt").write_bytes(b"half")
    prune_checkpoints(tmp_path, keep=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step_0000003.pt", "step_0000004.pt"]


def test_a_kill_in_the_middle_of_saving_leaves_a_sound_latest(tmp_path):
    program = f"""
import torch
from pathlib import Path
from cadam3d.io.checkpoint import save_checkpoint
for step in range(1, 10**6):
    path = Path({str(tmp_path)!r}) / f"step_{{step % 3 + 1:07d}}.pt"
    save_checkpoint(path, {{"means": torch.full((50_000,), step)}})
    if step == 3:
        print("three saved", flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    for path in tmp_path.glob("step_*.pt"):
        means = load_checkpoint(path)["means"]
        assert means.shape == (50_000,)
        assert (means == means[0]).all()
