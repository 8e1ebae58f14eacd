"""The CUDA rasterizer: kernels of our own, compiled at run time.

A frame goes through these kernels (``kernels/*.cuh``), all views at once:

* ``project_forward``: splats, and a depth key per (view, Gaussian) pair; who is culled has the largest key;
* a stable radix sort of the pairs by depth, which also moves the culled ones out of the way;
* ``tile_count``, a prefix sum, ``tile_list``: a slot per (splat, tile), numbered in depth order;
* a stable radix sort of the slots by tile, ``tile_ranges``: a list per tile, nearest splat first;
* ``blend_forward``: a warp per tile.

Backward is ``blend_backward``, which leaves a record in each slot, and ``project_backward``, which sums the
slots of each Gaussian in order. There are no float atomics: the same input gives the same bits. The host
waits for the device once, to learn how many slots there are.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.build import default_cache_dir
from cadam3d.rasterizer.native import Frame, render_frame, require_shapes

# Mirrors of kernels/*.cuh
BLOCK, PROJECT_BLOCK, BLEND_BLOCK, WARP = 256, 128, 128, 32  # threads
TILE = 8  # pixels along the edge of a tile
SPLAT, RECORD, CAMERA = 12, 10, 25  # floats
SCAN_CHUNK, SORT_CHUNK, RADIX_BITS = 2048, 4096, 8

DEPTH_BITS = 32
SCAN_SHORT = 8 * SCAN_CHUNK  # up to here one block scans it all, faster than three launches
MOST = 2**31 - 1  # pairs, slots or pixels: their numbers have 32 bits

# A kernel, how many blocks of how many threads, and its arguments: a tensor is its address, None is null.
Launch = Callable[..., None]


class Launcher(ABC):
    """Where kernels run: on a GPU, or in the emulator of the tests."""

    @abstractmethod
    def on(self, device: torch.device) -> AbstractContextManager[Launch]:
        """Yield ``launch(kernel, blocks, threads, *arguments)`` for ``device`` and its current stream."""


@dataclass(frozen=True, kw_only=True)
class CudaRasterizer(Rasterizer):
    """Renders in float32 on a CUDA device; the bits are the same on every run.

    Other dtypes are converted on the way in and out, and autocast is off inside. The kernels are compiled by
    the NVRTC that comes with torch, at the first use of a kind of device.
    """

    cache_dir: str | None  # where compiled kernels are kept; None: the user's cache folder

    def render(
        self, gaussians: Gaussians, cameras: Cameras, background: Float[Tensor, "v 3"]
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`. Raises :class:`UserError` off CUDA, or if nothing can compile."""
        if gaussians.device.type != "cuda":
            raise UserError(f"rasterizer=cuda cannot render on {gaussians.device}. Try: rasterizer=auto")
        return rasterize(load_kernels(self.cache_dir), gaussians, cameras, background)


@cache
def load_kernels(cache_dir: str | None) -> Launcher:
    """The kernels on every CUDA device; compiled for a kind of device when one of them is first used."""
    from cadam3d.rasterizer.driver import Driver

    return Driver(Path(cache_dir).expanduser() if cache_dir else default_cache_dir())


def works_on(device: torch.device) -> bool:
    """Whether Gaussians on ``device`` can be rendered here: its kernels are compiled and loaded, to be sure.

    Raises :class:`UserError`, which says what is missing, if there is a CUDA device that cannot be served.
    """
    if device.type != "cuda" or not torch.cuda.is_available():
        return False
    with load_kernels(None).on(device):
        return True


def rasterize(
    launcher: Launcher, gaussians: Gaussians, cameras: Cameras, background: Float[Tensor, "v 3"]
) -> RenderOutput:
    """Render with the kernels at hand; see :meth:`Rasterizer.render`."""
    require_shapes(gaussians, cameras, background)
    v, n = len(cameras), len(gaussians)
    if max(v * n, v * cameras.height * cameras.width) > MOST:
        raise UserError(f"rasterizer=cuda: {v} views at once are too many. Try: fewer views, or fewer pixels")
    return render_frame(_Frame(launcher, cameras, gaussians.device), gaussians, background)


