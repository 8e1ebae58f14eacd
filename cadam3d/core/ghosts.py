"""Ghosts: Gaussians that training left behind in empty space, so faint that they hardly show over white.

Most of them are Gaussians of the start that have faded but have not vanished. Over a dark background they are
a grey haze around the object. A ghost has nothing solid in front of it or behind it from at least one side.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput

VIEWS = 8  # for each elevation
ELEVATIONS_DEG = (-10.0, 20.0, 50.0)
FOV_DEG = 40.0
SIZE = 128  # pixels
# A view in which a Gaussian shows less than this share of its average over all views says nothing about it.
LEAST_SHARE = 0.25

RenderWithGradient = Callable[[Gaussians, Cameras, Tensor], RenderOutput]


def ghosts(gaussians: Gaussians, render: RenderWithGradient, min_alpha: float) -> Bool[Tensor, "n"]:
    """Return the mask of Gaussians around which some view has an alpha below ``min_alpha``, in [0, 1].

    The alpha is relative to the mean over the whole asset, so that a transparent asset does not disappear.
    """
    weight, alpha = _seen(gaussians, render)
    is_shown = (weight > LEAST_SHARE * weight.mean(0)) & (weight > 0)
    lowest = torch.where(is_shown, alpha / weight, torch.inf).amin(0)
    return lowest * weight.sum() < min_alpha * alpha.sum()


def _seen(
    gaussians: Gaussians, render: RenderWithGradient
) -> tuple[Float[Tensor, "v n"], Float[Tensor, "v n"]]:
    """Return how much each Gaussian adds to each view, and the same weighted by the alpha of the pixels.

    A pixel is linear in the colours, so the gradient by the colour of a Gaussian is its weight in the pixel.
    """
    colors = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_()
    grey = replace(gaussians.detach(), sh=colors)
    background = gaussians.means.new_zeros(1, 3)
    found = []
    for elevation_deg in ELEVATIONS_DEG:
        cameras = turntable(
            VIEWS,
            elevation_deg=elevation_deg,
            distance=fitting_distance(FOV_DEG),
            fov_y_deg=FOV_DEG,
            size=SIZE,
        ).to(gaussians.device)
        for view in range(VIEWS):
            output = render(grey, cameras.index(slice(view, view + 1)), background)
            alpha = output.alpha.detach()
            marks = torch.stack([torch.ones_like(alpha), alpha, torch.zeros_like(alpha)], dim=-1)
            found += torch.autograd.grad((output.rgb * marks).sum(), colors)
    weight, alpha, _ = torch.stack(found)[:, :, 0].unbind(-1)
    return weight, alpha
