"""The reference rasterizer: the image formation model in pure torch, for any dtype and any device.

All other backends are compared with it. It is EWA splatting (Zwicker et al. 2001) as 3DGS uses it (Kerbl et
al. 2023, sec. 4-5), with the constants of :mod:`cadam3d.rasterizer.base`. At a pixel with offset ``d`` from a
projected mean, where ``W`` whitens the blurred 2D covariance, the model is:

* ``raw = opacity * exp(-|W d|^2 / 2)``; ``alpha = min(raw, ALPHA_MAX)``, or 0 where ``raw < ALPHA_MIN``;
* front to back ``w = alpha T``, ``T <- T (1 - alpha)``, until ``T`` would fall to ``TRANSMITTANCE_MIN``;
* ``rgb = sum(w color) + (1 - sum(w)) background``, ``alpha = sum(w)``, ``depth = sum(w z) / sum(w)``.

It is fast because splats are binned into square tiles, tiles with about equally many splats are stacked into
dense blocks ``tiles x splats x pixels``, and each block is composited at once. No block is kept for the
backward pass, which evaluates it again, so memory grows with the number of (splat, tile) pairs.

On a CPU the bits are always the same. The code contains no matrix product, because a user may have lowered
its precision, and no sum in an unspecified order.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.core.sh import evaluate_sh
from cadam3d.rasterizer.base import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR,
    FAR,
    FRUSTUM_MARGIN,
    NEAR,
    TRANSMITTANCE_MIN,
    Rasterizer,
    absgrad_probe,
)

TILE = 8  # pixels along the edge of a tile
# This many (splat, pixel) pairs are composited at once: a few arrays of this size fit into the caches.
BLOCK = 2**17
# A Gaussian is culled if the squared length of its quaternion is smaller: it has no direction.
QUAT_SQUARE_MIN = 1e-12


@dataclass(frozen=True, kw_only=True)
class ReferenceRasterizer(Rasterizer):
    """Defines the images and gradients that every backend must reproduce. It has no hyper-parameters.

    It works in the dtype and on the device of the Gaussians, and converts cameras and background. On a CPU
    every run gives the same bits; on CUDA it does not, because sums use atomics. There are no second
    derivatives.
    """

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`."""
        assert background.shape == (len(cameras), 3), "one background colour per view"
        like = gaussians.means
        with torch.autocast(like.device.type, enabled=False):
            views = _views(cameras.to(like.dtype).to(like.device))
            splats = [_splat(gaussians, view) for view in views]
            means2d = torch.stack([s.on_rows(s.projection.means2d) for s in splats])
            if torch.is_grad_enabled():
                means2d.requires_grad_().retain_grad()
            probe = absgrad_probe(means2d, absgrad)
            probes = [None] * len(views) if probe is None else list(probe)
            sums = [_composite(*each) for each in zip(means2d, probes, splats, views, strict=True)]
            color, depth, alpha = torch.stack(sums).split([3, 1, 1], dim=-1)
            return RenderOutput(
                rgb=color + (1 - alpha) * background.to(like)[:, None, None],
                alpha=alpha[..., 0],
                # Wherever a splat contributes, alpha >= ALPHA_MIN, so the lower bound only avoids 0 / 0.
                depth=(depth / alpha.clamp_min(ALPHA_MIN / 2))[..., 0],
                means2d=means2d,
                radii=torch.stack([s.on_rows(s.half_sizes.amax(dim=1)) for s in splats]),
                absgrad=probe,
            )


@dataclass(frozen=True)
class _View:
    rotation: Float[Tensor, "3 3"]  # world to camera
    translation: Float[Tensor, "3"]
    intrinsics: Float[Tensor, "3 3"]  # pixels
    position: Float[Tensor, "3"]  # world units
    height: int
    width: int