class _Frame(Frame):
    """See :class:`Frame`."""

    cameras: Tensor  # [v CAMERA]
    splats: Tensor  # [v n SPLAT]
    depth_keys: Tensor  # [v n]
    lists: "_Lists"
    transmittance: Tensor  # [v h w]; after the last splat
    last: Tensor  # [v h w]; 1 + rank of the last splat that reached the pixel

    def __init__(self, launcher: Launcher, cameras: Cameras, device: torch.device) -> None:
        super().__init__(cameras, device)
        self.launcher = launcher

    @property
    def tiles(self) -> int:
        """Of one view."""
        return _pieces(self.height, TILE) * _pieces(self.width, TILE)

    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """See :meth:`Frame.project`; fills the frame's splats."""
        means, *_, sh = parameters
        v, n = self.views, means.shape[0]
        self.cameras = means.new_empty(v, CAMERA)
        self.splats = means.new_empty(v, n, SPLAT)
        self.depth_keys = _integers(v * n, self.device)
        means2d, radii = means.new_empty(v, n, 2), means.new_empty(v, n)
        with self.launcher.on(self.device) as launch:
            views = (self.matrices, self.intrinsics, v, self.height, self.width, self.cameras)
            _launch_each(launch, "prepare_cameras", v, BLOCK, *views)
            kernel = f"project_forward_{sh.shape[1]}"
            results = (self.splats, means2d, radii, self.depth_keys)
            _launch_each(launch, kernel, n, PROJECT_BLOCK, *parameters, self.cameras, n, v, *results)
        return means2d, radii

    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`Frame.blend`; what the backward needs is small and always kept."""
        v, size = self.views, (self.views, self.height, self.width)
        rgb, alpha, depth = (background.new_empty(*size, *channels) for channels in ((3,), (), ()))
        self.transmittance, self.last = torch.empty_like(alpha), torch.empty_like(alpha, dtype=torch.int32)
        with self.launcher.on(self.device) as launch:
            self.lists = self._list(launch, parameters[0].shape[0])
            del self.depth_keys
            images = (rgb, alpha, depth, self.transmittance, self.last)
            threads, blend = v * self.tiles * WARP, (*self._blend_inputs(background), *images)
            _launch_each(launch, "blend_forward", threads, BLEND_BLOCK, *blend)
        return rgb, alpha, depth

    def _list(self, launch: Launch, n: int) -> "_Lists":
        """For every tile, the slots of the splats that touch it."""
        v, pairs, size = self.views, self.views * n, (self.height, self.width)
        keys, order = _sort(launch, self.depth_keys, DEPTH_BITS)
        counts = _integers(pairs, self.device)
        _launch_each(launch, "tile_count", pairs, BLOCK, keys, order, pairs, self.splats, *size, counts)
        offsets, total = _scan(launch, counts)
        slots = int(total)  # the one time the host waits
        if slots > MOST:
            raise UserError(f"rasterizer=cuda: {slots} (splat, tile) pairs are too many. Try: fewer views")
        tile_keys, pair_of_slot = _integers(slots, self.device), _integers(slots, self.device)
        first_slot, slot_count = _integers(pairs, self.device), _integers(pairs, self.device)
        inputs = (order, counts, offsets, pairs, n, self.splats, v, *size)
        results = (tile_keys, pair_of_slot, first_slot, slot_count)
        _launch_each(launch, "tile_list", pairs, BLOCK, *inputs, *results)
        keys, by_tile = _sort(launch, tile_keys, (v * self.tiles).bit_length())
        ranges = torch.zeros(v * self.tiles + 1, 2, dtype=torch.int32, device=self.device)
        _launch_each(launch, "tile_ranges", slots, BLOCK, keys, slots, ranges)
        return _Lists(by_tile, pair_of_slot, ranges, first_slot, slot_count)

    def _blend_inputs(self, background: Tensor) -> tuple[object, ...]:
        lists = (self.lists.slots, self.lists.pair_of_slot, self.lists.ranges)
        return (self.splats, *lists, self.views * self.tiles, background, self.height, self.width)

    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor]:
        """See :meth:`Frame.blend_backward`."""
        means, *_, sh = parameters
        v, n = self.views, means.shape[0]
        records = means.new_empty(self.lists.slots.shape[0], RECORD)
        grads = [means.new_empty(v, n, 2), *(torch.empty_like(tensor) for tensor in parameters)]
        alpha, depth, *grad_images = images
        with self.launcher.on(self.device) as launch:
            seen = (alpha, depth, self.transmittance, self.last, *grad_images)
            threads = (v * self.tiles + 1) * WARP  # one warp more for slots without a tile
            blend = (*self._blend_inputs(background), *seen, records)
            _launch_each(launch, "blend_backward", threads, BLEND_BLOCK, *blend)
            slots = (self.lists.first_slot, self.lists.slot_count, records)
            inputs = (*parameters, self.cameras, n, v, *slots)
            _launch_each(launch, f"project_backward_{sh.shape[1]}", n, PROJECT_BLOCK, *inputs, *grads)
        return grads

    def centre_backward(self, parameters: list[Tensor], radii: Tensor, grad_means2d: Tensor) -> Tensor:
        """See :meth:`Frame.centre_backward`."""
        means, grad_means = parameters[0], torch.empty_like(parameters[0])
        n = means.shape[0]
        with self.launcher.on(self.device) as launch:
            inputs = (means, self.cameras, n, self.views, radii, grad_means2d)
            _launch_each(launch, "centre_backward", n, BLOCK, *inputs, grad_means)
        return grad_means


@dataclass(frozen=True)
class _Lists:
    """Slots: one per (splat, tile), numbered in depth order."""

    slots: Tensor  # tile after tile, nearest first
    pair_of_slot: Tensor  # view * n + Gaussian
    ranges: Tensor  # [v tiles + 1, 2]; where in ``slots`` the list of a tile begins and ends
    first_slot: Tensor  # [v n]
    slot_count: Tensor  # [v n]


def _scan(launch: Launch, values: Tensor) -> tuple[Tensor, Tensor]:
    """Exclusive prefix sums of 32-bit numbers, and their 64-bit total."""
    n, sums = values.shape[0], torch.empty_like(values)
    total = torch.zeros(1, dtype=torch.int64, device=values.device)
    if n <= SCAN_SHORT:
        launch("scan_short", 1, BLOCK, values, n, sums, total)
        return sums, total
    chunks = _pieces(n, SCAN_CHUNK)
    of_chunks = torch.empty(chunks, dtype=torch.int64, device=values.device)
    launch("scan_reduce", chunks, BLOCK, values, n, of_chunks)
    launch("scan_sums", 1, BLOCK, of_chunks, chunks, total)
    launch("scan_apply", chunks, BLOCK, values, n, of_chunks, sums)
    return sums, total


def _sort(launch: Launch, keys: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Sorted unsigned keys of so many bits, and where each was; equal keys keep their order."""
    n, chunks, order = keys.shape[0], _pieces(keys.shape[0], SORT_CHUNK), None
    if n == 0:
        return keys, keys
    for shift in range(0, bits, RADIX_BITS):
        counts = _integers(2**RADIX_BITS * chunks, keys.device)
        launch("sort_count", chunks, BLOCK, keys, n, shift, chunks, counts)
        positions, _ = _scan(launch, counts)
        sorted_keys, sorted_order = torch.empty_like(keys), torch.empty_like(keys)
        inputs = (keys, order, n, shift, chunks, positions)
        launch("sort_scatter", chunks, BLOCK, *inputs, sorted_keys, sorted_order)
        keys, order = sorted_keys, sorted_order
    assert order is not None, "keys have at least one bit"
    return keys, order


def _launch_each(launch: Launch, kernel: str, count: int, threads: int, *arguments: object) -> None:
    """At least ``count`` threads, or no launch at all."""
    if count > 0:
        launch(kernel, _pieces(count, threads), threads, *arguments)


def _pieces(count: int, size: int) -> int:
    return -(-count // size)


def _integers(count: int, device: torch.device) -> Tensor:
    return torch.empty(count, dtype=torch.int32, device=device)  # the kernels take the bits as unsigned
