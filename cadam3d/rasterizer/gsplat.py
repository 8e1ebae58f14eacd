"""The gsplat rasterizer: nerfstudio's CUDA library behind the interface of this project.

One call of ``gsplat.rasterization`` renders all views. Its image formation is ours, except that alpha is
capped at 0.999 instead of ``ALPHA_MAX``. This file translates the conventions:

* raw tensors become activations, and Gaussians that are not finite are hidden, because gsplat draws NaN;
* radii become exact, so that the same Gaussians count as seen in each view as with every other backend;
* ``means2d`` stays the node of gsplat's graph, and the garbage in rows that were not seen becomes zeros;
* absolute gradients, an attribute in gsplat, become the gradient of a tensor of zeros.

gsplat is optional and is imported at the first use. It may then compile its kernels for minutes.
"""

import math
import sys
import weakref
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import ALPHA_MIN, BLUR, FAR, NEAR, Backend, Rasterizer, absgrad_probe
from cadam3d.rasterizer.native import plain, require_shapes
from cadam3d.rasterizer.reference import QUAT_SQUARE_MIN, ReferenceRasterizer

# ``gsplat.rasterization``: from Gaussians and cameras to images, alphas and a dict of intermediate results.
Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]

TILE = 16  # pixels along the edge of a tile; gsplat tests no other number
# The fourth power of a splat's size must fit into float32, or gsplat draws NaN.
SIZE_MAX = 1e9  # pixels


