"""Time the stages of the CUDA rasterizer: each launch is measured by two events and compared with a floor.

The floor of a stage is the number of bytes that it must read and write at least once, divided by the measured
speed of a plain copy. It considers bandwidth alone, so a stage that computes much per byte, as both blends
do, stays far above it. It also assumes that no tile becomes opaque before the end of its list.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from rasterizer_bench.scenes import Scene
from rasterizer_bench.timing import now
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer import cuda, cuda_sort
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cuda import rasterize
from cadam3d.rasterizer.launcher import Launch, Launcher

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
# The time outside of launches: allocation, autograd, the host and one wait for the device.
REST = "rest"
# The size of a float and of an index.
WORD = 4  # bytes
SPLAT, RECORD = WORD * cuda.SPLAT, WORD * cuda.RECORD


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


@dataclass(frozen=True)
class Span:
    """One launch, between two events."""

    kernel: str
    stage: str
    begin: object
    end: object


class StageClock(Launcher):
    """Passes every launch on and records when it began and ended."""

    def __init__(self, inner: Launcher) -> None:
        self._inner = inner
        self.spans: list[Span] = []
        # The number of (splat, tile) pairs since ``spans`` was emptied.
        self.slots = 0

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`."""
        with self._inner.on(device) as launch:
            yield partial(self._launch, launch, _event if device.type == "cuda" else time.perf_counter)

    def _launch(
        self, launch: Launch, mark: Callable[[], object], kernel: str, blocks: int, threads: int, *arguments
    ) -> None:
        if kernel == "tile_ranges":
            self.slots += arguments[2]
        begin = mark()
        launch(kernel, blocks, threads, *arguments)
        stage = stage_of(kernel, self.spans[-1] if self.spans else None)
        self.spans.append(Span(kernel, stage, begin, mark()))

    def take(self) -> tuple[dict[str, float], dict[str, int]]:
        """Return milliseconds and launches by stage since the last call; the device must be idle."""
        times, launches = dict.fromkeys(STAGES, 0.0), dict.fromkeys(STAGES, 0)
        for span in self.spans:
            times[span.stage] = times.get(span.stage, 0.0) + _milliseconds(span)
            launches[span.stage] = launches.get(span.stage, 0) + 1
        self.spans.clear()
        self.slots = 0
        return times, launches


def stage_of(kernel: str, before: Span | None) -> str:
    """Return the stage of a launch, given the previous launch; an unknown kernel is a separate stage."""
    stage = before.stage if before else ""
    if kernel.startswith("sort_"):
        return "tile sort" if stage in ("tile lists", "tile sort") else "depth sort"
    # A prefix sum is part of a sort, or it follows one and computes the first slot of each splat.
    if kernel.startswith("scan_"):
        return "tile lists" if before and before.kernel == "sort_scatter" else stage
    return next((name for name, prefixes in STAGES.items() if kernel.startswith(prefixes)), kernel)


def _event() -> torch.cuda.Event:
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def _milliseconds(span: Span) -> float:
    if isinstance(span.begin, torch.cuda.Event):
        return span.begin.elapsed_time(span.end)
    return (span.end - span.begin) * 1e3


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
    """Return the bytes of a sort. The sort of depths does not write the sorted keys."""
    return cuda_sort.sorted_bytes(items, bits, only_order=bits == cuda.DEPTH_BITS)


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
class StageTiming:
    """One stage of one scene."""

    stage: str
    launches: int
    median_ms: float
    bytes: int | None  # None for ``REST``
    floor_ms: float | None  # None for ``REST``


def time_stages(launcher: Launcher, scene: Scene, repeats: int, bytes_per_ms: float) -> list[StageTiming]:
    """Return the times of all stages, forward and backward; the last one is ``REST``."""
    clock, device = StageClock(launcher), scene.gaussians.device
    rasterizer, samples = KernelRasterizer(clock), []
    launches, slots = {}, 0
    for _ in range(repeats + 1):
        scene.zero_grad()
        start = now(device)
        scene.backward(scene.render(rasterizer))
        wall = (now(device) - start) * 1e3
        slots = clock.slots
        times, launches = clock.take()
        samples.append(times | {REST: wall - sum(times.values())})
    needed = stage_bytes(measure_load(rasterizer, scene, slots))
    return [
        StageTiming(
            stage,
            launches.get(stage, 0),
            # The first sample warms up and is not counted.
            statistics.median(times[stage] for times in samples[1:]),
            needed.get(stage),
            needed[stage] / bytes_per_ms if stage in needed else None,
        )
        for stage in samples[-1]
    ]


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
