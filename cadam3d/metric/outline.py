"""Outline: whether an asset has the true silhouette and the true colour, which PSNR alone does not say."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.number import Number
from cadam3d.core.rendering import RenderFn, Truth
from cadam3d.metric.base import Measurand, Measurement, Metric
from cadam3d.metric.held_out import HeldOutSettings

# The alpha above which a pixel belongs to the object.
INSIDE = 0.5

IOU = Number(
    name="iou",
    label="IoU",
    digits=3,
    is_more_better=True,
    explained="Overlap of the outlines (IoU)",
    needs_truth=True,
)
IOU_START = replace(
    IOU,
    name="iou_start",
    label="IoU at the start",
    explained="Overlap of the outlines at the start (IoU)",
)
COLOUR_ERROR = Number(
    name="colour_error",
    label="colour error",
    digits=1,
    is_more_better=False,
    explained="Colour error (delta E)",
    needs_truth=True,
)


@dataclass(frozen=True, kw_only=True)
class Outline(HeldOutSettings, Metric):
    """Overlap of the silhouettes, and difference of the colours inside both.

    * ``iou`` is the intersection over the union of the pixels with an alpha above 0.5, averaged over the
      views.
    * ``colour_error`` is the distance of two colours in CIE L*a*b* (delta E 1976, white point D65). The
      colours are the means over the pixels of one view that are inside both silhouettes, and the distances
      are averaged over the views. Up to 20, a person calls both colours by the same name.

    If the asset may face any side, it is compared at the turn with the best PSNR (``turn_deg``), so that all
    numbers belong to one turn. If the prompt leaves something open, the mode with the largest ``iou`` counts,
    and among equal ones that with the smallest ``colour_error``.
    """

    numbers: ClassVar[tuple[Number, ...]] = (IOU, IOU_START, COLOUR_ERROR)

    def measure(self, measurand: Measurand) -> Measurement:
        """Return ``iou`` in [0, 1] and ``colour_error``; nothing if the true outlines are not known.

        ``colour_error`` is left out if the silhouettes meet in no view.
        """
        true = measurand.truth and measurand.truth.turned()
        return Measurement({} if true is None else self._compare(measurand.render, true))

    def measure_start(self, measurand: Measurand) -> dict[str, float]:
        """Return ``iou_start``, against the outlines with which ``iou`` compares the asset."""
        assert measurand.truth is not None
        numbers = self._compare(measurand.render, measurand.truth.turned())
        return {"iou_start": numbers["iou"]} if numbers else {}

    def _compare(self, render: RenderFn, true: Truth) -> dict[str, float]:
        """Return the numbers of :meth:`measure` for a truth that faces as the asset does."""
        if true.alpha is None:
            return {}
        overlaps, differences, meetings = [], [], []
        for cameras, background in self.parts():
            output = render(cameras, background)
            ours = output.alpha.detach().cpu() > INSIDE
            theirs = true.alpha(cameras).detach().cpu() > INSIDE
            shared = ours & theirs
            union = (ours | theirs).sum(dim=(2, 3))
            # Two empty silhouettes are equal.
            overlaps.append(torch.where(union > 0, shared.sum(dim=(2, 3)) / union.clamp_min(1), 1.0))
            colours = _mean_colour(output.rgb.detach().float().cpu().clamp(0, 1), shared)
            modes = _mean_colour(true.images(cameras, background).detach().float().cpu(), shared)
            differences.append((_lab(colours) - _lab(modes)).norm(dim=-1))
            meetings.append(shared.flatten(2).any(dim=2))
        iou = torch.cat(overlaps, dim=1).mean(dim=1)
        meets = torch.cat(meetings, dim=1)
        total = torch.where(meets, torch.cat(differences, dim=1), 0).sum(dim=1)
        error = torch.where(meets.any(dim=1), total / meets.sum(dim=1).clamp_min(1), torch.inf)
        best = max(range(len(iou)), key=lambda mode: (float(iou[mode]), -float(error[mode])))
        is_known = bool(error[best].isfinite())
        return {"iou": float(iou[best]), **({"colour_error": float(error[best])} if is_known else {})}


def _mean_colour(
    images: Float[Tensor, "*m v h w 3"], chosen: Bool[Tensor, "m v h w"]
) -> Float[Tensor, "m v 3"]:
    """Return the mean over the chosen pixels of each view; black if there are none."""
    weights = chosen.float()
    total = (images * weights[..., None]).sum(dim=(2, 3))
    return total / weights.sum(dim=(2, 3)).clamp_min(1)[..., None]


def _lab(colours: Float[Tensor, "m v 3"]) -> Float[Tensor, "m v 3"]:
    # Slow to import, and not needed before training has ended.
    from kornia.color import rgb_to_lab

    return rgb_to_lab(colours.permute(2, 0, 1)).permute(1, 2, 0)
