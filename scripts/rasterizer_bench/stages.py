"""The stages of the CUDA and the CPU rasterizer: the time that is spent in their kernels.

Kernels of CUDA are timed by the GPU itself, through ``torch.profiler``. Clocks around the launches would
include the time in which an idle GPU waits for the host, which takes longer than a short kernel. The kernels
of the CPU time themselves.
"""

import ctypes
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from measuring import in_turns, median, milliseconds, now
from rasterizer_bench.scenes import Scene
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cuda import rasterize, rasterize_ahead
from cadam3d.rasterizer.driver import Launch, Launcher

# The stages in order, with the prefixes of their kernels. Sorts and prefix sums belong to several stages.
STAGES = {
    "project": ("prepare_cameras", "project_forward"),
    "depth sort": (),
    "tile lists": ("tile_list",),
    "tile sort": ("tile_ranges",),
    "blend forward": ("blend_forward",),
    "blend backward": ("blend_backward",),
    "project backward": ("project_backward", "sum_absolutes", "centre_backward"),
}
# The stages of a pass on the CPU, in the order of ``enum Stage`` in cadam3d/rasterizer/kernels/cpu.cpp.
CPU_STAGES = ("project", "depth order", "tile lists", "blend forward", "blend backward", "gather", "centres")
# Kernels and copies of torch, such as filling and adding.
TORCH = "torch"
# The wall clock without all kernels: a GPU waits for the host; on a CPU, Python and autograd.
REST = "rest"


class NoKernelsError(Exception):
    """The profiler has not seen the kernels. The message says so in one line."""


@dataclass(frozen=True)
class KernelRasterizer(Rasterizer):
    """The CUDA rasterizer with a given launcher."""

    launcher: Launcher

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`."""
        return rasterize(self.launcher, gaussians, cameras, background, absgrad)

    def render_ahead(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render_ahead`."""
        return rasterize_ahead(self.launcher, gaussians, cameras, background, absgrad)


@dataclass(frozen=True)
class Kernel:
    """A kernel or a copy that a device has run."""

    name: str
    ms: float


def profile(work: Callable[[], object]) -> list[Kernel]:
    """Return the kernels and copies of ``work``, timed by the GPU.

    Raises :class:`NoKernelsError` if this torch cannot do that.
    """
    gpu = torch.profiler.ProfilerActivity.CUDA
    if gpu not in torch.profiler.supported_activities():
        raise NoKernelsError("torch.profiler of this torch cannot time kernels")
    with torch.profiler.profile(activities=[gpu]) as profiler:
        work()
        torch.cuda.synchronize()
    events = [e for e in profiler.events() or [] if e.device_type == torch.autograd.DeviceType.CUDA]
    events.sort(key=lambda event: event.time_range.start)
    return [Kernel(event.name, event.time_range.elapsed_us() / 1e3) for event in events]


class LaunchClock(Launcher):
    """Passes every launch on, and notes the kernel and how long the launch takes on the host.

    In the emulator that is the time of the kernel, because a launch returns when the kernel has ended.
    """

    def __init__(self, inner: Launcher) -> None:
        self._inner = inner
        self.launches: list[Kernel] = []

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`."""
        with self._inner.on(device) as launch:
            yield partial(self._launch, launch)

    def _launch(self, launch: Launch, kernel: str, blocks: int, threads: int, *arguments) -> None:
        begin = time.perf_counter()
        launch(kernel, blocks, threads, *arguments)
        self.launches.append(Kernel(kernel, (time.perf_counter() - begin) * 1e3))

    def watch(self, work: Callable[[], object]) -> list[Kernel]:
        """Return the launches of ``work``."""
        work()
        return self.launches

    def reset(self) -> None:
        """Forget all launches."""
        self.launches = []


def stages_of(names: Sequence[str]) -> list[str]:
    """Return the stage of each kernel, given the names of all kernels in order."""
    stages: list[str] = []
    before, stage = "", ""  # the last kernel that is not torch's
    for name in names:
        found = _stage_of(name, before, stage)
        stages.append(found)
        if found != TORCH:
            before, stage = name, found
    return stages


