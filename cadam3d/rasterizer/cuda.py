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
same bits.

The number of slots is counted on the device, where every later kernel reads it and compares it with the
``capacity``, the number that there is memory for. ``rasterize`` waits for the number and then reserves
exactly as much memory. ``rasterize_ahead`` reserves what a forecast says and does not wait. Both run the same
kernels in the same order. If the capacity is too small, all kernels behave as if there were no slots, and the
caller finds ``overflowed`` in the output.

Nearly all arrays are in a few blocks of memory (``workspace.py``). Those that the backward pass needs are
saved by autograd like any other tensor, so they are freed after it.

All views are processed together unless their records would fill more memory than ``record_memory`` allows. In
that case everything except the projection runs on one group of views after another, with the same bits.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.device import upload_together
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.io.cache import kernels_dir
from cadam3d.rasterizer import workspace
from cadam3d.rasterizer.base import Backend, Rasterizer
from cadam3d.rasterizer.cuda_sort import BLOCK, pieces, scan, scan_bytes, sort, sort_bytes, sort_order
from cadam3d.rasterizer.driver import Driver, Launch, Launcher
from cadam3d.rasterizer.forecast import Forecast, find_forecast
from cadam3d.rasterizer.native import RenderPass, require_shapes, run_pass
from cadam3d.rasterizer.workspace import Workspace, plan

# The kernels define the same constants (kernels/*.cuh).
PROJECT_BLOCK, BLEND_BLOCK, WARP = 128, 128, 32  # threads
TILE_WIDTH = 8  # pixels
SPLAT, RECORD, ABSOLUTES, CAMERA = 12, 10, 2, 25  # floats

