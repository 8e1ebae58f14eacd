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

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
from cadam3d.rasterizer.cuda_sort import BLOCK, scan, scan_bytes, sort, sort_bytes
from cadam3d.rasterizer.driver import Driver
from cadam3d.rasterizer.launcher import Launch, Launcher
from cadam3d.rasterizer.native import RenderPass, require_shapes, run_pass
from cadam3d.rasterizer.workspace import Workspace, plan

# The kernels define the same constants (kernels/*.cuh).
PROJECT_BLOCK, BLEND_BLOCK, WARP = 128, 128, 32  # threads
TILE = 8  # pixels along the edge of a tile
SPLAT, RECORD, ABSOLUTES, CAMERA = 12, 10, 2, 25  # floats

DEPTH_BITS = 32
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

    launch: Launch
    # Where the arrays are that live until the backward pass (``_frame_sizes``); their memory is in ``kept``.
    frame: Workspace
    # The arrays that are needed until the tile lists are there (``_depth_sizes``), and their memory.
    scratch: Workspace
    scratch_blocks: tuple[Tensor, ...] = ()
    # Returns the number of slots of each view, after waiting for the device.
    read_slots: Callable[[], list[int]]
    groups: list["_Group"]

    def __init__(
        self,
        launcher: Launcher,
        cameras: Cameras,
        device: torch.device,
        absgrad: bool = False,
        capacity: int | None = None,
    ) -> None:
        super().__init__(cameras, device, absgrad)
        self.launcher = launcher
        # The number of slots that memory is reserved for, before it is known. None: the host waits for it.
        self.capacity = capacity
        # Whether all views are expected to be one group, so that their depths can be sorted before the wait.
        self.expects_one_group = self.views == 1

    @contextmanager
    def running(self) -> Iterator[None]:
        """See :meth:`RenderPass.running`."""
        with self.launcher.on(self.device) as self.launch:
            yield

    @property
    def tiles(self) -> int:
        """Return the number of tiles of one view."""
        return _pieces(self.height, TILE) * _pieces(self.width, TILE)

    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """See :meth:`RenderPass.project`; also reserves memory, and fills the arrays with a row per pair."""
        means = parameters[0]
        v, n = self.views, means.shape[0]
        frame, scratch = _frame_sizes(v, n, self.height * self.width), _depth_sizes(v * n)
        if self.capacity is not None:
            frame |= _list_sizes(v * self.tiles, self.capacity)
            scratch = _merged(scratch, _tile_sizes(v * self.tiles, self.capacity))
        self.frame, self.scratch = plan(**frame), plan(**scratch)
        self.kept, self.scratch_blocks = self.frame.allocate(self.device), self.scratch.allocate(self.device)
        at = self.frame.addresses(self.kept)
        views = (self.matrices.data_ptr(), self.intrinsics.data_ptr(), v, self.height, self.width)
        _launch_each(self.launch, "prepare_cameras", v, BLOCK, *views, at["cameras"])
        means2d, radii = self._project(parameters)
        if self.capacity is None:
            counts = self.frame.tensor(self.kept, "counts", torch.int32).view(v, n)
            self.read_slots = _start_reading(counts.sum(dim=1, dtype=torch.int64))
        return means2d, radii

    def _project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return ``means2d`` and ``radii``, and fill the splats, the depth keys and the counts of tiles."""
        means, *_, sh = parameters
        v, n = self.views, means.shape[0]
        means2d, radii = means.new_empty(v, n, 2), means.new_empty(v, n)
        at, depths = self.frame.addresses(self.kept), self.scratch.addresses(self.scratch_blocks)
        inputs = (*_addresses(parameters), at["cameras"], n, v, self.height, self.width)
        results = (at["splats"], means2d.data_ptr(), radii.data_ptr(), depths["depth_keys"], at["counts"])
        kernel = f"project_forward_{sh.shape[1]}"
        _launch_each(self.launch, kernel, n, PROJECT_BLOCK, *inputs, *results)
        return means2d, radii

    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`RenderPass.blend`."""
        size = (self.views, self.height, self.width)
        rgb, alpha, depth = (background.new_empty(*size, *channels) for channels in ((3,), (), ()))
        n, pixels = parameters[0].shape[0], self.height * self.width
        self.groups = []
        for group in self._make_groups(parameters):
            first = group.views.start
            at = self.frame.addresses(self.kept)
            images = (
                rgb.data_ptr() + 12 * pixels * first,
                *(address + 4 * pixels * first for address in (alpha.data_ptr(), depth.data_ptr())),
                *(at[name] + 4 * pixels * first for name in ("transmittance", "last")),
            )
            inputs = self._blend_inputs(group, n, background)
            _launch_each(self.launch, "blend_forward", group.tiles * WARP, BLEND_BLOCK, *inputs, *images)
            if keeps:
                self.groups.append(group)
        self.scratch_blocks = ()
        return rgb, alpha, depth

    def _make_groups(self, parameters: list[Tensor]) -> Iterator["_Group"]:
        """Yield groups of views with their tile lists."""
        everything, n = slice(0, self.views), parameters[0].shape[0]
        if self.capacity is not None:
            self.overflowed = torch.empty((), dtype=torch.bool, device=self.device)
            self._order(everything, n)
            group = _Group(everything, self.views * self.tiles, self.capacity, self.frame, slice(None))
            yield self._list(group, n, self.scratch.addresses(self.scratch_blocks))
            return
        is_ordered = self.expects_one_group
        if is_ordered:
            self._order(everything, n)
        groups = self._split(self.read_slots(), n)
        if is_ordered and len(groups) > 1:
            # The guess was wrong, and sorting has overwritten the depth keys.
            self._project(parameters)
            is_ordered = False
        for views, slots in groups:
            if not is_ordered:
                self._order(views, n)
            tiles = (views.stop - views.start) * self.tiles
            lists, scratch = plan(**_list_sizes(tiles, slots)), plan(**_tile_sizes(tiles, slots))
            blocks, scratch_blocks = lists.allocate(self.device), scratch.allocate(self.device)
            where = slice(len(self.kept), len(self.kept) + len(blocks))
            self.kept += blocks
            group = _Group(views, tiles, slots, lists, where)
            yield self._list(group, n, scratch.addresses(scratch_blocks))

    def _split(self, slots: list[int], n: int) -> list[tuple[slice, int]]:
        """Return the groups of views that are processed together, each with its number of slots."""
        largest = max(slots, default=0)
        if largest > MOST:
            raise UserError(
                f"rasterizer=cuda: expected at most {MOST} (splat, tile) pairs in a view, got {largest}. "
                "Try: camera.size=512"
            )
        return _split_views(slots, most_slots(self.absgrad), MOST // max(n, self.tiles))

    def _order(self, views: slice, n: int) -> None:
        """Sort the pairs of some views by depth, and number their slots in that order."""
        at, depths = self.frame.addresses(self.kept), self.scratch.addresses(self.scratch_blocks)
        pairs, first = (views.stop - views.start) * n, 4 * views.start * n
        order, total = depths["order"], at["totals"] + 4 * views.start
        sort(self.launch, depths["depth_keys"] + first, order, pairs, DEPTH_BITS, _temporary(depths))
        sums = (at["counts"] + first, depths["offsets"], pairs, depths["sums_of_chunks"], order, total)
        scan(self.launch, *sums)

    def _list(self, group: "_Group", n: int, scratch: dict[str, int]) -> "_Group":
        """Fill the tile lists of a group of views whose pairs are in order; return the group."""
        at, depths = self.frame.addresses(self.kept), self.scratch.addresses(self.scratch_blocks)
        lists = group.addresses(self.kept)
        v, first = group.views.stop - group.views.start, 4 * group.views.start * n
        counted = (at["totals"] + 4 * group.views.start, group.capacity)
        tile_keys, ranges = scratch["tile_keys"], lists["ranges"]
        order = (depths["order"], at["counts"] + first, depths["offsets"], *counted, v * n, n)
        inputs = (*order, at["splats"] + SPLAT * first, v, self.height, self.width)
        results = (tile_keys, lists["pair_of_slot"], at["first_slot"] + first, ranges)
        overflowed = 0 if self.overflowed is None else self.overflowed.data_ptr()
        # At least one thread is needed to clear the ranges.
        _launch_each(self.launch, "tile_list", max(v * n, 1), BLOCK, *inputs, *results, overflowed, 0)
        bits, temporary = group.tiles.bit_length(), _temporary(scratch)
        keys = sort(self.launch, tile_keys, lists["slots"], group.capacity, bits, temporary, counted[0])
        _launch_each(self.launch, "tile_ranges", group.capacity, BLOCK, keys, *counted, ranges)
        return group

    def _blend_inputs(self, group: "_Group", n: int, background: Tensor) -> tuple[int, ...]:
        at, lists, first = self.frame.addresses(self.kept), group.addresses(self.kept), group.views.start
        where = (lists["slots"], lists["pair_of_slot"], lists["ranges"], group.tiles)
        behind = background.data_ptr() + 12 * first
        return (at["splats"] + 4 * SPLAT * first * n, *where, behind, self.height, self.width)

    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor | None]:
        """See :meth:`RenderPass.blend_backward`."""
        means, *_, sh = parameters
        v, n, pixels = self.views, means.shape[0], self.height * self.width
        slots = max((group.capacity for group in self.groups), default=0)
        scratch = plan(**_record_sizes(slots, n, self.absgrad, len(self.groups) > 1))
        blocks = scratch.allocate(self.device)
        at, temporary = self.frame.addresses(self.kept), scratch.addresses(blocks)
        records, axes = temporary["records"], temporary["axes"] if len(self.groups) > 1 else 0
        absgrad = means.new_empty(v, n, 2) if self.absgrad else None
        grads = [means.new_empty(v, n, 2), *(torch.empty_like(tensor) for tensor in parameters)]
        inputs = (*_addresses(parameters), at["cameras"], n, v)
        results = _addresses(grads)
        alpha, depth, grad_rgb, grad_alpha, grad_depth = images
        for group in self.groups:
            first, counted = group.views.start, (at["totals"] + 4 * group.views.start, group.capacity)
            images_here = (
                *(_at(image, 4 * pixels * first) for image in (alpha, depth)),
                *(at[name] + 4 * pixels * first for name in ("transmittance", "last")),
                _at(grad_rgb, 12 * pixels * first),
                *(_at(image, 4 * pixels * first) for image in (grad_alpha, grad_depth)),
            )
            blend = (*self._blend_inputs(group, n, background), *images_here, records)
            # One more warp clears the slots that belong to no tile.
            threads = (group.tiles + 1) * WARP
            if absgrad is None:
                _launch_each(self.launch, "blend_backward", threads, BLEND_BLOCK, *blend)
            else:
                kernel, apart = "blend_backward_absolute", temporary["absolutes"]
                _launch_each(self.launch, kernel, threads, BLEND_BLOCK, *blend, apart)
                pairs = (group.views.stop - first) * n
                which = (at["splats"] + 4 * SPLAT * first * n, at["first_slot"] + 4 * first * n)
                which += (at["counts"] + 4 * first * n, _at(absgrad, 8 * first * n))
                _launch_each(self.launch, "sum_absolutes", pairs, BLOCK, pairs, *counted, apart, *which)
            sums = (at["first_slot"], at["counts"], *counted, records, axes)
            arguments = (*inputs, first, group.views.stop, *sums, *results)
            _launch_each(self.launch, f"project_backward_{sh.shape[1]}", n, PROJECT_BLOCK, *arguments)
        grad_means2d, *others = grads
        return [grad_means2d, absgrad, *others]

    def centre_backward(self, parameters: list[Tensor], radii: Tensor, grad_means2d: Tensor) -> Tensor:
        """See :meth:`RenderPass.centre_backward`."""
        means, grad_means = parameters[0], torch.empty_like(parameters[0])
        cameras, n = self.frame.addresses(self.kept)["cameras"], means.shape[0]
        inputs = (means.data_ptr(), cameras, n, self.views, radii.data_ptr(), grad_means2d.data_ptr())
        _launch_each(self.launch, "centre_backward", n, BLOCK, *inputs, grad_means.data_ptr())
        return grad_means


