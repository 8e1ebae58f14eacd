"""A checkpoint gives back what was saved, or one message: every entry is damaged in every generic way."""

import copy
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cadam3d.build import component
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.cadam import CAdamState
from cadam3d.io.checkpoint import FORMAT, VERSION, DamagedCheckpointError, load_checkpoint, save_checkpoint
from cadam3d.settings.compose import compose
from cadam3d.state import PayloadError, TrainState, start_generators

CPU = torch.device("cpu")
DELETED = object()  # stands for an entry that is deleted


@pytest.fixture(scope="module")
def trained() -> tuple[TrainState, Any, Any]:
    """Return a state after nine steps of a run with random numbers, its optimizer and its densifier."""
    cfg = compose(["prompt=a red cube"])
    optimizer, densifier = component(cfg.optimizer), component(cfg.densifier)
    draw = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.randn(5, 3, generator=draw),
        log_scales=torch.randn(5, 3, generator=draw),
        quats=torch.randn(5, 4, generator=draw),
        opacity_logits=torch.randn(5, generator=draw),
        sh=torch.randn(5, 4, 3, generator=draw),
    )
    owner = optimizer.start(gaussians)
    for step in range(2):
        for tensor in owner.gaussians.tensors().values():
            tensor.grad = torch.randn(tensor.shape, generator=draw)
        owner.step(step)
    blank = densifier.init_state(5, CPU)
    assert isinstance(blank, CAdamState)
    rows = CAdamState(
        m=torch.randn(5, 3, generator=draw), v=torch.rand(5, 3, generator=draw), age=blank.age + 7
    )
    state = TrainState(
        step=9,
        seconds=1.5,
        cpu_seconds=2.5,
        num_initial=4,
        initial_note=None,
        skipped=1,
        dimmed=2,
        refused=False,
        seed=3,
        optimizer=owner,
        densifier=rows,
        generators=start_generators(3),
    )
    return state, optimizer, densifier


def paths(value: Any, prefix: tuple = ()) -> list[tuple]:
    """Return the place of every entry in nested dicts, the dicts themselves included."""
    if not isinstance(value, dict):
        return [prefix]
    inner = [path for key, item in value.items() for path in paths(item, (*prefix, key))]
    return [*([prefix] if prefix else []), *inner]


def damages(value: Any) -> dict[str, Any]:
    """Return wrong values for an entry, by name."""
    wrong = {
        "nothing": None,
        "text": "7",
        "bytes of text": "\ud800",
        "list": [1, 2],
        "dict": {},
        "deep": {"a": {"b": [[[]]]}},
        "truth": True,
        "fraction": 0.5,
        "nan": float("nan"),
        "infinity": float("inf"),
        "negative": -1,
        "huge": 10**5000,
        "scalar": torch.tensor(1.0),
        "empty tensor": torch.zeros(0),
        "keys": {1: 2},
    }
    if isinstance(value, torch.Tensor):
        wrong = {name: item for name, item in wrong.items() if name != "empty tensor"} | {
            "double": value.double(),
            "half": value.half(),
            "long": value.long(),
            "boolean": value.bool(),
            "one row less": value[:-1],
            "one row more": torch.cat([value, value[:1]]),
            "no rows": value[:0],
            "one more axis": value[None],
            "flat": value.flatten()[:-1],
            "expanded": value.flatten()[:1].expand(10**9),
        }
        if value.ndim > 1:
            wrong |= {"transposed": value.transpose(0, 1)}
    return wrong


def replaced(payload: dict, path: tuple, value: Any) -> dict:
    changed = {key: dict(item) if isinstance(item, dict) else item for key, item in payload.items()}
    changed["optimizer"] = {
        key: dict(item) if isinstance(item, dict) else item for key, item in changed["optimizer"].items()
    }
    node = changed
    for key in path[:-1]:
        node = node[key]
    if value is DELETED:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return changed


def is_same(left: Any, right: Any) -> bool:
    if isinstance(right, dict):
        return left.keys() == right.keys() and all(is_same(left[key], right[key]) for key in right)
    if isinstance(right, torch.Tensor):
        return isinstance(left, torch.Tensor) and left.dtype == right.dtype and torch.equal(left, right)
    return type(left) is type(right) and left == right


def test_every_damaged_entry_is_refused_or_restored_as_it_is(trained):
    state, optimizer, densifier = trained
    payload = state.to_payload()
    assert is_same(TrainState.restore(payload, optimizer, densifier, CPU).to_payload(), payload)
    for path in paths(payload):
        value = payload
        for key in path:
            value = value[key]
        for name, wrong in {"deleted": DELETED, **damages(value)}.items():
            changed = replaced(payload, path, wrong)
            try:
                restored = TrainState.restore(changed, optimizer, densifier, CPU)
            except (PayloadError, UserError):
                continue
            assert is_same(restored.to_payload(), changed), (path, name)


@pytest.mark.parametrize("group", [(), ("gaussians",), ("optimizer",), ("densifier",), ("generators",)])
def test_entries_that_training_does_not_write_are_refused(trained, group):
    state, optimizer, densifier = trained
    with pytest.raises((PayloadError, UserError)):
        TrainState.restore(replaced(state.to_payload(), (*group, "more"), 1), optimizer, densifier, CPU)


@pytest.mark.parametrize("content", [None, [], "text", 7, torch.zeros(3), {}])
def test_a_payload_of_another_kind_is_refused(trained, content):
    _, optimizer, densifier = trained
    with pytest.raises(PayloadError):
        TrainState.restore(content, optimizer, densifier, CPU)


