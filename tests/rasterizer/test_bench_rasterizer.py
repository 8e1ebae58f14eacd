"""The script that checks and times rasterizers runs as on a GPU, with fibers instead of a GPU."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.driver import Launcher
from cadam3d.rasterizer.reference import ReferenceRasterizer

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))  # as Python does for a script

import bench_rasterizer
from rasterizer_bench import check
from rasterizer_bench.scenes import make_scene, make_shell
from rasterizer_bench.stages import CPU_STAGES, REST

CPU = torch.device("cpu")
TINY = ("--counts", "60", "--sizes", "20", "--repeats", "2", "--views", "2")


@pytest.fixture(autouse=True)
def _one_thread_as_before():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@dataclass(frozen=True)
class Wrong(Rasterizer):
    """The reference with one mistake."""

    mistake: Callable[[Gaussians], Gaussians]

    def render(self, gaussians, cameras, background, absgrad=False):
        return ReferenceRasterizer().render(self.mistake(gaussians), cameras, background, absgrad)


def changed(gaussians: Gaussians, **tensors: torch.Tensor) -> Gaussians:
    return Gaussians(**gaussians.tensors() | tensors)


def run(words, backends, launcher: Launcher | None = None) -> int:
    return bench_rasterizer.run(bench_rasterizer.parse(words), backends, launcher)


@pytest.fixture
def small_checks(monkeypatch):
    """Make the scenes of the checks smaller, for tests of the script around them."""
    monkeypatch.setattr(check, "SPLATS", 60)
    monkeypatch.setattr(check, "SIZE", 25)
    monkeypatch.setattr(check, "REPEATED", {"cpu": (60, 20)})


# -------------------------------------------------------------------------- whole runs


@pytest.mark.usefixtures("small_checks")
def test_every_backend_is_checked_timed_and_written_for_every_scene(kernel_build, tmp_path, capsys):
    path = tmp_path / "bench.json"
    cpu = CpuRasterizer(cache_dir=str(kernel_build.parent))
    words = ["--counts", "50", "80", "--sizes", "16", "24", "--degrees", "0", "1", "--repeats", "2"]
    code = run([*words, "--json", str(path)], {"reference": ReferenceRasterizer(), "cpu": cpu})
    shown = capsys.readouterr().out
    assert code == 0, shown
    assert "check reference: agrees" in shown
    assert "check cpu: agrees" in shown
    written = json.loads(path.read_text())
    scenes = [(row["count"], row["size"], row["degree"]) for row in written["rows"]]
    assert scenes[::2] == scenes[1::2] == [(n, s, d) for d in (0, 1) for n in (50, 80) for s in (16, 24)]
    for row in written["rows"]:
        assert min(row["forward_ms"], row["backward_ms"]) > 0
        assert 0 < row["host_ms"] <= row["step_ms"]
        # There is no reliable number for a CPU.
        assert row["peak_bytes"] is None
    first, second = written["rows"][:2]
    assert first["ratio"] == 1
    assert second["ratio"] == first["step_ms"] / second["step_ms"]
    assert written["machine"]["torch"] == torch.__version__
    assert written["settings"]["counts"] == [50, 80]
    assert [row["stage"] for row in written["stages"][0]["stages"]] == [*CPU_STAGES, REST]


# -------------------------------------------------------------------------- backends that fail the check


def detaches(gaussians):
    return changed(gaussians, log_scales=gaussians.log_scales.detach() + 0 * gaussians.log_scales)


@pytest.mark.usefixtures("small_checks")
def test_a_backend_that_disagrees_is_not_timed(monkeypatch, capsys):
    timed = []
    monkeypatch.setattr(bench_rasterizer, "time_all", lambda _, backends, __: timed.extend(backends))
    assert run(TINY, {"auto": Wrong(detaches), "reference": ReferenceRasterizer()}) == 1
    shown = capsys.readouterr().out
    assert timed == ["reference"]
    assert "check reference: agrees" in shown
    assert "check auto: FAILED" in shown
    assert "the gradient of log_scales is wrong" in shown


@pytest.mark.usefixtures("small_checks")
def test_a_backend_that_promises_the_same_bits_must_give_them():
    factors = cycle([1, 1 + 2e-7])  # less than any tolerance

    def wobbles(gaussians):
        return changed(gaussians, means=gaussians.means * next(factors))

    # The reference does not promise the same bits.
    assert not check.check("reference", Wrong(wobbles), CPU)
    troubles = check.check("cuda", Wrong(wobbles), CPU)
    assert troubles
    assert all(f"not the same in {check.RUNS} runs" in trouble for trouble in troubles)


def test_both_ways_to_render_must_give_the_same_bits():
    @dataclass(frozen=True)
    class Ahead(ReferenceRasterizer):
        def render_ahead(self, gaussians, *rest):
            moved = changed(gaussians, means=gaussians.means * (1 + 2e-7))
            return self.render(moved, *rest)

    scene = make_scene(make_shell(30, 0, CPU), 16, 1)
    assert not check.changes(ReferenceRasterizer(), scene)
    assert check.changes(Ahead(), scene)
