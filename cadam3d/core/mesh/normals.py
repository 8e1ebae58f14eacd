"""Normals: the direction in which the surface of Gaussians faces, as colours.

A Gaussian is part of a surface, and flattest across it. Its normal is therefore its shortest axis, turned
towards the camera. On trained assets, a blend of these axes is much smoother than the derivative of depth.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0

# From OpenCV axes (right, down, forward) to the axes of normal maps: right, up, towards the camera.
TO_MAP = (1.0, -1.0, -1.0)
# A blend of normals that is shorter than this, because they point everywhere, has no direction.
SHORTEST = 1e-4


def facing_normals(gaussians: Gaussians, camera: Cameras) -> Float[Tensor, "n 3"]:
    """Return the unit normal of each Gaussian, turned towards a single camera.

    Its axes are the axes of normal maps: right, up, towards the camera.
    """
    shortest = gaussians.log_scales.argmin(dim=1)
    axes = gaussians.rotations.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    towards = camera.positions - gaussians.means
    axes = torch.where((axes * towards).sum(dim=1, keepdim=True) < 0, -axes, axes)
    return axes @ camera.world_to_camera[0, :3, :3].T * axes.new_tensor(TO_MAP)


def with_normals(gaussians: Gaussians, camera: Cameras) -> Gaussians:
    """Return the same Gaussians in the colours of their normals, from a single camera; [-1, 1] is [0, 1]."""
    # Colours are 0.5 + SH_C0 * sh.
    return replace(gaussians, sh=(facing_normals(gaussians, camera) / (2 * SH_C0))[:, None])


def unit_normals(
    colors: Float[Tensor, "*batch h w 3"], alpha: Float[Tensor, "*batch h w"]
) -> Float[Tensor, "*batch h w 3"]:
    """Return the colours of unit normals, from a render of :func:`with_normals` over black and its alpha.

    Each pixel is divided by its alpha, so that the normal of a faint pixel is not shorter. A pixel without a
    direction faces the camera.
    """
    blended = colors / alpha.clamp_min(torch.finfo(alpha.dtype).tiny)[..., None] * 2 - 1
    length = torch.linalg.vector_norm(blended, dim=-1, keepdim=True)
    forward = colors.new_tensor([0.0, 0.0, 1.0]).expand_as(colors)
    has_direction = (length > SHORTEST) & (alpha > 0)[..., None]
    return torch.where(has_direction, blended / length.clamp_min(SHORTEST), forward) / 2 + 0.5