@dataclass(frozen=True)
class _Group:
    """Views that are processed together and their slots, one per (splat, tile), numbered in depth order."""

    views: slice
    tiles: int  # in all of these views together
    capacity: int  # slots that there is room for
    lists: Workspace  # see ``_list_sizes``
    blocks: slice  # of the memory that is kept

    def addresses(self, kept: tuple[Tensor, ...]) -> dict[str, int]:
        """Return the addresses of the lists."""
        return self.lists.addresses(kept[self.blocks])


def _frame_sizes(v: int, n: int, pixels: int) -> dict[str, int]:
    """Return the bytes of the arrays that live until the backward pass, apart from the tile lists."""
    return {
        "cameras": 4 * CAMERA * v,
        "splats": 4 * SPLAT * v * n,
        # The number of slots of each pair, and its first slot, counted from the first one of the group.
        "counts": 4 * v * n,
        "first_slot": 4 * v * n,
        # The number of slots of each group, at the place of the first view of the group.
        "totals": 4 * v,
        # Of each pixel, after the last splat, and 1 + rank of the last splat that reached it.
        "transmittance": 4 * v * pixels,
        "last": 4 * v * pixels,
    }


def _list_sizes(tiles: int, capacity: int) -> dict[str, int]:
    """Return the bytes of the tile lists of a group, which live until the backward pass."""
    return {
        # The begin and end of the list of each tile in ``slots``; one more list is of no tile.
        "ranges": 8 * (tiles + 1),
        # Tile after tile, nearest first.
        "slots": 4 * capacity,
        # (view - first view) * n + Gaussian
        "pair_of_slot": 4 * capacity,
    }


