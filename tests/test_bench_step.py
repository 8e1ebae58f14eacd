"""The benchmark of a training step: all of its parts are measured, and the classes stay as they are."""

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import bench_step
from step_bench.clocks import Watch

from cadam3d.optimizer import GaussianOptimizer
from cadam3d.trainer import Trainer

TINY = ["prior=tiny", "rasterizer=reference", "camera.size=8", "initializer.count=20", "callback=[metrics]"]
FEW = ["--steps", "2", "--warmup", "1", "--priors", "exact"]
CHANGED = ((GaussianOptimizer, "step"), (Trainer, "train"), (Trainer, "_refine"), (torch.Tensor, "backward"))


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch):
    """Measure without another process, which would take seconds to start."""

    monkeypatch.setattr(bench_step, "measure_there", lambda _, *what: bench_step.measure_here(*what))
    monkeypatch.setenv("TQDM_DISABLE", "1")
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    monkeypatch.setattr(sys, "path", list(sys.path))
    threads, mode = torch.get_num_threads(), torch.get_deterministic_debug_mode()
    yield
    torch.set_num_threads(threads)
    torch.set_deterministic_debug_mode(mode)


def test_every_part_of_a_step_is_measured_and_counted(tmp_path, capsys):
    before = [vars(owner)[name] for owner, name in CHANGED if name in vars(owner)]
    bench_step.main(
        [
            *FEW,
            "--base",
            str(bench_step.measuring.HERE),
            "--repeats",
            "1",
            "--json",
            str(tmp_path / "step.json"),
            *TINY,
            "regularizer=[mean_scale]",
        ]
    )
    table = capsys.readouterr().out
    assert "here / base, whole step" in table
    (found,) = json.loads((tmp_path / "step.json").read_text())["here"]
    assert set(found["parts_ms"]) == set(bench_step.ORDER)
    assert all(f"\n| {name} |" in table for name in found["parts_ms"])
    assert found["operations"]["render"] > 0
    assert found["readbacks"]["readback"] == 1
    assert (found["gaussians"], found["views"], found["size"]) == (20, 2, "8")
    assert found["settings"][-len(TINY) - 1 :] == [*TINY, "regularizer=[mean_scale]"]
    assert not any(word.startswith("hydra") for word in found["settings"])
    # The classes are as they were.
    assert [vars(owner)[name] for owner, name in CHANGED if name in vars(owner)] == before


def test_a_part_inside_another_one_is_subtracted_from_it(monkeypatch):
    clock = iter([0.0, 1.0, 4.0, 10.0])
    watch = Watch(torch.device("cpu"))
    monkeypatch.setattr(watch, "now", lambda: next(clock))
    inner = watch("prior", lambda: None)
    watch("guidance", inner)()
    assert watch.seconds == {"prior": 3.0, "guidance": 7.0}
