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

    def there(tree, prior, args):
        args.tree = tree
        try:
            return bench_step.measure_here(prior, args)
        finally:
            args.tree = None

    monkeypatch.setattr(bench_step, "measure_there", there)
    monkeypatch.setenv("TQDM_DISABLE", "1")
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    monkeypatch.setattr(sys, "path", list(sys.path))
    threads, mode = torch.get_num_threads(), torch.get_deterministic_debug_mode()
    yield
    torch.set_num_threads(threads)
    torch.set_deterministic_debug_mode(mode)


def test_every_part_of_a_step_is_measured_and_counted(tmp_path, capsys):
    before = [vars(owner)[name] for owner, name in CHANGED if name in vars(owner)]
    bench_step.main([*FEW, "--json", str(tmp_path / "step.json"), *TINY, "regularizer=[mean_scale]"])
    table = capsys.readouterr().out
    (found,) = json.loads((tmp_path / "step.json").read_text())["here"]
    assert set(found["parts_ms"]) == set(bench_step.ORDER)
    assert all(f"\n{name} " in table for name in found["parts_ms"])
    assert found["operations"]["render"] > 0
    assert found["readbacks"]["readback"] == 1
    sizes = {"parameters": 56, "gradients": 56, "moments": 112, "densifier": 28}
    assert found["bytes_per_gaussian"] == sizes
    assert (found["gaussians"], found["views"], found["size"]) == (20, 2, "8")
    assert found["settings"][-len(TINY) - 1 :] == [*TINY, "regularizer=[mean_scale]"]
    assert not any(word.startswith("hydra") for word in found["settings"])
    # The classes are as they were.
    assert [vars(owner)[name] for owner, name in CHANGED if name in vars(owner)] == before


def test_two_trees_are_compared_part_by_part(capsys):
    bench_step.main([*FEW, "--base", str(bench_step.HERE), "--repeats", "1", *TINY])
    out = capsys.readouterr().out
    assert "base ms" in out
    assert "here / base, whole step" in out


def test_settings_may_follow_the_list_of_priors():
    args = bench_step.read_arguments(["--priors", "exact", "learned", "steps=3", "densifier=none"])
    assert (args.priors, args.settings) == (["exact", "learned"], ["steps=3", "densifier=none"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--base", "nowhere"], "argument --base: expected a checkout of cadam3d"),
        (["--json", "nowhere/step.json"], "argument --json: expected a file in a folder that exists"),
        (["--steps", "0"], "argument --steps: expected a whole number of at least 1, got 0"),
        (["--warmup", "x"], "argument --warmup: expected a whole number of at least 1, got x"),
    ],
)
def test_a_wrong_line_is_refused_before_anything_is_measured(words, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        bench_step.main([*words, *TINY])
    assert message in capsys.readouterr().err


def test_a_benchmark_that_measures_nothing_fails(monkeypatch, capsys):
    def there(tree, prior, args):
        raise bench_step.LeftOutError("densifer: no such setting")

    monkeypatch.setattr(bench_step, "measure_there", there)
    with pytest.raises(SystemExit, match="1"):
        bench_step.main([*FEW, "densifer=baseline", "--priors", "exact"])
    assert capsys.readouterr().out == "exact is left out: densifer: no such setting\n"


def test_a_part_inside_another_one_is_subtracted_from_it(monkeypatch):
    clock = iter([0.0, 1.0, 4.0, 10.0])
    watch = Watch(torch.device("cpu"))
    monkeypatch.setattr(watch, "now", lambda: next(clock))
    inner = watch("prior", lambda: None)
    watch("guidance", inner)()
    assert watch.seconds == {"prior": 3.0, "guidance": 7.0}


def test_medians_are_taken_of_numbers_at_any_depth():
    turns = [{"a": {"b": value}, "name": "x", "none": None} for value in (3.0, 1.0, 2.0)]
    assert bench_step.middle(turns) == {"a": {"b": 2.0}, "name": "x", "none": None}