def _depth_sizes(pairs: int) -> dict[str, int]:
    """Return the bytes of the arrays that bring the pairs in order."""
    return {
        "depth_keys": 4 * pairs,
        "order": 4 * pairs,
        "offsets": 4 * pairs,
        "sums_of_chunks": scan_bytes(pairs),
        **_temporary_sizes(sort_bytes(pairs, DEPTH_BITS)),
    }


def _tile_sizes(tiles: int, capacity: int) -> dict[str, int]:
    """Return the bytes of the arrays that bring the slots in order."""
    temporary = _temporary_sizes(sort_bytes(capacity, tiles.bit_length()))
    return {"tile_keys": 4 * capacity, **temporary}


def _record_sizes(slots: int, n: int, absgrad: bool, has_groups: bool) -> dict[str, int]:
    """Return the bytes of the arrays that only the backward pass needs."""
    return {
        "records": 4 * RECORD * slots,
        "absolutes": 4 * ABSOLUTES * slots * absgrad,
        # Gradients of the axes of each Gaussian, summed over the groups so far.
        "axes": 36 * n * has_groups,
    }


def _temporary_sizes(sizes: Sequence[int]) -> dict[str, int]:
    return {f"temporary {number}": size for number, size in enumerate(sizes)}


def _temporary(scratch: dict[str, int]) -> list[int]:
    """Return the addresses of the temporary arrays of the sort."""
    return [address for name, address in scratch.items() if name.startswith("temporary")]