DEPTH_BITS = 32
# The kernels count the pairs, slots and tiles of a group and the pixels of a view with 32 bits.
MOST = 2**31 - 1
# Bytes that the records of one group of views may always fill, and the share of the free memory that they may
# fill beyond. The tile lists and the sort need half as much as the records, at the same time. A group has at
# least one view, whatever that view needs.
RECORD_MEMORY = 256 * 2**20
RECORD_SHARE = 0.5
# With at most this number of tiles of 8x8 in a view, tiles are 8x4, which are more and have shorter lists.
# Otherwise most of a large GPU would have nothing to do (docs/notes/kernels.md has the arithmetic). The
# choice depends on the size of a view alone, so a batch has the bits of its single views on every device.
FEW_TILES = 1024


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

    def render_ahead(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render_ahead`. Raises :class:`UserError` as :meth:`render` does."""
        _refuse_others(gaussians.device)
        return rasterize_ahead(load_kernels(self.cache_dir), gaussians, cameras, background, absgrad)

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
    capacity: int | None = None,
    forecast: Forecast | None = None,
) -> RenderOutput:
    """Render with the kernels of ``launcher``; see :meth:`Rasterizer.render`.

    With a ``capacity``, memory is reserved for so many slots, and the host does not wait for their number.
    The ``forecast`` learns the number either way.
    """
    require_shapes(gaussians, cameras, background)
    n, pixels, device = len(gaussians), cameras.height * cameras.width, gaussians.device
    if max(n, pixels) > MOST:
        raise UserError(
            f"rasterizer=cuda: expected at most {MOST} Gaussians, and as many pixels in a view, got "
            f"{n} and {pixels}. Try: camera.size=512"
        )
    columns = (cameras.world_to_camera, cameras.intrinsics, background)
    matrices, intrinsics, background = upload_together(columns, device)
    cameras = replace(cameras, world_to_camera=matrices, intrinsics=intrinsics)
    kernels = _CudaPass(launcher, cameras, device, absgrad, capacity, forecast)
    return run_pass(kernels, gaussians, background)


def rasterize_ahead(
    launcher: Launcher,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "v 3"],
    absgrad: bool = False,
) -> RenderOutput:
    """Render with the kernels of ``launcher``; see :meth:`Rasterizer.render_ahead`."""
    v, n = len(cameras), len(gaussians)
    if v == 0 or n == 0:
        return rasterize(launcher, gaussians, cameras, background, absgrad)
    forecast = find_forecast(gaussians.device, v, cameras.height, cameras.width)
    capacity = forecast.capacity(n)
    tiles = count_tiles(cameras.height, cameras.width)
    # If the views may need several groups, their numbers of slots must be known. The slots of a single view
    # are counted too if there may not be enough memory for a forecast, which is larger than the number.
    if (
        capacity is None
        or capacity > most_slots(capacity, absgrad, gaussians.device)
        or v * max(n, tiles) > MOST
    ):
        capacity = None
    return rasterize(launcher, gaussians, cameras, background, absgrad, capacity, forecast)


class _CudaPass(RenderPass):
    """One call of the CUDA rasterizer; see :class:`RenderPass`."""

    launch: Launch
    # The arrays that live until the backward pass (``_frame_sizes``); their memory is in ``kept``.
    frame: Workspace
    # The addresses of the arrays of ``frame``.
    at: dict[str, int]
    # The addresses of the arrays that are needed until the tile lists are there (``_depth_sizes``).
    scratch: dict[str, int]
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
        forecast: Forecast | None = None,
    ) -> None:
        super().__init__(cameras, device, absgrad)
        self.tile_height = tile_height(self.height, self.width)
        # The number of tiles of one view.
        self.tiles = count_tiles(self.height, self.width)
        # The kernels of the blend that are for these tiles have this at the end of their name.
        self.size_of_tiles = f"{TILE_WIDTH}x{self.tile_height}"
        # The number of slots that memory is reserved for before it is known. None: the host waits for it.
        self.capacity = capacity
        # This learns the number of slots, if given.
        self.forecast = forecast
        self._launcher = launcher

    def __enter__(self) -> "_CudaPass":
        self._context = self._launcher.on(self.device)
        self.launch = self._context.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        """See :meth:`RenderPass.__exit__`."""
        super().__exit__()
        self.scratch_blocks = ()
        self._context.__exit__(None, None, None)

    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """See :meth:`RenderPass.project`; also reserves memory, and fills the arrays with a row per pair."""
        v, n, pixels = self.views, parameters[0].shape[0], self.height * self.width
        self.frame, scratch = _plan_pass(v, n, pixels, self.tiles, self.capacity, workspace.APART)
        self.kept, self.scratch_blocks = self.frame.allocate(self.device), scratch.allocate(self.device)
        self.at, self.scratch = self.frame.addresses(self.kept), scratch.addresses(self.scratch_blocks)
        views = (self.matrices.data_ptr(), self.intrinsics.data_ptr(), v, self.height, self.width)
        _launch_each(self.launch, "prepare_cameras", v, BLOCK, *views, self.at["cameras"])
        means2d, radii = self._project(parameters)
        if self.capacity is None:
            counts = self.frame.tensor(self.kept, "counts", torch.int32).view(v, n)
            self.read_slots = _start_reading(counts.sum(dim=1, dtype=torch.int64))
        return means2d, radii

    def _project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return ``means2d`` and ``radii``, and fill the splats, the depth keys and the counts of tiles."""
        means, *_, sh = parameters
        v, n, at = self.views, means.shape[0], self.at
        means2d, radii = means.new_empty(v, n, 2), means.new_empty(v, n)
        inputs = (*_addresses(parameters), at["cameras"], n, v, self.height, self.width, self.tile_height)
        on_screen = (means2d.data_ptr(), radii.data_ptr())
        results = (at["splats"], *on_screen, self.scratch["depth_keys"], at["counts"])
        kernel = f"project_forward_{sh.shape[1]}"
        _launch_each(self.launch, kernel, n, PROJECT_BLOCK, *inputs, *results)
        return means2d, radii

    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`RenderPass.blend`."""
        size, n = (self.views, self.height, self.width), parameters[0].shape[0]
        rgb, alpha, depth = (background.new_empty(*size, *channels) for channels in ((3,), (), ()))
        images = (rgb.data_ptr(), alpha.data_ptr(), depth.data_ptr())
        self.groups = []
        for group, lists in self._make_groups(parameters):
            inputs = self._blend_inputs(group, lists, n, background)
            pixel = group.views.start * self.height * self.width
            results = (images[0] + 12 * pixel, images[1] + 4 * pixel, images[2] + 4 * pixel)
            results += (self.at["transmittance"] + 4 * pixel, self.at["last"] + 4 * pixel)
            kernel = f"blend_forward_{self.size_of_tiles}"
            _launch_each(self.launch, kernel, group.tiles * WARP, BLEND_BLOCK, *inputs, *results)
            if keeps:
                self.groups.append(group)
        return rgb, alpha, depth

    def _make_groups(self, parameters: list[Tensor]) -> Iterator[tuple["_Group", dict[str, int]]]:
        """Yield groups of views, each with the addresses of its tile lists."""
        everything, n = slice(0, self.views), parameters[0].shape[0]
        if self.capacity is not None:
            self.overflowed = torch.empty((), dtype=torch.bool, device=self.device)
            self._order(everything, n)
            tiles = self.views * self.tiles
            yield self._list(
                _Group(everything, tiles, self.capacity, self.frame, slice(None)), n, self.scratch
            )
            return
        # One view is always one group, so its depths can be sorted before the host waits.
        is_ordered = self.views == 1
        if is_ordered:
            self._order(everything, n)
        counted = self.read_slots()
        if self.forecast is not None:
            self.forecast.learn(sum(counted), n)
        for views, slots in self._split(counted, n):
            if not is_ordered:
                self._order(views, n)
            tiles = (views.stop - views.start) * self.tiles
            lists, scratch = _plan_lists(tiles, slots, workspace.APART)
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
        most = most_slots(sum(slots), self.absgrad, self.device)
        return _split_views(slots, most, MOST // max(n, self.tiles))

    def _order(self, views: slice, n: int) -> None:
        """Sort the pairs of some views by depth, and number their slots in that order."""
        at, scratch = self.at, self.scratch
        pairs, first = (views.stop - views.start) * n, 4 * views.start * n
        order, total = scratch["order"], at["totals"] + 4 * views.start
        sort_order(self.launch, scratch["depth_keys"] + first, order, pairs, DEPTH_BITS, _temporary(scratch))
        sums, counts = scratch["offsets"], at["counts"] + first
        scan(self.launch, counts, sums, pairs, scratch["sums_of_chunks"], order, total)

    def _list(self, group: "_Group", n: int, scratch: dict[str, int]) -> tuple["_Group", dict[str, int]]:
        """Fill the tile lists of a group of views whose pairs are in order; return it and their addresses."""
        at, lists, ordered = self.at, group.addresses(self.kept), self.scratch
        v, first = group.views.stop - group.views.start, 4 * group.views.start * n
        total, capacity = at["totals"] + 4 * group.views.start, group.capacity
        tile_keys, ranges = scratch["tile_keys"], lists["ranges"]
        order = (ordered["order"], at["counts"] + first, ordered["offsets"], total, capacity, v * n, n)
        inputs = (*order, at["splats"] + SPLAT * first, v, self.height, self.width, self.tile_height)
        results = (tile_keys, lists["pair_of_slot"], at["first_slot"] + first, ranges)
        overflowed = 0 if self.overflowed is None else self.overflowed.data_ptr()
        is_ahead = self.capacity is not None
        report = self.forecast.report.data_ptr() if is_ahead and self.forecast is not None else 0
        # At least one thread is needed to clear the ranges.
        threads = max(v * n, 1)
        _launch_each(self.launch, "tile_list", threads, BLOCK, *inputs, *results, overflowed, report)
        bits, temporary = group.tiles.bit_length(), _temporary(scratch)
        keys = sort(self.launch, tile_keys, lists["slots"], capacity, bits, temporary, total)
        _launch_each(self.launch, "tile_ranges", capacity, BLOCK, keys, total, capacity, ranges)
        return group, lists

    def _blend_inputs(
        self, group: "_Group", lists: dict[str, int], n: int, background: Tensor
    ) -> tuple[int, ...]:
        first, where = (
            group.views.start,
            (lists["slots"], lists["pair_of_slot"], lists["ranges"], group.tiles),
        )
        splats, behind = self.at["splats"] + 4 * SPLAT * first * n, background.data_ptr() + 12 * first
        return (splats, *where, behind, self.height, self.width)

    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor | None]:
        """See :meth:`RenderPass.blend_backward`."""
        means, *_, sh = parameters
        v, n, launch = self.views, means.shape[0], self.launch
        slots = max((group.capacity for group in self.groups), default=0)
        plan = _plan_records(slots, n, self.absgrad, len(self.groups) > 1, workspace.APART)
        blocks = plan.allocate(self.device)
        at, scratch = self.frame.addresses(self.kept), plan.addresses(blocks)
        self.at = at
        absgrad = means.new_empty(v, n, 2) if self.absgrad else None
        grads = [means.new_empty(v, n, 2), *(torch.empty_like(tensor) for tensor in parameters)]
        inputs, results = (*_addresses(parameters), at["cameras"], n, v), _addresses(grads)
        alpha, depth, grad_rgb, grad_alpha, grad_depth = images
        records, axes = scratch["records"], scratch["axes"] if len(self.groups) > 1 else 0
        kernel = f"project_backward_{sh.shape[1]}"
        for group in self.groups:
            first, total, capacity = group.views.start, at["totals"] + 4 * group.views.start, group.capacity
            pixel, pair = first * self.height * self.width, first * n
            seen = (
                *(_at(alpha, 4 * pixel), _at(depth, 4 * pixel)),
                *(at["transmittance"] + 4 * pixel, at["last"] + 4 * pixel),
                *(_at(grad_rgb, 12 * pixel), _at(grad_alpha, 4 * pixel), _at(grad_depth, 4 * pixel)),
            )
            blend = (*self._blend_inputs(group, group.addresses(self.kept), n, background), *seen, records)
            # One more warp clears the slots that belong to no tile.
            warps = (group.tiles + 1) * WARP
            if absgrad is None:
                _launch_each(launch, f"blend_backward_{self.size_of_tiles}", warps, BLEND_BLOCK, *blend)
            else:
                apart, absolute = scratch["absolutes"], f"blend_backward_absolute_{self.size_of_tiles}"
                _launch_each(launch, absolute, warps, BLEND_BLOCK, *blend, apart)
                pairs = (group.views.stop - first) * n
                which = (
                    at["splats"] + 4 * SPLAT * pair,
                    at["first_slot"] + 4 * pair,
                    at["counts"] + 4 * pair,
                )
                sums = (total, capacity, apart, *which, _at(absgrad, 8 * pair))
                _launch_each(launch, "sum_absolutes", pairs, BLOCK, pairs, *sums)
            sums = (at["first_slot"], at["counts"], total, capacity, records, axes)
            arguments = (*inputs, first, group.views.stop, *sums, *results)
            _launch_each(launch, kernel, n, PROJECT_BLOCK, *arguments)
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


@lru_cache
def _plan_pass(
    v: int, n: int, pixels: int, tiles: int, capacity: int | None, apart: bool
) -> tuple[Workspace, Workspace]:
    """Return the arrays that live until the backward pass, and those that live until there are tile lists.

    Without a capacity, the arrays with a row per slot are left out.
    """
    frame, scratch = _frame_sizes(v, n, pixels), _depth_sizes(v * n)
    if capacity is not None:
        frame |= _list_sizes(v * tiles, capacity)
        slots = _tile_sizes(v * tiles, capacity)
        # Both sorts use the same temporary arrays, one after the other.
        scratch = {name: max(scratch.get(name, 0), slots.get(name, 0)) for name in scratch | slots}
    return plan(frame, apart), plan(scratch, apart)


@lru_cache
def _plan_lists(tiles: int, slots: int, apart: bool) -> tuple[Workspace, Workspace]:
    """Return the tile lists of a group, and the arrays that are needed to make them."""
    return plan(_list_sizes(tiles, slots), apart), plan(_tile_sizes(tiles, slots), apart)


@lru_cache
def _plan_records(slots: int, n: int, absgrad: bool, has_groups: bool, apart: bool) -> Workspace:
    """Return the arrays that only the backward pass needs."""
    sizes = {
        "records": 4 * RECORD * slots,
        "absolutes": 4 * ABSOLUTES * slots * absgrad,
        # Gradients of the axes of each Gaussian, summed over the groups so far.
        "axes": 36 * n * has_groups,
    }
    return plan(sizes, apart)


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


def _temporary_sizes(sizes: Sequence[int]) -> dict[str, int]:
    return {f"temporary {number}": size for number, size in enumerate(sizes)}


def _temporary(scratch: dict[str, int]) -> list[int]:
    """Return the addresses of the temporary arrays of the sort."""
    return [address for name, address in scratch.items() if name.startswith("temporary")]


def tile_height(height: int, width: int) -> int:
    """Return the height of the tiles in pixels: 8, or 4 if those would be few."""
    return 4 if pieces(height, 8) * pieces(width, TILE_WIDTH) <= FEW_TILES else 8


def count_tiles(height: int, width: int) -> int:
    """Return the number of tiles of one view."""
    return pieces(height, tile_height(height, width)) * pieces(width, TILE_WIDTH)


def most_slots(wanted: int, absgrad: bool, device: torch.device) -> int:
    """Return the largest number of slots in a group of more than one view, if there are ``wanted`` in all."""
    size = 4 * (RECORD + ABSOLUTES * absgrad)
    return min(record_memory(size * wanted, device) // size, MOST)


def record_memory(wanted: int, device: torch.device) -> int:
    """Return the bytes that the records of one group of views may fill, if all records need ``wanted`` bytes.

    The free memory includes what torch has reserved and does not use. To ask for it does not wait for the
    device, but takes as long as some launches, so small scenes do not ask.
    """
    if device.type != "cuda" or wanted <= RECORD_MEMORY:
        return RECORD_MEMORY
    unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return max(RECORD_MEMORY, int(RECORD_SHARE * (torch.cuda.mem_get_info(device)[0] + unused)))


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
        launch(kernel, pieces(count, threads), threads, *arguments)