@dataclass(frozen=True, kw_only=True)
class GsplatRasterizer(Rasterizer):
    """Renders in float32 on a CUDA device with the package ``gsplat``.

    Other dtypes are converted on the way in and out, except ``means2d``, and autocast is off inside.
    Gradients are summed with atomics, so their last bits change from run to run.
    """

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`.

        Raises :class:`UserError` if the Gaussians are not on a CUDA device, or if gsplat is missing or has
        no kernels.
        """
        return rasterize(load_rasterization(gaussians.device), gaussians, cameras, background, absgrad)

    def prepare(self, device: torch.device) -> Backend:
        """See :meth:`Rasterizer.prepare`."""
        load_rasterization(device)
        return super().prepare(device)


@cache
def load_rasterization(device: torch.device) -> Rasterization:
    """Return ``gsplat.rasterization``, with kernels that run on ``device``.

    The first call of a process may compile them. Raises :class:`UserError` if that is not possible.
    """
    if device.type != "cuda":
        raise UserError(f"rasterizer=gsplat: expected a CUDA device, got {device}. Try: rasterizer=auto")
    if not torch.cuda.is_available():
        raise UserError("rasterizer=gsplat: torch sees no CUDA device. Try: cadam3d doctor")
    if find_spec("gsplat") is None:
        raise UserError(
            "rasterizer=gsplat: expected the package gsplat, got none. Try: pip install '.[gsplat]'"
        )
    try:
        # gsplat reports about its build on the standard output, which belongs to the results of a command.
        with redirect_stdout(sys.stderr):
            gsplat = import_module("gsplat")
            # The first kernel that is needed compiles or loads all of them.
            turn, scale = torch.ones(1, 4, device=device), torch.ones(1, 3, device=device)
            gsplat.quat_scale_to_covar_preci(turn, scale, compute_preci=False)
            # A kernel that was compiled for another GPU is reported only now.
            torch.cuda.synchronize(device)
            return gsplat.rasterization
    except Exception as error:
        # A build may raise anything.
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise UserError(
            "rasterizer=gsplat: expected kernels that load, or the CUDA toolkit (nvcc) to compile them once, "
            f"got {reason}. Try: rasterizer=cuda"
        ) from error


def rasterize(
    rasterization: Rasterization,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "v 3"],
    absgrad: bool = False,
) -> RenderOutput:
    """Render with ``gsplat.rasterization``, which is an argument so that tests can replace it.

    See :meth:`Rasterizer.render`.
    """
    require_shapes(gaussians, cameras, background)
    if len(gaussians) == 0:
        # gsplat 1.5.3 divides by the number of Gaussians, which ends the process.
        return ReferenceRasterizer().render(gaussians, cameras, background, absgrad)
    dtype, device = gaussians.means.dtype, gaussians.device
    with torch.autocast(device.type, enabled=False):
        intrinsics = plain(cameras.intrinsics, device)
        floats = gaussians.map(lambda tensor: plain(tensor, device))
        is_drawable = _drawable(floats, intrinsics)
        # Ones are valid everywhere, and the rows that are not drawn get no gradient.
        shown = floats.map(
            lambda tensor: torch.where(is_drawable.view(-1, *[1] * (tensor.ndim - 1)), tensor, 1.0)
        )
        opacities = torch.where(is_drawable, shown.opacities, 0.0)
        probe = absgrad_probe(floats.means.new_empty(len(cameras), len(gaussians), 2), absgrad)
        tap = _Tap()
        images, alphas, info = rasterization(
            means=_differentiable(tap.attach(shown.means, probe)),
            # Squares of long quaternions might leave the range of float32. Their length has no effect.
            quats=shown.quats / shown.quats.detach().abs().amax(dim=-1, keepdim=True),
            scales=shown.scales,
            opacities=opacities,
            colors=shown.sh,
            viewmats=plain(cameras.world_to_camera, device),
            Ks=intrinsics,
            width=cameras.width,
            height=cameras.height,
            near_plane=NEAR,
            far_plane=FAR,
            radius_clip=0.0,
            eps2d=BLUR,
            sh_degree=gaussians.sh_degree,
            packed=False,
            tile_size=TILE,
            backgrounds=plain(background, device),
            render_mode="RGB+ED",
            absgrad=probe is not None,
            rasterize_mode="classic",
            camera_model="pinhole",
        )
        tap.means2d = weakref.ref(info["means2d"])
        return RenderOutput(
            rgb=images[..., :3].to(dtype),
            alpha=alphas[..., 0].to(dtype),
            depth=images[..., 3].to(dtype),
            means2d=_centres(info),
            radii=_radii(info, opacities.detach(), cameras.height, cameras.width).to(dtype),
            absgrad=probe,
        )


@torch.no_grad()
def _drawable(gaussians: Gaussians, intrinsics: Float[Tensor, "v 3 3"]) -> Bool[Tensor, "n"]:
    """Return the mask of the Gaussians with which gsplat can compute; the interface culls all others.

    Each test is written such that NaN fails it.
    """
    squares = gaussians.quats.square().sum(dim=-1)
    focal = intrinsics.diagonal(dim1=1, dim2=2)[:, :2].amax()
    is_small = gaussians.log_scales < (SIZE_MAX * NEAR / focal).log()
    is_within = gaussians.means.abs() < FAR
    is_drawable = (squares >= QUAT_SQUARE_MIN) & is_small.all(dim=1) & is_within.all(dim=1)
    for tensor in gaussians.tensors().values():
        is_drawable &= tensor.isfinite().reshape(len(gaussians), math.prod(tensor.shape[1:])).all(dim=1)
    return is_drawable


def _differentiable(means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return the means such that ``means2d`` has a gradient, even if no Gaussian requires one."""
    if means.requires_grad or not torch.is_grad_enabled():
        return means
    return means.detach().requires_grad_()


class _Tap:
    """Passes the absolute gradients, an attribute of gsplat's ``means2d``, on to the probe of a render."""

    # Weak, because the graph that ends at the centres contains this object.
    means2d: weakref.ref[Tensor]

    def attach(
        self, means: Float[Tensor, "n 3"], probe: Float[Tensor, "v n 2"] | None
    ) -> Float[Tensor, "n 3"]:
        """Return the means, with ``probe`` beside them in the graph."""
        return means if probe is None else _WithProbe.apply(means, probe, self)

    def take(self) -> Float[Tensor, "v n 2"] | None:
        """Return the absolute gradients of the last backward pass, once."""
        means2d = self.means2d()
        return None if means2d is None else vars(means2d).pop("absgrad", None)


class _WithProbe(torch.autograd.Function):
    """The identity of the means. Its backward pass runs after the backward pass of the images."""

    @staticmethod
    def forward(ctx, means: Tensor, probe: Tensor, tap: _Tap) -> Tensor:
        ctx.tap = tap
        return means.view_as(means)

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return grads[0], ctx.tap.take(), None


def _centres(info: Mapping[str, Any]) -> Float[Tensor, "v n 2"]:
    """Return gsplat's ``means2d``, which keeps its gradient, with zeros for Gaussians that were not seen."""
    means2d: Tensor = info["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    # The kernels leave these rows uninitialized and never read them. ``data`` hides the change from autograd,
    # which would refuse the backward pass otherwise.
    means2d.data.masked_fill_(~_is_seen(info["radii"])[..., None], 0.0)
    return means2d


@torch.no_grad()
def _radii(
    info: Mapping[str, Any], opacities: Float[Tensor, "n"], height: int, width: int
) -> Float[Tensor, "v n"]:
    """Return half the longer side of the box around the ellipse of ``alpha >= ALPHA_MIN``; 0 if not seen.

    gsplat rounds both sides of the box up, and therefore also lists Gaussians that end less than a pixel
    outside of the image. The exact sides follow from the conics.
    """
    rounded, means2d = info["radii"].float(), info["means2d"].detach()
    x, xy, y = info["conics"].detach().unbind(dim=-1)
    variances = torch.stack([y, x], dim=-1) / (x * y - xy * xy)[..., None]
    reach = torch.log(opacities / ALPHA_MIN).mul(2).sqrt()
    # The inverse of the conic of a needle is inaccurate or NaN, and fmin and fmax ignore NaN.
    half_sizes = torch.fmax(torch.fmin(reach[:, None] * variances.sqrt(), rounded), rounded - 1)
    size = half_sizes.new_tensor([width, height])
    is_on_screen = ((means2d + half_sizes > 0) & (means2d - half_sizes < size)).all(dim=-1)
    return torch.where(_is_seen(info["radii"]) & is_on_screen, half_sizes.amax(dim=-1), 0.0)


def _is_seen(radii: Int[Tensor, "v n 2"]) -> Bool[Tensor, "v n"]:
    return (radii > 0).all(dim=-1)