def archive(path: Path, payload: Any) -> Path:
    torch.save({"format": FORMAT, "version": VERSION, "payload": payload}, path)
    return path


class Opened:
    """An object whose pickle calls a function of Python."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def unusual(folder: Path) -> dict[str, Any]:
    """Return values that torch can save and even its safe mode would build."""
    ones = torch.ones(4)
    return {
        "sparse": ones.to_sparse(),
        "meta": torch.empty(10**9, device="meta"),
        "expanded": torch.ones(1).expand(10**9),
        "part of a storage": torch.ones(8)[2:4],
        "transposed": torch.ones(2, 3).T,
        "complex": torch.ones(3, dtype=torch.complex64),
        "quantized": torch.quantize_per_tensor(ones, 0.1, 0, torch.qint8),
        "parameter": torch.nn.Parameter(ones),
        "gradient": ones.clone().requires_grad_(),
        "ordered": OrderedDict(a=ones).items,
        "numpy": np.float32(1),
        "bytes": b"abc",
        "set": {1},
        "code": Opened(folder / "opened"),
    }


@pytest.mark.parametrize("name", unusual(Path()))
def test_only_plain_dense_tensors_come_out_of_a_file(tmp_path, name):
    value = unusual(tmp_path)[name]
    try:
        path = archive(tmp_path / "a.pt", {"value": value})
    except (TypeError, AttributeError, pickle.PicklingError):
        pytest.skip("cannot be saved")
    with pytest.raises(DamagedCheckpointError) as caught:
        load_checkpoint(path)
    assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "opened").exists()


def rewritten(source: Path, target: Path, change, *, compression: int = zipfile.ZIP_STORED) -> Path:
    """Copy an archive; ``change`` returns the new content of an entry, given its name and content."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compression) as new:
        for entry in old.infolist():
            new.writestr(entry.filename, change(entry.filename, old.read(entry)))
    return target


def test_a_compressed_archive_is_refused_before_it_is_unpacked(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"means": torch.ones(8)})

    def grow(name, content):
        return bytes(1 << 26) if name.endswith("data/0") else content

    bomb = rewritten(tmp_path / "a.pt", tmp_path / "b.pt", grow, compression=zipfile.ZIP_DEFLATED)
    assert bomb.stat().st_size < 1 << 20
    with pytest.raises(DamagedCheckpointError, match="compressed"):
        load_checkpoint(bomb)


def test_a_tensor_cannot_be_larger_than_its_bytes(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"means": torch.ones(8)})
    assert rewritten(tmp_path / "a.pt", tmp_path / "same.pt", lambda name, content: content)
    assert torch.equal(load_checkpoint(tmp_path / "same.pt")["means"], torch.ones(8))

    def shrink(name, content):
        return content[:16] if name.endswith("data/0") else content

    with pytest.raises(DamagedCheckpointError):
        load_checkpoint(rewritten(tmp_path / "a.pt", tmp_path / "b.pt", shrink))


def test_truth_values_are_zero_or_one(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"mask": torch.tensor([True, False])})

    def change(name, content):
        return b"\2\0" if name.endswith("data/0") else content

    with pytest.raises(DamagedCheckpointError):
        load_checkpoint(rewritten(tmp_path / "a.pt", tmp_path / "b.pt", change))


@pytest.mark.parametrize(
    "stream",
    [
        b"",
        b".",
        b"\x80\x02]" + b"]" * 100_000 + b".",
        b"\x80\x02" + b"(" * 100_000 + b".",
        b"\x80\x04\x96" + b"\xff" * 8 + b".",  # a claim of 2^64 bytes
        b"\x80\x02X\xff\xff\xff\x7fabc.",  # a text that is not there
        b"\x80\x02Nr\xff\xff\xff\x7f.",  # entry 2^31 of the memory
        b"\x80\x02cos\nsystem\n(X\x02\0\0\0lstR.",
        b"\x80\x02ctorch\nFloatStorage\nK\x05\x85R.",
        b"\x80\x02}q\0h\0h\0s.",
    ],
)
def test_any_other_pickle_is_one_message(tmp_path, stream):
    save_checkpoint(tmp_path / "a.pt", {"means": torch.ones(8)})

    def change(name, content):
        return stream if name.endswith("data.pkl") else content

    with pytest.raises(DamagedCheckpointError):
        load_checkpoint(rewritten(tmp_path / "a.pt", tmp_path / "b.pt", change))


def test_random_damage_is_one_message_or_harmless(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"means": torch.ones(8), "step": 3, "note": "text"})
    sound = (tmp_path / "a.pt").read_bytes()
    draw = np.random.default_rng(0)
    for _ in range(200):
        content = bytearray(sound)
        for place in draw.integers(0, len(content), size=3):
            content[place] = draw.integers(256)
        (tmp_path / "b.pt").write_bytes(content)
        try:
            found = load_checkpoint(tmp_path / "b.pt")
        except DamagedCheckpointError:
            continue
        assert torch.equal(found["means"], torch.ones(8))
        assert found["step"] == 3


def test_the_state_itself_is_not_changed_by_a_restored_copy(trained):
    state, optimizer, densifier = trained
    payload = copy.deepcopy(state.to_payload())
    restored = TrainState.restore(payload, optimizer, densifier, CPU)
    restored.optimizer.displace(torch.ones(5, 3))
    assert is_same(payload, state.to_payload())
