"""The CUDA rasterizer: the project's own kernels, compiled at run time.

A forward pass runs these kernels (``kernels/*.cuh``):

* ``project_forward`` writes the splats, the number of tiles that each splat touches, and a depth key for each
  (view, Gaussian) pair; a culled pair gets the largest key;
* a stable radix sort orders the pairs by depth, which also moves the culled pairs to the end;
* a prefix sum and ``tile_list`` number one slot per (splat, tile) pair, in depth order;
* a stable radix sort of the slots by tile and ``tile_ranges`` produce one list per tile, nearest splat first;
* ``blend_forward`` blends each tile with one warp.

The backward pass runs ``blend_backward``, which writes one record into each slot, and ``project_backward``,
which sums the slots of each Gaussian in order. No kernel adds floats atomically, so the same input gives the
same bits. The host waits for the device once, to read the number of slots.

All views are processed together unless their records would fill more than ``RECORD_MEMORY``. In that case
everything except the projection runs on one group of views after another, with the same bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.io.cache import kernels_dir
from cadam3d.rasterizer.base import Backend, Rasterizer
from cadam3d.rasterizer.driver import Driver
from cadam3d.rasterizer.launcher import Launch, Launcher
from cadam3d.rasterizer.native import RenderPass, require_shapes, run_pass

# The kernels define the same constants (kernels/*.cuh).
BLOCK, PROJECT_BLOCK, BLEND_BLOCK, WARP = 256, 128, 128, 32  # threads
TILE = 8  # pixels along the edge of a tile
SPLAT, RECORD, ABSOLUTES, CAMERA = 12, 10, 2, 25  # floats
SCAN_CHUNK, SORT_CHUNK, RADIX_BITS = 2048, 4096, 8

DEPTH_BITS = 32
# One block scans up to this many numbers alone, which is faster than three launches.
SCAN_SHORT = 8 * SCAN_CHUNK
# The kernels count the pairs, slots and tiles of a group and the pixels of a view with 32 bits.
MOST = 2**31 - 1
# Bytes of the records of one group of views. A group has at least one view, whatever that view needs.
RECORD_MEMORY = 256 * 2**20


@dataclass(frozen=True, kw_only=True)
class CudaRasterizer(Rasterizer):
    """Renders in float32 on a CUDA device, with the same bits on every run.

    Other dtypes are converted on the way in and out, and autocast is off inside. The NVRTC that comes with
    torch compiles the kernels when a device of a new compute capability is first used.
    """

    cache_dir: str | None  # folder

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`.

        Raises :class:`UserError` if the Gaussians are not on a CUDA device or the kernels do not compile.
        """
        _refuse_others(gaussians.device)
        return rasterize(load_kernels(self.cache_dir), gaussians, cameras, background, absgrad)

    def prepare(self, device: torch.device) -> Backend:
        """See :meth:`Rasterizer.prepare`."""
        _refuse_others(device)
        if not torch.cuda.is_available():
            raise UserError("rasterizer=cuda: torch sees no CUDA device. Try: cadam3d doctor")
        with load_kernels(self.cache_dir).on(device):
            return super().prepare(device)


def _refuse_others(device: torch.device) -> None:
    if device.type != "cuda":
        raise UserError(f"rasterizer=cuda: expected a CUDA device, got {device}. Try: rasterizer=auto")


@cache
def load_kernels(cache_dir: str | None) -> Launcher:
    """Return the kernels for all CUDA devices; the first use of a device compiles and loads them."""
    return Driver(kernels_dir(cache_dir))


def rasterize(
    launcher: Launcher,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "v 3"],
    absgrad: bool = False,
) -> RenderOutput:
    """Render with the kernels of ``launcher``; see :meth:`Rasterizer.render`."""
    require_shapes(gaussians, cameras, background)
    pixels = cameras.height * cameras.width
    if max(len(gaussians), pixels) > MOST:
        raise UserError(
            f"rasterizer=cuda: expected at most {MOST} Gaussians, and as many pixels in a view, got "
            f"{len(gaussians)} and {pixels}. Try: camera.size=512"
        )
    return run_pass(_CudaPass(launcher, cameras, gaussians.device, absgrad), gaussians, background)


