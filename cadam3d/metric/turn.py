"""The turn about the vertical axis at which an asset fits a true object best.

A prior that has learned from captions knows the azimuth of a view coarsely or not at all, so the front of an
asset may be anywhere. All metrics compare at one turn, which is searched here, on small pictures that depend
on no setting of a metric.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, orbit
from cadam3d.core.rendering import RenderFn, Truth

SIZE = 64  # pixels per side
ELEVATIONS_DEG = (-10.0, 20.0, 50.0)
FOV_DEG = 40.0
# Views per elevation in the second part of the search, or fewer if fewer turns are tried.
FINE_VIEWS = 12
# The turns near the best one that are tried next, in steps of the search, and then those near the best.
REFINEMENTS = ((-1 / 3, 1 / 3), (-2 / 15, -1 / 15, 1 / 15, 2 / 15))
# In dB. A turn with a smaller gain is taken for none, so that a round object has the turn 0.
LEAST_GAIN = 0.1
# Views that are rendered or traced at once, which bounds the memory.
VIEWS_AT_ONCE = 12
# The mean squared error of a PSNR of 100 dB. That of equal images would be infinite.
LEAST_ERROR = 1e-10


def facing(truth: Truth, render: RenderFn) -> Truth:
    """Return ``truth`` with the turn at which the rendered asset fits it best in PSNR.

    First ``truth.turns`` turns are tried, evenly spaced. The best one is refined to a fifteenth of their
    spacing, which is 1 degree for 24 turns. If the front is known, ``truth`` is returned unchanged.
    """
    if truth.turns is None:
        return truth
    step = 360.0 / truth.turns
    azimuth = torch.arange(truth.turns).repeat(len(ELEVATIONS_DEG)) * (360.0 / truth.turns)
    elevation = torch.tensor(ELEVATIONS_DEG).repeat_interleave(truth.turns)
    full = torch.ones_like(azimuth)
    # One ring of views for each elevation.
    coarse = orbit(azimuth, elevation, full * fitting_distance(FOV_DEG), full * FOV_DEG, SIZE, SIZE)
    asset = _over_white(lambda cameras, white: render(cameras, white).rgb, coarse).clamp(0, 1)
    true = _over_white(truth.images, coarse)
    # A ring has one view per turn, so an object that turns by one step moves every image to the next view.
    turned = [_psnr(asset, true.roll(number, dims=2)) for number in range(truth.turns)]
    best = step * int(torch.stack(turned).argmax())

    chosen = torch.arange(0, truth.turns, max(1, truth.turns // FINE_VIEWS))
    views = torch.cat([ring * truth.turns + chosen for ring in range(len(ELEVATIONS_DEG))])
    fine, asset = coarse.index(views), asset[:, chosen]

    def quality(turn_deg: float) -> float:
        return float(_psnr(asset, _over_white(truth.images, fine.turned(-turn_deg))))

    known = {turn_deg: quality(turn_deg) for turn_deg in {0.0, best}}
    for offsets in REFINEMENTS:
        known |= {best + offset * step: quality(best + offset * step) for offset in offsets}
        best = max(known, key=lambda turn_deg: known[turn_deg])
    is_gain = known[best] - known[0.0] >= LEAST_GAIN
    return replace(truth, turn_deg=round(180.0 - (180.0 - best) % 360.0, 3) if is_gain else 0.0)


def _over_white(
    images: Callable[[Cameras, Tensor], Tensor], cameras: Cameras
) -> Float[Tensor, "*m rings n h w 3"]:
    """Return images over white, ring by ring."""
    parts = [
        images(some, torch.ones(len(some), 3)).detach().float().cpu() for some in cameras.parts(VIEWS_AT_ONCE)
    ]
    return torch.cat(parts, dim=-4).unflatten(-4, (len(ELEVATIONS_DEG), -1))


def _psnr(asset: Float[Tensor, "rings n h w 3"], true: Float[Tensor, "m rings n h w 3"]) -> Tensor:
    """Return the mean PSNR over the views for the best mode, in dB: a tensor without axes."""
    error = (asset - true).square().mean(dim=(3, 4, 5)).clamp_min(LEAST_ERROR)
    return -10 * error.log10().mean(dim=(1, 2)).min()