@dataclass(frozen=True)
class _Projection:
    """Gaussians projected onto the image plane of one view."""

    means2d: Float[Tensor, "m 2"]  # pixels
    depths: Float[Tensor, "m"]  # camera z, world units
    variances: Float[Tensor, "m 2"]  # pixels^2, along image x and y, blur included
    determinants: Float[Tensor, "m"]  # of the 2D covariance, pixels^4
    whitening: Float[Tensor, "m 3"]  # W = [[w0, w1], [0, w2]], 1 / pixels; W^T W inverts the 2D covariance


@dataclass(frozen=True)
class _Splats:
    """The visible Gaussians of one view, nearest first; ties in row order."""

    n: int  # number of all Gaussians, visible or not
    rows: Int[Tensor, "m"]  # row of each visible Gaussian
    half_sizes: Float[Tensor, "m 2"]  # pixels; of the box around the ellipse of alpha >= ALPHA_MIN
    projection: _Projection
    opacities: Float[Tensor, "m"]
    colors: Float[Tensor, "m 3"]

    def on_rows(self, values: Float[Tensor, "m *c"]) -> Float[Tensor, "n *c"]:
        """Return one value per Gaussian, which is 0 for those that are not visible."""
        return values.new_zeros((self.n, *values.shape[1:])).index_copy(0, self.rows, values)


def _views(cameras: Cameras) -> list[_View]:
    each = zip(cameras.world_to_camera, cameras.intrinsics, cameras.positions, strict=True)
    return [
        _View(matrix[:3, :3], matrix[:3, 3], intrinsics, position, cameras.height, cameras.width)
        for matrix, intrinsics, position in each
    ]


def _splat(gaussians: Gaussians, view: _View) -> _Splats:
    rows, half_sizes = _see(gaussians, view)
    seen = gaussians.map(lambda tensor: tensor.index_select(0, rows))
    directions = torch.nn.functional.normalize(seen.means - view.position, dim=-1)
    return _Splats(
        n=len(gaussians),
        rows=rows,
        half_sizes=half_sizes,
        projection=_project(seen, view),
        opacities=seen.opacities,
        colors=evaluate_sh(seen.sh, directions),
    )


@torch.no_grad()
def _see(gaussians: Gaussians, view: _View) -> tuple[Int[Tensor, "m"], Float[Tensor, "m 2"]]:
    """Return the rows and half-sizes of the visible Gaussians, nearest first.

    Autograd never processes the other Gaussians, so their gradients are zero, never NaN. Each test is
    written such that NaN fails it.
    """
    projection = _project(gaussians, view)
    # In standard deviations; NaN for a Gaussian that is too faint.
    reach = torch.log(gaussians.opacities / ALPHA_MIN).mul(2).sqrt()
    half_sizes = reach[:, None] * projection.variances.sqrt()
    squares = (gaussians.quats * gaussians.quats).sum(dim=-1)
    size = half_sizes.new_tensor([view.width, view.height])
    is_finite = torch.ones_like(squares, dtype=torch.bool)
    for tensor in (*gaussians.tensors().values(), half_sizes, projection.determinants):
        is_finite &= tensor.isfinite().reshape(len(gaussians), math.prod(tensor.shape[1:])).all(dim=1)
    has_direction = squares >= QUAT_SQUARE_MIN
    is_in_range = (projection.depths > NEAR) & (projection.depths < FAR)
    has_extent = (half_sizes > 0).all(dim=1)
    means2d = projection.means2d
    is_on_screen = ((means2d + half_sizes > 0) & (means2d - half_sizes < size)).all(dim=1)
    rows = (is_finite & has_direction & is_in_range & has_extent & is_on_screen).nonzero()[:, 0]
    rows = rows[projection.depths[rows].argsort(stable=True)]
    return rows, half_sizes[rows]