class _CudaPass(RenderPass):
    """One call of the CUDA rasterizer; see :class:`RenderPass`."""

    cameras: Tensor  # [v CAMERA]
    splats: Tensor  # [v n SPLAT]
    depth_keys: Tensor  # [v n]
    slot_count: Tensor  # [v n]
    first_slot: Tensor  # [v n]; counted from the first slot of the group
    groups: list["_Group"]
    transmittance: Tensor  # [v h w]; after the last splat
    last: Tensor  # [v h w]; 1 + rank of the last splat that reached the pixel

    def __init__(
        self, launcher: Launcher, cameras: Cameras, device: torch.device, absgrad: bool = False
    ) -> None:
        super().__init__(cameras, device, absgrad)
        self.launcher = launcher

    @property
    def tiles(self) -> int:
        """Return the number of tiles of one view."""
        return _pieces(self.height, TILE) * _pieces(self.width, TILE)

    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """See :meth:`RenderPass.project`; also fills ``splats``, ``depth_keys`` and ``slot_count``."""
        means, *_, sh = parameters
        v, n = self.views, means.shape[0]
        self.cameras = means.new_empty(v, CAMERA)
        self.splats = means.new_empty(v, n, SPLAT)
        self.depth_keys, self.slot_count, self.first_slot = (
            torch.empty(v, n, dtype=torch.int32, device=self.device) for _ in range(3)
        )
        means2d, radii = means.new_empty(v, n, 2), means.new_empty(v, n)
        with self.launcher.on(self.device) as launch:
            views = (self.matrices, self.intrinsics, v, self.height, self.width, self.cameras)
            _launch_each(launch, "prepare_cameras", v, BLOCK, *views)
            kernel = f"project_forward_{sh.shape[1]}"
            results = (self.splats, means2d, radii, self.depth_keys, self.slot_count)
            inputs = (*parameters, self.cameras, n, v, self.height, self.width)
            _launch_each(launch, kernel, n, PROJECT_BLOCK, *inputs, *results)
        return means2d, radii

    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`RenderPass.blend`."""
        size = (self.views, self.height, self.width)
        rgb, alpha, depth = (background.new_empty(*size, *channels) for channels in ((3,), (), ()))
        self.transmittance, self.last = torch.empty_like(alpha), torch.empty_like(alpha, dtype=torch.int32)
        images = (rgb, alpha, depth, self.transmittance, self.last)
        self.groups = []
        with self.launcher.on(self.device) as launch:
            for views, slots in self._split():
                group = self._list(launch, views, slots)
                inputs = self._blend_inputs(group, background)
                threads = group.tiles * WARP
                _launch_each(launch, "blend_forward", threads, BLEND_BLOCK, *inputs, *_of(views, images))
                if keeps:
                    self.groups.append(group)
        del self.depth_keys
        return rgb, alpha, depth

    def _split(self) -> list[tuple[slice, int]]:
        """Return the groups of views that are processed together, each with its number of slots."""
        # This is the only time that the host waits for the device.
        slots = self.slot_count.sum(dim=1, dtype=torch.int64).tolist()
        largest = max(slots, default=0)
        if largest > MOST:
            raise UserError(
                f"rasterizer=cuda: expected at most {MOST} (splat, tile) pairs in a view, got {largest}. "
                "Try: camera.size=512"
            )
        record = RECORD + ABSOLUTES * self.absgrad
        most_slots = min(RECORD_MEMORY // (4 * record), MOST)
        most_views = MOST // max(self.slot_count.shape[1], self.tiles)
        return _split_views(slots, most_slots, most_views)

    def _list(self, launch: Launch, views: slice, slots: int) -> "_Group":
        """Return the tile lists of a group of views, and fill ``first_slot`` for these views."""
        v, n = views.stop - views.start, self.slot_count.shape[1]
        tiles, counts = v * self.tiles, self.slot_count[views].flatten()
        _, order = _sort(launch, self.depth_keys[views].flatten(), DEPTH_BITS)
        offsets = _scan(launch, counts.index_select(0, order))
        tile_keys, pair_of_slot = _integers(slots, self.device), _integers(slots, self.device)
        inputs = (order, counts, offsets, v * n, n, self.splats[views], v, self.height, self.width)
        results = (tile_keys, pair_of_slot, self.first_slot[views])
        _launch_each(launch, "tile_list", v * n, BLOCK, *inputs, *results)
        keys, by_tile = _sort(launch, tile_keys, tiles.bit_length())
        ranges = torch.zeros(tiles + 1, 2, dtype=torch.int32, device=self.device)
        _launch_each(launch, "tile_ranges", slots, BLOCK, keys, slots, ranges)
        return _Group(views, tiles, by_tile, pair_of_slot, ranges)

    def _blend_inputs(self, group: "_Group", background: Tensor) -> tuple[object, ...]:
        splats, behind = _of(group.views, (self.splats, background))
        lists = (group.slots, group.pair_of_slot, group.ranges)
        return (splats, *lists, group.tiles, behind, self.height, self.width)

    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor | None]:
        """See :meth:`RenderPass.blend_backward`."""
        means, *_, sh = parameters
        v, n = self.views, means.shape[0]
        slots = max((group.slots.shape[0] for group in self.groups), default=0)
        records = means.new_empty(slots, RECORD)
        absolutes = means.new_empty(slots, ABSOLUTES) if self.absgrad else None
        absgrad = means.new_empty(v, n, 2) if self.absgrad else None
        grad_axes = means.new_empty(n, 9) if len(self.groups) > 1 else None
        grads = [means.new_empty(v, n, 2), *(torch.empty_like(tensor) for tensor in parameters)]
        alpha, depth, *grad_images = images
        seen = (alpha, depth, self.transmittance, self.last, *grad_images)
        with self.launcher.on(self.device) as launch:
            for group in self.groups:
                # One more warp clears the slots that belong to no tile.
                threads = (group.tiles + 1) * WARP
                blend = (*self._blend_inputs(group, background), *_of(group.views, seen), records)
                if absolutes is None:
                    _launch_each(launch, "blend_backward", threads, BLEND_BLOCK, *blend)
                else:
                    _launch_each(launch, "blend_backward_absolute", threads, BLEND_BLOCK, *blend, absolutes)
                    pairs = (group.views.stop - group.views.start) * n
                    which = _of(group.views, (self.splats, self.first_slot, self.slot_count, absgrad))
                    _launch_each(launch, "sum_absolutes", pairs, BLOCK, pairs, absolutes, *which)
                span = (v, group.views.start, group.views.stop)
                sums = (self.first_slot, self.slot_count, records, grad_axes)
                inputs = (*parameters, self.cameras, n, *span, *sums)
                _launch_each(launch, f"project_backward_{sh.shape[1]}", n, PROJECT_BLOCK, *inputs, *grads)
        grad_means2d, *others = grads
        return [grad_means2d, absgrad, *others]

    def centre_backward(self, parameters: list[Tensor], radii: Tensor, grad_means2d: Tensor) -> Tensor:
        """See :meth:`RenderPass.centre_backward`."""
        means, grad_means = parameters[0], torch.empty_like(parameters[0])
        n = means.shape[0]
        with self.launcher.on(self.device) as launch:
            inputs = (means, self.cameras, n, self.views, radii, grad_means2d)
            _launch_each(launch, "centre_backward", n, BLOCK, *inputs, grad_means)
        return grad_means


@dataclass(frozen=True)
class _Group:
    """Views that are processed together and their slots, one per (splat, tile), numbered in depth order."""

    views: slice
    tiles: int  # in all of these views together
    slots: Tensor  # tile after tile, nearest first
    pair_of_slot: Tensor  # (view - first view) * n + Gaussian
    ranges: Tensor  # [tiles + 1, 2]; begin and end of each tile's list in ``slots``


def _split_views(slots: list[int], most_slots: int, most_views: int) -> list[tuple[slice, int]]:
    """Return groups of consecutive views and their slots: as many views as fit, but at least one."""
    groups: list[tuple[slice, int]] = []
    for view, count in enumerate(slots):
        if groups:
            views, total = groups[-1]
            if total + count <= most_slots and view - views.start < most_views:
                groups[-1] = (slice(views.start, view + 1), total + count)
                continue
        groups.append((slice(view, view + 1), count))
    return groups


def _of(views: slice, tensors: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Return the part of each tensor that belongs to ``views``."""
    return [None if tensor is None else tensor[views] for tensor in tensors]