def _merged(one: dict[str, int], other: dict[str, int]) -> dict[str, int]:
    """Return all arrays of both. One that both have is used twice, one use after the other."""
    return {name: max(one.get(name, 0), other.get(name, 0)) for name in one | other}


def most_slots(absgrad: bool) -> int:
    """Return the largest number of slots in a group of more than one view."""
    return min(RECORD_MEMORY // (4 * (RECORD + ABSOLUTES * absgrad)), MOST)


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


def _start_reading(numbers: Tensor) -> Callable[[], list[int]]:
    """Copy numbers to the host without waiting, and return a function that waits for them."""
    if numbers.device.type != "cuda":
        return numbers.tolist
    copy = torch.empty_like(numbers, device="cpu", pin_memory=True)
    copy.copy_(numbers, non_blocking=True)
    arrival = torch.cuda.Event()
    arrival.record()

    def read() -> list[int]:
        arrival.synchronize()
        return copy.tolist()

    return read


def _addresses(tensors: Sequence[Tensor]) -> list[int]:
    return [tensor.data_ptr() for tensor in tensors]


def _at(tensor: Tensor | None, offset: int) -> int:
    """Return an address some bytes into a tensor, or 0 without a tensor."""
    return 0 if tensor is None else tensor.data_ptr() + offset


def _launch_each(launch: Launch, kernel: str, count: int, threads: int, *arguments: int) -> None:
    """Launch at least ``count`` threads, or nothing if ``count`` is 0."""
    if count > 0:
        launch(kernel, _pieces(count, threads), threads, *arguments)


def _pieces(count: int, size: int) -> int:
    return -(-count // size)