def _project(gaussians: Gaussians, view: _View) -> _Projection:
    """Return the EWA projection of every Gaussian, including those that are not visible."""
    x, y, z = ((view.rotation * gaussians.means[:, None, :]).sum(dim=-1) + view.translation).unbind(dim=-1)
    x, y = x / z, y / z
    focal, center = view.intrinsics.diagonal()[:2], view.intrinsics[:2, 2]
    # The columns are the axes of each Gaussian, scaled by their standard deviations. ``deviations`` holds the
    # same three vectors along image x and y, in pixels (J R S).
    axes = gaussians.rotations * gaussians.scales[:, None, :]
    deviations = []
    for axis, slope, size in ((0, x, view.width), (1, y, view.height)):
        low = (-FRUSTUM_MARGIN * size - center[axis]) / focal[axis]
        high = ((1 + FRUSTUM_MARGIN) * size - center[axis]) / focal[axis]
        jacobian = view.rotation[axis] - slope.clamp(low, high)[:, None] * view.rotation[2]
        deviations.append((focal[axis] / z)[:, None] * (jacobian[:, :, None] * axes).sum(dim=1))
    along_x, along_y = deviations
    square_x, square_y = (along_x * along_x).sum(dim=-1), (along_y * along_y).sum(dim=-1)
    variance_x, variance_y = square_x + BLUR, square_y + BLUR
    covariance = (along_x * along_y).sum(dim=-1)
    # By Lagrange's identity this is variance_x * variance_y - covariance**2, without its cancellation. It is
    # always positive.
    cross = torch.linalg.cross(along_x, along_y, dim=-1)
    determinant = (cross * cross).sum(dim=-1) + BLUR * (square_x + square_y) + BLUR**2
    # One over the standard deviation along x at a given y.
    across = (variance_y / determinant).sqrt()
    return _Projection(
        means2d=torch.stack([x, y], dim=-1) * focal + center,
        depths=z,
        variances=torch.stack([variance_x, variance_y], dim=-1),
        determinants=determinant,
        whitening=torch.stack([across, -covariance / variance_y * across, variance_y.rsqrt()], dim=-1),
    )


