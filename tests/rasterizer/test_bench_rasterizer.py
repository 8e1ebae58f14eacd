"""The script that checks and times rasterizers runs as on a GPU, with fibers instead of a GPU."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer import cuda, cuda_sort, gsplat
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.launcher import Launcher
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import GSPLAT, Agreement
from cadam3d.rasterizer.workspace import Workspace

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))  # as Python does for a script

import bench_rasterizer
from rasterizer_bench import check, report, stages, targets, timing
from rasterizer_bench.scenes import make_scene, make_shell

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
    cpu = CpuRasterizer(cache_dir=str(kernel_build.path.parent))
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
        assert 0 < row["forward_backward_min_ms"] <= row["forward_backward_ms"]
        assert min(row["forward_ms"], row["backward_ms"]) > 0
        assert 0 < row["host_ms"] <= row["step_ms"]
        # There is no reliable number for a CPU.
        assert row["peak_bytes"] is None
        assert f"{row['forward_backward_ms']:.2f}" in shown
    first, second = written["rows"][:2]
    assert first["ratio"] == 1
    assert second["ratio"] == first["step_ms"] / second["step_ms"]
    assert written["device"]["name"]
    assert written["versions"]["torch"] == torch.__version__
    assert written["settings"]["counts"] == [50, 80]
    assert not written["stages"]


@pytest.mark.usefixtures("small_checks")
def test_every_stage_of_the_kernels_is_timed(emulator, tmp_path, capsys):
    path = tmp_path / "bench.json"
    code = run(
        [*TINY, "--json", str(path)],
        {"reference": ReferenceRasterizer(), "cuda": stages.KernelRasterizer(emulator)},
        emulator,
    )
    shown = capsys.readouterr().out
    assert code == 0, shown
    written = json.loads(path.read_text())
    (of_scene,) = written["stages"]
    assert [each["stage"] for each in of_scene["stages"]] == [*stages.STAGES, stages.TORCH, stages.REST]
    assert sum(each["median_ms"] for each in of_scene["stages"]) == pytest.approx(of_scene["wall_ms"])
    for each in of_scene["stages"][:-2]:
        assert min(each["launches"], each["median_ms"], each["bytes"], each["floor_ms"]) > 0
        assert each["floor_ms"] == pytest.approx(each["bytes"] / written["copy_bytes_per_ms"])
        assert each["stage"] in shown


def test_a_backend_can_be_checked_from_the_command_line(kernel_build, monkeypatch, capsys):
    monkeypatch.setattr(
        bench_rasterizer, "component", lambda _: CpuRasterizer(cache_dir=str(kernel_build.path.parent))
    )
    assert bench_rasterizer.main(["--backends", "cpu", "--check-only"]) == 0
    shown = capsys.readouterr().out
    assert shown == "check cpu: agrees with the reference\n"


# -------------------------------------------------------------------------- backends that fail the check


def turns_all_slightly(gaussians):
    return changed(gaussians, quats=gaussians.quats + 1e-3)


def detaches(gaussians):
    return changed(gaussians, log_scales=gaussians.log_scales.detach() + 0 * gaussians.log_scales)


def loses_the_last(gaussians):
    fainter = torch.zeros_like(gaussians.opacity_logits)
    fainter[-1] = 50.0
    return changed(gaussians, opacity_logits=gaussians.opacity_logits - fainter)


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


@pytest.mark.parametrize("mistake", [turns_all_slightly, detaches, loses_the_last])
def test_hard_scenes_show_the_mistake_without_the_self_test(mistake):
    adversaries = dict(check.difficult_scenes(CPU))
    for kind in ("needles", "flat discs", "equal depths"):
        assert check.differences(Wrong(mistake), check.small_scene(adversaries[kind])), kind


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


def test_a_step_without_enough_memory_is_repeated():
    @dataclass(frozen=True)
    class TooSmall(ReferenceRasterizer):
        def render_ahead(self, gaussians, *rest):
            output = self.render(gaussians.map(lambda tensor: tensor * 0), *rest)
            return replace(output, overflowed=torch.tensor(True))

    scene = make_scene(make_shell(30, 0, CPU), 16, 1)
    scene.step(TooSmall())
    got = check.gradients_of(scene)
    scene.zero_grad()
    scene.backward(scene.render(ReferenceRasterizer()))
    for name, gradient in check.gradients_of(scene).items():
        assert torch.equal(got[name], gradient), name


def test_without_a_check_every_backend_is_timed(capsys):
    assert run([*TINY, "--no-check"], {"reference": ReferenceRasterizer()}) == 0
    assert "check" not in capsys.readouterr().out


def test_a_sort_that_is_wrong_is_found(emulator, monkeypatch):
    assert not check.check_long_sort(emulator, CPU, 5000)
    sort = check.sort
    monkeypatch.setattr(
        check,
        "sort",
        lambda launch, keys, order, n, bits, *rest: sort(launch, keys, order, n, bits - 8, *rest),
    )
    assert check.check_long_sort(emulator, CPU, 5000) == ["5000 keys are sorted wrongly"]


def test_gsplat_is_checked_with_its_own_demands(monkeypatch):
    pytest.importorskip("gsplat", reason="pip install -e .[dev]")
    import gsplat_on_cpu

    def test(rasterizer, device, demands):
        tested.append(demands)
        return Agreement({"rgb": 1e-3}, {"means": 0.0}, repeats=False, demands=demands)

    tested = []
    monkeypatch.setattr(check, "self_test", test)
    monkeypatch.setattr(gsplat, "load_rasterization", lambda device: gsplat_on_cpu.rasterization)
    [trouble] = check.check("gsplat", GsplatRasterizer(), CPU)
    assert trouble.startswith("self-test: disagrees with the reference: images 1e-3")
    assert tested == [GSPLAT]


def test_gsplat_is_skipped_where_it_cannot_run(capsys):
    backends = bench_rasterizer.make_backends(["gsplat", "reference"], CPU)
    assert list(backends) == ["reference"]
    assert "gsplat is skipped: rasterizer=gsplat: expected a CUDA device" in capsys.readouterr().out


# -------------------------------------------------------------------------- timing


@dataclass(frozen=True)
class Greedy(Rasterizer):
    def render(self, gaussians, cameras, background, absgrad=False):
        raise torch.OutOfMemoryError


def test_a_backend_that_runs_out_of_memory_does_not_stop_the_others(capsys):
    backends = {"auto": Greedy(), "reference": ReferenceRasterizer()}
    assert run([*TINY, "--no-check"], backends) == 0
    assert "auto   out of memory" in capsys.readouterr().out
    timings = timing.take_turns(backends, make_scene(make_shell(20, 0, CPU), 9, 1), 1)
    assert timings["auto"] is None
    assert timings["reference"] is not None


def test_every_repetition_starts_without_gradients():
    scene = make_scene(make_shell(20, 1, CPU), 9, 1)
    scene.backward(scene.render(ReferenceRasterizer()))
    once = {name: tensor.grad.clone() for name, tensor in scene.gaussians.tensors().items()}
    timing.time_phases(ReferenceRasterizer(), scene)
    for name, tensor in scene.gaussians.tensors().items():
        torch.testing.assert_close(tensor.grad, once[name])


# -------------------------------------------------------------------------- stages


def test_every_launch_belongs_to_a_known_stage(emulator):
    # The kernels are defined elsewhere, and a new one must be assigned to a stage.
    clock = stages.LaunchClock(emulator)
    scene = make_scene(make_shell(300, 1, CPU), 24, 2)
    names = [
        k.name for k in clock.watch(lambda: scene.backward(scene.render(stages.KernelRasterizer(clock))))
    ]
    kernels = {stage: [] for stage in stages.STAGES}
    for name, stage in zip(names, stages.stages_of(names), strict=True):
        kernels[stage].append(name)  # KeyError: unknown
    passes = len(cuda_sort.digit_bits(cuda.DEPTH_BITS))
    assert kernels["depth sort"] == ["sort_scatter"] * passes
    assert kernels["tile lists"] == ["scan_apply", "tile_list"]
    assert kernels["tile sort"] == ["sort_scatter", "tile_ranges"]
    assert kernels["blend forward"] == ["blend_forward_8x8"]
    assert kernels["blend backward"] == ["blend_backward_8x8"]
    assert kernels["project backward"] == ["project_backward_4", "centre_backward"]


def test_the_load_of_a_scene_is_counted(emulator):
    clock = stages.LaunchClock(emulator)
    gaussians = make_shell(1, 0, CPU).detach()
    gaussians.means.zero_()
    # The splat is larger than the screen, so it touches every tile in both views.
    gaussians.log_scales.fill_(1.0)
    scene = make_scene(gaussians.map(lambda tensor: tensor.requires_grad_()), 20, 2)
    scene.render(stages.KernelRasterizer(clock))
    load = stages.measure_load(ReferenceRasterizer(), scene, clock.slots)
    assert load == stages.Load(
        gaussians=1, coefficients=1, views=2, visible=2, slots=18, pixels=800, tiles=18
    )


def test_the_bytes_of_a_stage_are_those_of_its_arguments(emulator, monkeypatch):
    """If every pair is visible and in one tile, a stage needs exactly the bytes of its arguments."""
    # An argument is an address, which either a tensor or a workspace has given out.
    sizes, scales = {}, Scales(emulator)
    point, places = torch.Tensor.data_ptr, Workspace.addresses

    def note_tensor(tensor):
        address = point(tensor)
        sizes[address] = tensor.nbytes
        return address

    def note_arrays(workspace, blocks):
        found = places(workspace, blocks)
        sizes.update({found[name]: size for name, size in workspace.sizes.items() if size})
        return found

    monkeypatch.setattr(torch.Tensor, "data_ptr", note_tensor)
    monkeypatch.setattr(Workspace, "addresses", note_arrays)
    scales.sizes = sizes
    # With many splats, the bytes of cameras, bins and ranges hardly count.
    n = 2000
    gaussians = make_shell(n, 1, CPU).detach()
    gaussians.means.mul_(0.02)
    gaussians.log_scales.fill_(-9.0)
    gaussians.opacity_logits.fill_(-2.0)
    scene = make_scene(gaussians.map(lambda tensor: tensor.requires_grad_()), 7, 1)  # one tile
    scene.backward(scene.render(stages.KernelRasterizer(scales)))
    load = stages.measure_load(ReferenceRasterizer(), scene, scales.slots)
    assert load.visible == load.slots == n
    needed, given = stages.stage_bytes(load), dict.fromkeys(stages.STAGES, 0)
    names = [kernel.name for kernel in scales.launches]
    for stage, size in zip(stages.stages_of(names), scales.given, strict=True):
        given[stage] += size
    for stage in stages.STAGES:
        assert needed[stage] == pytest.approx(given[stage], rel=0.1), stage


class Scales(stages.LaunchClock):
    """Notes the bytes of the arrays of each launch."""

    def __init__(self, inner):
        super().__init__(inner)
        self.sizes, self.given = {}, []

    def _launch(self, launch, kernel, blocks, threads, *arguments):
        super()._launch(launch, kernel, blocks, threads, *arguments)
        self.given.append(sum(self.sizes.get(each, 0) for each in arguments))


def test_kernels_that_a_profiler_has_seen_become_stages(emulator):
    """The profiler of a GPU also sees kernels of torch; durations are those that it gives."""
    scene = make_scene(make_shell(60, 0, CPU), 20, 2)
    clock = stages.LaunchClock(emulator)

    def profiled(work):
        # The clock of the stages counts the launches, too.
        names = [kernel.name for kernel in clock.watch(work)]
        return [stages.Kernel("Memset (Device)", 5.0), *(stages.Kernel(name, 0.25) for name in names)]

    timing = stages.time_stages(clock, scene, 3, 1e6, profiled)
    by_stage = {stage.stage: stage for stage in timing.stages}
    for name in stages.STAGES:
        assert by_stage[name].median_ms == 0.25 * by_stage[name].launches > 0
    assert (by_stage[stages.TORCH].launches, by_stage[stages.TORCH].median_ms) == (1, 5.0)
    assert timing.kernel_ms == sum(by_stage[name].median_ms for name in (*stages.STAGES, stages.TORCH))
    assert by_stage[stages.REST].median_ms == timing.wall_ms - timing.kernel_ms


def test_a_torch_that_cannot_profile_kernels_is_reported(monkeypatch):
    monkeypatch.setattr(torch.profiler, "supported_activities", set)
    with pytest.raises(stages.NoKernelsError, match="of this torch cannot time kernels"):
        stages.profile(lambda: None)


def test_kernels_that_the_profiler_has_missed_are_reported(emulator):
    scene = make_scene(make_shell(60, 0, CPU), 20, 2)
    for lost in (1, 1000):

        def incomplete(work, lost=lost):
            work()
            return [stages.Kernel("blend_forward", 0.1)] * max(0, 20 - lost)

        with pytest.raises(stages.NoKernelsError, match=r"has seen \d+ of \d+ kernels"):
            stages.time_stages(emulator, scene, 1, 1e6, incomplete)


# -------------------------------------------------------------------------- targets


def rows_of(scene, device="NVIDIA H200", **both_ms):
    timings = {
        name: timing.Timing(dict.fromkeys(timing.PHASES, ms), dict.fromkeys(timing.PHASES, ms), 2**20)
        for name, ms in both_ms.items()
    }
    return {row.backend: row for row in report.make_rows(scene, timings, device)}


@pytest.mark.parametrize(
    ("scene", "times", "is_met"),
    [
        ((1_000_000, 1024, 4, 0), {"cuda": 11.0}, True),
        ((1_000_000, 1024, 4, 0), {"cuda": 11.1}, False),
        ((1_000_000, 1024, 4, 0), {"gsplat": 19.8, "cuda": 11.0}, True),
        ((1_000_000, 1024, 4, 0), {"gsplat": 19.7, "cuda": 11.0}, False),  # 1.79 times as fast
        ((1_000_000, 1024, 4, 3), {"gsplat": 19.7, "cuda": 11.0}, False),  # the ratio applies to all degrees
        ((20_000, 512, 1, 0), {"cuda": 0.5}, True),
        ((20_000, 512, 1, 0), {"cuda": 0.6}, False),
        ((1_000_000, 1024, 1, 0), {"cuda": 99.0}, None),
    ],
)
def test_targets_are_met_or_missed(scene, times, is_met):
    row = rows_of(scene, **times)["cuda"]
    assert row.is_met is is_met
    assert ("MISSED" in str(row), ": met" in str(row)) == (is_met is False, is_met is True)


def test_other_backends_and_unknown_devices_have_no_targets():
    scene = (1_000_000, 1024, 4, 0)
    assert rows_of(scene, gsplat=1.0, cuda=1.0)["gsplat"].is_met is None
    assert rows_of(scene, device="a new card", cuda=99.0)["cuda"].is_met is None


def test_targets_grow_with_the_amount_of_work():
    for table in targets.MOST_MS.values():
        for size in (512, 1024):
            by_count = [ms for (_, pixels), ms in sorted(table.items()) if pixels == size]
            assert by_count == sorted(by_count)
        assert all(ms < table[count, 1024] for (count, pixels), ms in table.items() if pixels == 512)


# -------------------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--backends unknown", "invalid choice: 'unknown'"),
        ("--counts 0", "invalid whole number >= 1 value: '0'"),
        ("--sizes big", "invalid whole number >= 1 value: 'big'"),
        ("--degrees 4", "invalid choice: 4"),
        ("--check-only --no-check", "leave nothing to do"),
        ("--json nowhere/bench.json", "Try: mkdir -p nowhere"),
        ("--backends gsplat", "no backend is left"),
        ("--backends cuda", "rasterizer=cuda: expected a CUDA device, got cpu"),
        pytest.param(
            "--device cuda",
            "torch sees no CUDA device",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is one"),
        ),
    ],
)
def test_a_mistake_is_reported_in_one_line(words, message, capsys):
    try:
        code = bench_rasterizer.main(words.split())
    except SystemExit as ended:
        code = ended.code
    error = capsys.readouterr().err
    assert code == 2
    assert message in error
    assert error.startswith("bench_rasterizer: ")
    assert error.count("\n") == 1


def test_each_device_has_its_own_defaults():
    cpu, gpu = (bench_rasterizer.parse(["--device", device]) for device in ("cpu", "cuda"))
    assert (cpu.backends, cpu.counts, cpu.sizes) == (["reference", "cpu"], [3_000, 10_000], [128, 256])
    assert set(targets.MOST_MS["H200"]) <= {(count, size) for count in gpu.counts for size in gpu.sizes}
    assert {1, 4} == set(gpu.views)
    assert bench_rasterizer.parse(["--device", "cuda", "--counts", "5"]).counts == [5]
