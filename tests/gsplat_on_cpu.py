"""A stand-in for ``gsplat.rasterization`` on a CPU, made of gsplat's own pure torch functions.

gsplat's projection, spherical harmonics and ``accumulate`` run anywhere. Three parts exist on CUDA only and
are written here from its documentation: the radii with their opacity-aware box, the list of (Gaussian, pixel)
pairs that are blended, and the absolute gradients. ``accumulate`` needs two small functions of ``nerfacc``,
which are written here too.

Like the kernels, the stand-in leaves garbage in the rows of Gaussians that a view does not see.
"""

import inspect
import math
import sys
from types import ModuleType
from unittest.mock import patch

import gsplat
import torch
from gsplat.cuda import _torch_impl as parts
from torch import Tensor

SIGNATURE = inspect.signature(gsplat.rasterization)
# gsplat 1.5.3.
CAP, THRESHOLD, STOP = 0.999, 1 / 255, 1e-4
# The arguments that the stand-in understands. It refuses other values of the remaining ones.
KNOWN = {"means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"}
KNOWN |= {
    "near_plane",
    "far_plane",
    "eps2d",
    "sh_degree",
    "packed",
    "tile_size",
    "backgrounds",
    "render_mode",
}
KNOWN |= {"absgrad", "rasterize_mode"}


def rasterization(*args, **kwargs) -> tuple[Tensor, Tensor, dict]:
    """Return what ``gsplat.rasterization`` returns for these arguments, in the dtype of the means."""
    bound = SIGNATURE.bind(*args, **kwargs)
    bound.apply_defaults()
    given = bound.arguments
    for name, value in given.items():
        assert name in KNOWN or value == SIGNATURE.parameters[name].default, f"{name}={value}"
    assert not given["packed"]
    return _render(given)


def _render(given: dict) -> tuple[Tensor, Tensor, dict]:
    dtype = given["means"].dtype
    v, n = given["viewmats"].shape[0], given["means"].shape[0]
    exact = {name: value.double() for name, value in given.items() if isinstance(value, Tensor)}
    radii, means2d, conics, features, seen = [], [], [], [], []
    for view in range(v):
        sides, rows = _radii(given, exact, view)
        centre, depth, conic, opacities = _project(given, exact, view, rows)
        color = _colors(given, exact, view, rows)
        means2d.append(centre.new_full((n, 2), math.nan).index_copy(0, rows, centre))
        conics.append(conic.new_full((n, 3), math.nan).index_copy(0, rows, conic))
        radii.append(sides)
        seen.append((rows, depth, opacities))
        features.append(torch.cat([color, depth[:, None]], dim=1))
    centres = torch.stack(means2d).to(dtype)
    pictures = []
    for view, (rows, depth, opacities) in enumerate(seen):
        table = (conics[view][rows], opacities, features[view], depth)
        pictures.append(_blend(centres, view, rows, table, given))
    sums, alphas = (torch.stack(each) for each in zip(*pictures, strict=True))
    if given["backgrounds"] is not None:
        behind = torch.nn.functional.pad(exact["backgrounds"], (0, 1))
        sums = sums + (1 - alphas) * behind[:, None, None]
    if given["render_mode"] == "RGB+ED":
        sums = torch.cat([sums[..., :3], sums[..., 3:] / alphas.clamp(min=1e-10)], dim=-1)
    else:
        assert given["render_mode"] == "RGB+D"
    info = {"radii": torch.stack(radii), "means2d": centres, "conics": torch.stack(conics).to(dtype)}
    return sums.to(dtype), alphas.to(dtype), info


@torch.no_grad()
def _radii(given: dict, exact: dict[str, Tensor], view: int) -> tuple[Tensor, Tensor]:
    """Return the sides of the boxes of one view, rounded up [n 2], and the rows of those that are seen."""
    opacities = exact["opacities"]
    centre, depth, conic, compensated = _project(given, exact, view, torch.arange(len(opacities)))
    reach = (2 * torch.log(compensated / THRESHOLD)).sqrt().clamp_max(3.33)
    determinant = conic[:, 0] * conic[:, 2] - conic[:, 1] ** 2
    variances = torch.stack([conic[:, 2], conic[:, 0]], dim=1) / determinant[:, None]
    sides = (reach[:, None] * variances.sqrt()).ceil()
    size = torch.tensor([given["width"], given["height"]])
    is_seen = (depth >= given["near_plane"]) & (depth <= given["far_plane"]) & (compensated >= THRESHOLD)
    is_seen &= ((centre + sides > 0) & (centre - sides < size)).all(dim=1)
    return torch.where(is_seen[:, None], sides, 0).int(), is_seen.nonzero()[:, 0]