def _composite(
    means2d: Float[Tensor, "n 2"], probe: Float[Tensor, "n 2"] | None, splats: _Splats, view: _View
) -> Float[Tensor, "h w 5"]:
    """Return the weighted sums over the splats of each pixel: of red, green, blue, camera z and 1."""
    tiles_x, tiles_y = -(-view.width // TILE), -(-view.height // TILE)
    means2d = means2d.index_select(0, splats.rows)
    blocks = list(_blocks(means2d.detach(), splats.half_sizes, tiles_x, tiles_y))
    columns = (splats.opacities[:, None], splats.colors, splats.projection.depths[:, None])
    table = torch.cat([means2d, splats.projection.whitening, *columns], dim=1)
    probe = None if probe is None else probe.index_select(0, splats.rows)
    sums = _Blend.apply(table, probe, blocks, tiles_x, tiles_y)
    image = sums.view(tiles_y, tiles_x, 5, TILE, TILE).permute(0, 3, 1, 4, 2)
    return image.reshape(tiles_y * TILE, tiles_x * TILE, 5)[: view.height, : view.width]


@dataclass(frozen=True)
class _Block:
    """Tiles with about equally many splats, and the splats of each, nearest first."""

    tiles: Int[Tensor, "b"]  # row-major tile numbers
    # Shorter lists are padded with the number of splats, an index that belongs to no splat.
    splats: Int[Tensor, "b l"]


def _blocks(
    means2d: Float[Tensor, "m 2"], half_sizes: Float[Tensor, "m 2"], tiles_x: int, tiles_y: int
) -> Iterator[_Block]:
    """Yield the tiles that the depth-ordered splats touch in blocks, those with the most splats first."""
    splats, lengths = _bin(means2d, half_sizes, tiles_x, tiles_y)
    starts = lengths.cumsum(0) - lengths
    by_length = lengths.argsort(descending=True, stable=True)
    host = [length for length in lengths[by_length].tolist() if length > 0]
    done = 0
    while done < len(host):
        count = min(max(1, BLOCK // (host[done] * TILE**2)), len(host) - done)
        tiles = by_length[done : done + count]
        rank = torch.arange(host[done], device=splats.device)
        slots = (starts[tiles, None] + rank).clamp_max(splats.shape[0] - 1)
        is_filled = rank < lengths[tiles, None]
        yield _Block(tiles=tiles, splats=torch.where(is_filled, splats[slots], means2d.shape[0]))
        done += count


def _bin(
    means2d: Float[Tensor, "m 2"], half_sizes: Float[Tensor, "m 2"], tiles_x: int, tiles_y: int
) -> tuple[Int[Tensor, "e"], Int[Tensor, "t"]]:
    """Return the splats of each tile, nearest first, one tile after another, and their number per tile.

    A splat belongs to every tile that its box touches.
    """
    grid = torch.tensor([tiles_x, tiles_y], device=means2d.device)
    # The boxes are closed and the pixel centres are half a pixel inside a tile, so rounding loses no pixel.
    first = ((means2d - half_sizes) / TILE).floor().clamp_min(0).minimum(grid).long()
    last = ((means2d + half_sizes) / TILE).floor().clamp_min(-1).minimum(grid - 1).long()
    span = (last - first + 1).clamp_min(0)
    counts = span.prod(dim=1)
    splats = torch.arange(means2d.shape[0], device=means2d.device).repeat_interleave(counts)
    nth = torch.arange(splats.shape[0], device=splats.device) - (counts.cumsum(0) - counts)[splats]
    column = first[splats, 0] + nth % span[splats, 0]
    row = first[splats, 1] + nth // span[splats, 0]
    # A stable sort keeps the nearest splat of each tile first.
    tiles, order = (row * tiles_x + column).sort(stable=True)
    return splats[order], torch.bincount(tiles, minlength=tiles_x * tiles_y)


class _Blend(torch.autograd.Function):
    """Maps a table of splats (mean 2, whitening 3, opacity, features 4) to weighted sums at every pixel.

    ``probe`` does not change the result. If it is not ``None``, its gradient is ``absgrad``.
    """

    @staticmethod
    def forward(
        ctx, table: Tensor, probe: Tensor | None, blocks: list[_Block], tiles_x: int, tiles_y: int
    ) -> Tensor:
        ctx.save_for_backward(table)
        ctx.blocks, ctx.tiles_x = blocks, tiles_x
        sums = table.new_zeros(tiles_x * tiles_y, 5, TILE**2)
        for block in blocks:
            sums[block.tiles] = _Shading(table, block, tiles_x).sums()
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (table,) = ctx.saved_tensors
        rows, width = table.shape
        wants_absolute = ctx.needs_input_grad[1]
        width += 2 * wants_absolute
        # The last row collects the gradients of the padding, which belong to no splat: see _Block.splats.
        total = table.new_zeros((rows + 1) * width)
        for block in ctx.blocks:
            partial = _Shading(table, block, ctx.tiles_x).backward(grads[0][block.tiles], wants_absolute)
            slots = block.splats[..., None] * width + torch.arange(width, device=table.device)
            # On a CPU, a one-dimensional index_add_ adds in order.
            total.index_add_(0, slots.flatten(), partial.flatten())
        total = total.view(rows + 1, width)[:-1]
        absolute = total[:, table.shape[1] :] if wants_absolute else None
        return total[:, : table.shape[1]], absolute, None, None, None


class _Shading:
    """Evaluates each splat of a block at each pixel of its tile; tensors are ``tiles x splats x pixels``."""

    def __init__(self, table: Tensor, block: _Block, tiles_x: int) -> None:
        # The padding refers to one more splat, which is all zero and therefore transparent.
        padded = torch.nn.functional.pad(table, (0, 0, 0, 1))
        rows = padded.index_select(0, block.splats.flatten()).view(*block.splats.shape, 1, -1)
        mean_x, mean_y, self.w_xx, self.w_xy, self.w_yy, opacity, *self.features = rows.unbind(dim=-1)
        pixel = torch.arange(TILE**2, device=table.device)
        x = block.tiles[:, None] % tiles_x * TILE + pixel % TILE + 0.5
        y = block.tiles[:, None] // tiles_x * TILE + pixel // TILE + 0.5
        self.dx, self.dy = x.to(table)[:, None] - mean_x, y.to(table)[:, None] - mean_y
        # (x, y) is W d, the offset in standard deviations.
        self.x = (self.w_xx * self.dx).addcmul_(self.w_xy, self.dy)
        self.y = self.w_yy * self.dy
        self.falloff = (self.x * self.x).addcmul_(self.y, self.y).mul_(-0.5).exp_()
        raw = opacity * self.falloff
        is_bright = _as_number(torch.ge, raw, ALPHA_MIN)
        is_free = _as_number(torch.le, raw, ALPHA_MAX)
        self.alpha = raw.clamp_max(ALPHA_MAX) * is_bright
        self.clear = 1 - self.alpha
        after = self.clear.cumprod(dim=1)
        # T never rises, so one comparison finds the splat that would bring it too low and all behind it.
        is_reached = _as_number(torch.gt, after, TRANSMITTANCE_MIN)
        self.before = after / self.clear
        self.weight = self.alpha * self.before * is_reached
        # 1 where alpha depends on raw and is used, else 0.
        self.passes = is_bright.mul_(is_free).mul_(is_reached)

    def sums(self) -> Float[Tensor, "b 5 p"]:
        """Return the weighted sums of the features and of 1 over the splats."""
        weighted = [(self.weight * feature).sum(dim=1) for feature in self.features]
        return torch.stack([*weighted, self.weight.sum(dim=1)], dim=1)

    def backward(self, grad: Float[Tensor, "b 5 p"], wants_absolute: bool) -> Float[Tensor, "b l c"]:
        """Return the gradient of the table from the gradient of the sums, summed over the pixels of a tile.

        With ``wants_absolute``, two more columns contain the sums of the absolute values of what each pixel
        adds to the first two columns.

        With ``value_i = grad . (feature_i, 1)`` the gradient is
        ``dL/dalpha_i = T_i value_i - sum(w_j value_j for j > i) / (1 - alpha_i)``.
        Because ``T_i (1 - alpha_i) = T_i - w_i``, it equals
        ``(T_i value_i - sum(w_j value_j for j >= i)) / (1 - alpha_i)``, which needs one running sum from the
        back.
        """
        *grad_features, grad_one = grad[:, :, None].unbind(dim=1)
        value = grad_one.expand_as(self.weight).clone()
        for feature, grad_feature in zip(self.features, grad_features, strict=True):
            value.addcmul_(feature, grad_feature)
        onward = (self.weight * value).flip(1).cumsum(dim=1).flip(1)
        grad_raw = (self.before * value).sub_(onward).div_(self.clear).mul_(self.passes)
        # ``pull`` is -dL/d(|W d|^2 / 2).
        pull = grad_raw * self.alpha
        pull_x, pull_y = pull * self.x, pull * self.y
        sum_x, sum_y = pull_x.sum(dim=-1), pull_y.sum(dim=-1)
        absolute = ()
        if wants_absolute:
            along_x, along_y = pull_x * self.w_xx, (pull_x * self.w_xy).addcmul_(pull_y, self.w_yy)
            absolute = (along_x.abs_().sum(dim=-1), along_y.abs_().sum(dim=-1))
        return torch.stack(
            [
                sum_x * self.w_xx[..., 0],
                sum_x * self.w_xy[..., 0] + sum_y * self.w_yy[..., 0],
                -(pull_x * self.dx).sum(dim=-1),
                -(pull_x * self.dy).sum(dim=-1),
                -(pull_y * self.dy).sum(dim=-1),
                (grad_raw * self.falloff).sum(dim=-1),
                *((self.weight * grad_feature).sum(dim=-1) for grad_feature in grad_features),
                *absolute,
            ],
            dim=-1,
        )


def _as_number(compare: Callable[..., Tensor], x: Tensor, bound: float) -> Tensor:
    # 1.0 or 0.0 in the dtype of x, which on a CPU is ten times faster than a boolean mask and `where`.
    return compare(x, bound, out=torch.empty_like(x))
