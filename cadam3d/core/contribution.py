"""Contribution: how much each Gaussian shows in pictures from all around, and which only spoil them.

A pixel is linear in the colours, so the gradient by the colour of a Gaussian is its weight in the pixel: its
opacity there times what the Gaussians in front of it let through. A hidden or faint Gaussian contributes
nothing, however opaque or large it is.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.core.sh import SH_C0

VIEWS = 8  # for each elevation, to find ghosts
FEW_VIEWS = 4  # for each elevation, to add contributions up
ELEVATIONS_DEG = (-10.0, 20.0, 50.0)
FOV_DEG = 40.0
SIZE = 128  # pixels
# A view in which a Gaussian shows less than this share of its average over all views says nothing about it.
LEAST_SHARE = 0.25

RenderWithGradient = Callable[[Gaussians, Cameras, Tensor], RenderOutput]


def around(views: int) -> list[Cameras]:
    """Return ``views`` cameras on each of three rings around the object."""
    distance = fitting_distance(FOV_DEG)
    return [
        turntable(views, elevation_deg=elevation_deg, distance=distance, fov_y_deg=FOV_DEG, size=SIZE)
        for elevation_deg in ELEVATIONS_DEG
    ]


def contributions(gaussians: Gaussians, render: RenderWithGradient) -> Float[Tensor, "n"]:
    """Return the sum of each Gaussian's weights over the pixels of pictures from all around, >= 0.

    A Gaussian that is opaque and alone has the area that it covers, in pixels of ``SIZE``.
    """
    return _shares(gaussians, render, FEW_VIEWS)[0].sum(0) / SH_C0


def ghosts(gaussians: Gaussians, render: RenderWithGradient, min_alpha: float) -> Bool[Tensor, "n"]:
    """Return the mask of Gaussians around which some view has an alpha below ``min_alpha``, in [0, 1].

    These are Gaussians that training left behind in empty space, so faint that they hardly show over white.
    Most of them are of the start, and have faded but not vanished. Over a dark background they are a grey
    haze around the object. A ghost has nothing solid in front of it or behind it from at least one side. The
    alpha is relative to the mean over the whole asset, so that a transparent asset does not disappear.
    """
    weight, alpha = _shares(gaussians, render, VIEWS)
    is_shown = (weight > LEAST_SHARE * weight.mean(0)) & (weight > 0)
    lowest = torch.where(is_shown, alpha / weight, torch.inf).amin(0)
    return lowest * weight.sum() < min_alpha * alpha.sum()


def _shares(
    gaussians: Gaussians, render: RenderWithGradient, views: int
) -> tuple[Float[Tensor, "v n"], Float[Tensor, "v n"]]:
    """Return each Gaussian's weight in each view, and the same weighted by the alpha of the pixels.

    Both are times ``SH_C0``, by which a colour follows from its first coefficient.
    """
    colors = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_()
    grey = replace(gaussians.detach(), sh=colors)
    background = gaussians.means.new_zeros(1, 3)
    found = []
    for cameras in around(views):
        for view in range(views):
            camera = cameras.index(slice(view, view + 1)).to(gaussians.device)
            output = render(grey, camera, background)
            alpha = output.alpha.detach()
            marks = torch.stack([torch.ones_like(alpha), alpha, torch.zeros_like(alpha)], dim=-1)
            found += torch.autograd.grad((output.rgb * marks).sum(), colors)
    weight, alpha, _ = torch.stack(found)[:, :, 0].unbind(-1)
    return weight, alpha