def _project(
    given: dict, exact: dict[str, Tensor], view: int, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the centres, depths, conics and opacities of some Gaussians in one view."""
    covariances, _ = parts._quat_scale_to_covar_preci(
        exact["quats"][rows], exact["scales"][rows], compute_preci=False
    )
    _, centres, depths, conics, compensations = parts._fully_fused_projection(
        exact["means"][rows],
        covariances,
        exact["viewmats"][view : view + 1],
        exact["Ks"][view : view + 1],
        given["width"],
        given["height"],
        eps2d=given["eps2d"],
        near_plane=given["near_plane"],
        far_plane=given["far_plane"],
        calc_compensations=given["rasterize_mode"] == "antialiased",
    )
    opacities = exact["opacities"][rows]
    return (
        centres[0],
        depths[0],
        conics[0],
        opacities if compensations is None else opacities * compensations[0],
    )


def _colors(given: dict, exact: dict[str, Tensor], view: int, rows: Tensor) -> Tensor:
    position = torch.inverse(exact["viewmats"][view])[:3, 3]
    directions, coefficients = exact["means"][rows] - position, exact["colors"][rows]
    assert (given["sh_degree"] + 1) ** 2 <= coefficients.shape[1]
    colors = parts._spherical_harmonics(given["sh_degree"], directions, coefficients)
    return (colors + 0.5).clamp_min(0.0)


def _blend(
    centres: Tensor, view: int, rows: Tensor, table: tuple[Tensor, ...], given: dict
) -> tuple[Tensor, Tensor]:
    """Return the sums of the features [h w 4] and of one [h w 1] over the Gaussians of each pixel."""
    conics, opacities, features, depths = table
    width, height = given["width"], given["height"]
    own = centres[view].double()[rows]
    gaussians, pixels = _pairs(own, conics, opacities, depths, width, height)
    # Each pair has a centre of its own, so that its gradient can be seen alone.
    own = own[gaussians]
    if given["absgrad"] and own.requires_grad:
        own.register_hook(lambda grad: _add_absolutes(centres, view, rows[gaussians], grad))
    with patch.dict(sys.modules, {"nerfacc": _nerfacc()}):
        sums, alpha = parts.accumulate(
            own[None],
            conics[gaussians][None],
            opacities[gaussians][None],
            features[gaussians][None],
            torch.arange(len(gaussians)),
            pixels,
            torch.zeros_like(pixels),
            width,
            height,
        )
    # The kernels give every input a gradient, if only of zeros.
    return sums[0], alpha[0] + 0.0 * sums[0, ..., :1]


@torch.no_grad()
def _pairs(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Return all (Gaussian, pixel) pairs that one view blends, by pixel and then depth, by brute force."""
    grid = torch.cartesian_prod(torch.arange(height), torch.arange(width)).flip(1) + 0.5
    dx, dy = (grid[:, None] - means2d).unbind(-1)
    sigma = 0.5 * (conics[:, 0] * dx**2 + conics[:, 2] * dy**2) + conics[:, 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp_max(CAP)
    order = depths.argsort(stable=True)
    alpha = torch.where(alpha >= THRESHOLD, alpha, 0)[:, order]
    is_reached = (1 - alpha).cumprod(dim=1) > STOP
    pixel, rank = ((alpha > 0) & is_reached).nonzero().unbind(dim=1)
    return order[rank], pixel


def _add_absolutes(centres: Tensor, view: int, rows: Tensor, grad: Tensor) -> None:
    if not hasattr(centres, "absgrad"):
        centres.absgrad = torch.zeros_like(centres)
    centres.absgrad[view].index_add_(0, rows, grad.abs().to(centres.dtype))


def _nerfacc() -> ModuleType:
    """Return a module with the two functions that ``accumulate`` imports, for pairs sorted by ray."""

    def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        through = torch.cat([alphas.new_zeros(1), torch.log1p(-alphas).cumsum(0)])
        first = torch.searchsorted(ray_indices, ray_indices)  # first pair of the same ray
        transmittance = (through[:-1] - through[first]).exp()
        return transmittance * alphas, transmittance

    def accumulate_along_rays(
        weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int
    ) -> Tensor:
        each = weights[:, None] if values is None else weights[:, None] * values
        return each.new_zeros(n_rays, each.shape[1]).index_add(0, ray_indices, each)

    module = ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha
    module.accumulate_along_rays = accumulate_along_rays
    return module
