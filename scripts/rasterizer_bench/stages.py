"""The stages of the CUDA rasterizer: the time that the GPU spends in their kernels, beside a floor.

Kernels are timed by the GPU itself, through ``torch.profiler``. Clocks around the launches would include the
time in which an idle GPU waits for the host, which takes longer than a short kernel.

The floor of a stage is the number of bytes that it must read and write at least once, divided by the measured
speed of a plain copy. It considers bandwidth alone, so a stage that computes much per byte, as both blends
do, stays far above it. It also assumes that no tile becomes opaque before the end of its list.
"""

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
from cadam3d.rasterizer import cuda, cuda_sort
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
# Kernels and copies of torch, such as filling and adding.
TORCH = "torch"
# The wall clock without all kernels: the GPU waits for the host.
REST = "rest"
# The size of a float and of an index.
WORD = 4  # bytes
SPLAT, RECORD = WORD * cuda.SPLAT, WORD * cuda.RECORD


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
        # The number of (splat, tile) pairs since ``launches`` was emptied.
        self.slots = 0

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`."""
        with self._inner.on(device) as launch:
            yield partial(self._launch, launch)

    def _launch(self, launch: Launch, kernel: str, blocks: int, threads: int, *arguments) -> None:
        if kernel == "tile_ranges":
            self.slots += arguments[2]
        begin = time.perf_counter()
        launch(kernel, blocks, threads, *arguments)
        self.launches.append(Kernel(kernel, (time.perf_counter() - begin) * 1e3))

    def watch(self, work: Callable[[], object]) -> list[Kernel]:
        """Return the launches of ``work``."""
        self.reset()
        work()
        return self.launches

    def reset(self) -> None:
        """Forget all launches."""
        self.launches, self.slots = [], 0


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
class Load:
    """The amount of work in one render."""

    gaussians: int
    coefficients: int  # of spherical harmonics
    views: int
    visible: int  # visible (view, Gaussian) pairs
    slots: int  # (splat, tile) pairs
    pixels: int  # of all views
    tiles: int  # of all views

    @property
    def pairs(self) -> int:
        """Return the number of (view, Gaussian) pairs."""
        return self.views * self.gaussians


def sorted_bytes(items: int, bits: int) -> int:
    """Return the bytes that a sort reads and writes, apart from counts: a model, not a measurement.

    A pass reads the keys for counting, reads keys and values for moving them, and writes both. The first pass
    has no values to read. Few keys are counted by each block, which reads them from a cache. The sort of
    depths does not write the sorted keys.
    """
    passes, counts = len(cuda_sort.digit_bits(bits)), items > cuda_sort.FEW_NUMBERS
    return WORD * items * (passes * (4 + counts) - 1 - (bits == cuda.DEPTH_BITS))


def stage_bytes(load: Load) -> dict[str, int]:
    """Return the least bytes that each stage reads and writes: each number once, for all views together."""
    parameters = load.gaussians * WORD * (11 + 3 * load.coefficients)
    pairs, slots, pixels = load.pairs * WORD, load.slots, load.pixels
    # An entry of a tile's list: slot, pair and splat.
    entry = 2 * WORD + SPLAT
    return {
        # Per pair: the centre, the radius, the depth key and the count.
        "project": parameters + 5 * pairs + load.visible * SPLAT,
        "depth sort": sorted_bytes(load.pairs, cuda.DEPTH_BITS),
        # Prefix sum: in, out. List: order, count, offset, first slot; tile and pair of every slot.
        "tile lists": 6 * pairs + load.visible * SPLAT + slots * 2 * WORD,
        "tile sort": sorted_bytes(slots, load.tiles.bit_length()) + slots * WORD + load.tiles * 2 * WORD,
        # Rgb, alpha, depth, transmittance and last per pixel.
        "blend forward": slots * entry + pixels * 7 * WORD,
        # Alpha, depth, transmittance, last and five gradients per pixel.
        "blend backward": slots * (entry + RECORD) + pixels * 9 * WORD,
        # First slot, count and gradient of the centre; radius and that gradient again; means in and out.
        "project backward": 2 * parameters + slots * RECORD + 7 * pairs + load.gaussians * 6 * WORD,
    }


@dataclass(frozen=True)
class SceneTiming:
    """All stages of one scene, forward and backward."""

    # Each with its name, launches, ``median_ms``, and the least ``bytes`` and their time ``floor_ms``.
    stages: list[dict[str, Any]]
    wall_ms: float  # without the profiler
    kernel_ms: float  # the sum of all kernels and copies


def time_stages(launcher: Launcher, scene: Scene, repeats: int, bytes_per_ms: float) -> SceneTiming:
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
    kernel_ms = sum(medians.values())
    needed = stage_bytes(measure_load(plain, scene, clock.slots))
    rows = [
        {
            "stage": stage,
            "launches": len(samples[-1].get(stage, ())),
            "median_ms": ms,
            "bytes": needed.get(stage),
            "floor_ms": needed[stage] / bytes_per_ms if stage in needed else None,
        }
        for stage, ms in (medians | {REST: wall - kernel_ms}).items()
    ]
    return SceneTiming(rows, wall, kernel_ms)


def measure_load(rasterizer: Rasterizer, scene: Scene, slots: int) -> Load:
    """Return the amount of work of one render, given its number of (splat, tile) pairs."""
    with torch.no_grad():
        output = rasterizer.render(scene.gaussians, scene.cameras, scene.background)
    views, height, width = output.alpha.shape
    return Load(
        gaussians=len(scene.gaussians),
        coefficients=scene.gaussians.sh.shape[1],
        views=views,
        visible=int(output.visible.sum()),
        slots=slots,
        pixels=views * height * width,
        tiles=views * cuda.count_tiles(height, width),
    )


def copy_speed(device: torch.device, size: int) -> float:
    """Return the speed of the fastest of some copies of ``size`` bytes, in bytes per ms read and written."""
    source = torch.zeros(size, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    fastest = float("inf")
    for _ in range(8):
        start = now(device)
        target.copy_(source)
        fastest = min(fastest, now(device) - start)
    return 2 * size / (fastest * 1e3)