def _stage_of(kernel: str, before: str, stage: str) -> str:
    if kernel.startswith("sort_"):
        return "tile sort" if stage in ("tile lists", "tile sort") else "depth sort"
    # A prefix sum is part of a sort, or it follows one and computes the first slot of each splat.
    if kernel.startswith("scan_"):
        return "tile lists" if before == "sort_scatter" else stage
    return next((name for name, prefixes in STAGES.items() if kernel.startswith(prefixes)), TORCH)


@dataclass(frozen=True)
class SceneTiming:
    """All stages of one scene, forward and backward."""

    stages: list[dict[str, Any]]  # each with ``stage``, ``median_ms`` and on CUDA ``launches``
    wall_ms: float  # without the profiler
    kernel_ms: float  # the sum of all kernels and copies


def time_stages(launcher: Launcher, scene: Scene, repeats: int) -> SceneTiming:
    """Return the times of all stages, as medians; the last two are ``TORCH`` and ``REST``.

    On CUDA, the profiler times kernels. Elsewhere, launches are timed. Raises :class:`NoKernelsError` if not
    every launch was seen.
    """
    clock, device = LaunchClock(launcher), scene.gaussians.device
    watch = profile if device.type == "cuda" else clock.watch
    plain, timed = KernelRasterizer(launcher), KernelRasterizer(clock)

    def run(rasterizer: Rasterizer) -> None:
        scene.zero_grad()
        scene.backward(scene.render(rasterizer))

    def time_kernels() -> dict[str, list[float]]:
        clock.reset()
        seen = watch(lambda: run(timed))
        times: dict[str, list[float]] = {stage: [] for stage in (*STAGES, TORCH)}
        for stage, kernel in zip(stages_of([kernel.name for kernel in seen]), seen, strict=True):
            times[stage].append(kernel.ms)
        if len(seen) - len(times[TORCH]) != len(clock.launches):
            raise NoKernelsError(f"torch.profiler has not seen all {len(clock.launches)} kernels")
        return times

    wall = median(in_turns({"": lambda: milliseconds(lambda: run(plain), device)}, repeats, warm_up=1)[""])
    samples = [time_kernels() for _ in range(repeats)]
    medians = {stage: median([sum(sample[stage]) for sample in samples]) for stage in samples[0]}
    return _timing(medians, wall, {stage: len(times) for stage, times in samples[-1].items()})


def time_cpu_stages(rasterizer: Rasterizer, scene: Scene, repeats: int) -> SceneTiming:
    """Return the times of all stages of ``rasterizer=cpu``, as medians; the last one is ``REST``."""
    device = scene.gaussians.device

    def run() -> dict[str, Any]:
        scene.zero_grad()
        begin = now(device)
        output = rasterizer.render(scene.gaussians, scene.cameras, scene.background)
        scene.backward((output.rgb, output.alpha, output.depth))
        wall = 1e3 * (now(device) - begin)
        # The node of the graph is the context of ``rasterizer/native.py``, which holds the pass.
        node: Any = output.rgb.grad_fn
        run = node.kernels
        seconds, counts = (ctypes.c_double * len(CPU_STAGES))(), (ctypes.c_int64 * 3)()
        run.kernels.cadam3d_measure(run.handle, seconds, counts)
        stages = {stage: 1e3 * each for stage, each in zip(CPU_STAGES, seconds, strict=True)}
        return {"wall": wall, "stages": stages}

    # The first passes get memory from the system.
    found = median(in_turns({"": run}, repeats, warm_up=2)[""])
    return _timing(found["stages"], found["wall"], {})


def _timing(medians: dict[str, float], wall: float, launches: dict[str, int]) -> SceneTiming:
    kernel_ms = sum(medians.values())
    rows: list[dict[str, Any]] = []
    for stage, ms in (medians | {REST: wall - kernel_ms}).items():
        counted = {"launches": launches.get(stage, 0)} if launches else {}
        rows.append({"stage": stage, **counted, "median_ms": ms})
    return SceneTiming(rows, wall, kernel_ms)
