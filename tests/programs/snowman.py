"""An object that cannot hide a wrong axis: a snowman next to a pine, as Gaussians, without training.

It has no symmetry. Up and down, left and right, front and back all differ, and so do its colours at SH degree
3. The Gaussians resemble trained ones: flat discs of uneven size on the surfaces, partly transparent and
overlapping.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.gaussians import Gaussians, concatenate
from cadam3d.core.sh import sh_basis

WHITE, CARROT, COAL, RED = (0.93, 0.94, 0.97), (0.92, 0.45, 0.1), (0.08, 0.08, 0.1), (0.75, 0.1, 0.12)
NEEDLES, DARK_NEEDLES, BARK, HONEY = (
    (0.15, 0.45, 0.2),
    (0.08, 0.32, 0.16),
    (0.4, 0.26, 0.15),
    (0.9, 0.75, 0.2),
)
# Standard deviations of the SH coefficients of bands 1 to 3. A missing band costs more than 6 dB.
SH_SPREAD = (0.20, 0.14, 0.10)


def snowman_and_pine(degree: int) -> Gaussians:
    """Return the object in world axes (+z up, front at +x); degrees differ in their coefficients only."""
    draw = torch.Generator().manual_seed(13)
    # The snowman is on the left of a viewer in front of it, which is -y, and the pine on the right.
    parts = [
        _ball(draw, 700, (0.0, -0.36, -0.50), 0.32, WHITE),
        _ball(draw, 450, (0.0, -0.36, -0.08), 0.23, WHITE),
        _ball(draw, 300, (0.0, -0.36, 0.24), 0.16, WHITE),
        _ball(draw, 120, (0.0, -0.36, 0.10), 0.17, RED, squash=0.35),
        _cone(draw, 60, (0.15, -0.36, 0.24), (1.0, 0.0, 0.0), 0.04, 0.2, CARROT),
        _ball(draw, 25, (0.14, -0.43, 0.30), 0.025, COAL),
        _ball(draw, 25, (0.14, -0.29, 0.30), 0.025, COAL),
        _cone(draw, 500, (0.0, 0.42, -0.50), (0.0, 0.0, 1.0), 0.40, 0.60, DARK_NEEDLES),
        _cone(draw, 400, (0.0, 0.42, -0.15), (0.0, 0.0, 1.0), 0.30, 0.55, NEEDLES),
        _cone(draw, 300, (0.0, 0.42, 0.20), (0.0, 0.0, 1.0), 0.20, 0.50, NEEDLES),
        _cone(draw, 120, (0.0, 0.42, -0.82), (0.0, 0.0, 1.0), 0.10, 0.60, BARK),
        _ball(draw, 40, (0.0, 0.42, 0.74), 0.05, HONEY),
    ]
    return _with_sh(concatenate(parts), degree)


def _with_sh(gaussians: Gaussians, degree: int) -> Gaussians:
    """Add coefficients of bands 1 to ``degree``: one pattern that all Gaussians share, plus noise of each."""
    draw = torch.Generator().manual_seed(31)
    bands = [gaussians.sh]
    for band, spread in enumerate(SH_SPREAD[:degree], start=1):
        size = 2 * band + 1
        pattern = torch.randn(1, size, 3, generator=draw)
        noise = torch.randn(len(gaussians), size, 3, generator=draw)
        bands.append(spread * (pattern + 0.5 * noise))
    return Gaussians(**{**gaussians.tensors(), "sh": torch.cat(bands, dim=1)})


def _ball(draw, n, centre, radius, colour, squash=1.0) -> Gaussians:
    normals = torch.nn.functional.normalize(torch.randn(n, 3, generator=draw), dim=1)
    points = torch.tensor(centre) + radius * normals * torch.tensor([1.0, 1.0, squash])
    return _discs(draw, points, normals, 4 * math.pi * radius**2, colour)


def _cone(draw, n, base, axis, radius, height, colour) -> Gaussians:
    """Return the side of a cone with its base around ``base`` and its tip at ``base + height * axis``."""
    along = torch.tensor(axis)
    across = along.roll(1), along.roll(2)
    angle = 2 * math.pi * torch.rand(n, generator=draw)
    # The area of a ring shrinks towards the tip, and so does the density of points.
    towards_tip = 1 - torch.rand(n, generator=draw).sqrt()
    ring = angle.cos()[:, None] * across[0] + angle.sin()[:, None] * across[1]
    points = torch.tensor(base) + (1 - towards_tip)[:, None] * radius * ring
    points = points + (towards_tip * height)[:, None] * along
    normals = torch.nn.functional.normalize(height * ring + radius * along, dim=1)
    return _discs(draw, points, normals, math.pi * radius * math.hypot(radius, height), colour)


def _discs(
    draw: torch.Generator,
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    area: float,
    colour: tuple[float, float, float],
) -> Gaussians:
    """Return flat Gaussians at ``points`` that cover a surface of ``area`` and face along ``normals``."""
    n = len(points)
    width = 0.8 * math.sqrt(area / n)
    scales = width * torch.tensor([1.0, 0.6, 0.2]) * (0.25 * torch.randn(n, 3, generator=draw)).exp()
    # Shading from the upper left makes the colours of a surface differ, as in a trained asset.
    light = 0.75 + 0.25 * (normals @ torch.tensor([0.5, -0.4, 0.77]))[:, None]
    rgb = torch.tensor(colour) * light + 0.03 * torch.randn(n, 3, generator=draw)
    sh0 = (rgb.clamp(0.02, 0.98) - 0.5) / sh_basis(torch.zeros(1, 3), 0)
    return Gaussians(
        means=points,
        log_scales=scales.log(),
        quats=_facing(normals, 2 * math.pi * torch.rand(n, generator=draw)),
        opacity_logits=1.5 + 1.2 * torch.randn(n, generator=draw),
        sh=sh0[:, None],
    )


def _facing(normals: Float[Tensor, "n 3"], spin: Float[Tensor, "n"]) -> Float[Tensor, "n 4"]:
    """Return quaternions (wxyz) that turn +z to ``normals``, after a turn about +z by ``spin`` radians."""
    # The half-way rotation from +z to a normal n is (1 + z . n, z x n), which has no direction at n = -z.
    x, y, z = normals.unbind(1)
    tilt = torch.stack([1 + z.clamp_min(-0.9999), -y, x, torch.zeros_like(x)], dim=1)
    w, a, b, _ = torch.nn.functional.normalize(tilt, dim=1).unbind(1)
    cos, sin = (spin / 2).cos(), (spin / 2).sin()
    return torch.stack([w * cos, a * cos + b * sin, b * cos - a * sin, w * sin], dim=1)