def _scan(launch: Launch, values: Tensor) -> Tensor:
    """Return exclusive prefix sums; the total must fit into 32 bits."""
    n, sums = values.shape[0], torch.empty_like(values)
    if n <= SCAN_SHORT:
        launch("scan_short", 1, BLOCK, values, n, sums)
        return sums
    chunks = _pieces(n, SCAN_CHUNK)
    of_chunks = _integers(chunks, values.device)
    launch("scan_reduce", chunks, BLOCK, values, n, of_chunks)
    launch("scan_short", 1, BLOCK, of_chunks, chunks, of_chunks)
    launch("scan_apply", chunks, BLOCK, values, n, of_chunks, sums)
    return sums


def _sort(launch: Launch, keys: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Return the sorted unsigned keys and their old positions; equal keys keep their order.

    Only the lowest ``bits`` bits of the keys are compared.
    """
    n, chunks, order = keys.shape[0], _pieces(keys.shape[0], SORT_CHUNK), None
    if n == 0:
        return keys, keys
    for shift in range(0, bits, RADIX_BITS):
        counts = _integers(2**RADIX_BITS * chunks, keys.device)
        launch("sort_count", chunks, BLOCK, keys, n, shift, chunks, counts)
        positions = _scan(launch, counts)
        sorted_keys, sorted_order = torch.empty_like(keys), torch.empty_like(keys)
        inputs = (keys, order, n, shift, chunks, positions)
        launch("sort_scatter", chunks, BLOCK, *inputs, sorted_keys, sorted_order)
        keys, order = sorted_keys, sorted_order
    assert order is not None, "keys have at least one bit"
    return keys, order


def _launch_each(launch: Launch, kernel: str, count: int, threads: int, *arguments: object) -> None:
    """Launch at least ``count`` threads, or nothing if ``count`` is 0."""
    if count > 0:
        launch(kernel, _pieces(count, threads), threads, *arguments)


def _pieces(count: int, size: int) -> int:
    return -(-count // size)


def _integers(count: int, device: torch.device) -> Tensor:
    # The kernels read the same bits as unsigned integers.
    return torch.empty(count, dtype=torch.int32, device=device)
