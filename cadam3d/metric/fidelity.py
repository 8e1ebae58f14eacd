"""Fidelity: how close the renders are to the true images, if those are known."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import whole
from cadam3d.core.number import Number
from cadam3d.core.pictures import MOST_PIXELS
from cadam3d.core.rendering import RenderFn, Truth
from cadam3d.metric.base import Measurand, Measurement, Metric
from cadam3d.metric.held_out import HeldOutSettings

SSIM_WINDOW = 11  # pixels (Wang et al. 2004)
# In dB. The PSNR of equal images is infinite, which can neither be averaged nor written as JSON.
PSNR_MAX = 100.0

PSNR = Number(
    name="psnr", label="PSNR", unit="dB", digits=2, is_more_better=True, preference=10, needs_truth=True
)
PSNR_START = replace(
    PSNR,
    name="psnr_start",
    label="PSNR at the start",
    explained="PSNR of the Gaussians at the start (dB)",
    preference=None,
)
SSIM = Number(name="ssim", label="SSIM", digits=4, is_more_better=True, needs_truth=True)


@dataclass(frozen=True, kw_only=True)
class Fidelity(HeldOutSettings, Metric):
    """PSNR and SSIM of held-out views against the true images.

    Each view's PSNR comes from the mean squared error over all its pixels and channels, renders clamped to
    [0, 1]; the views are then averaged in dB. If the prompt leaves something open, the truth is a mixture:
    the asset is compared with every mode over all views, and only the mode with the best mean PSNR counts.
    """

    numbers: ClassVar[tuple[Number, ...]] = (
        PSNR,
        replace(PSNR, name="psnr_min", label="PSNR of the worst view", preference=None),
        SSIM,
        Number(
            name="mode",
            label="best-matching mode of the truth",
            digits=0,
            is_more_better=None,
            needs_truth=True,
        ),
        # If the asset may face any side, these two replace numbers that may compare with a wrong side.
        replace(PSNR, name="psnr_turned", label="PSNR at the best turn", replaces="psnr"),
        replace(SSIM, name="ssim_turned", label="SSIM at the best turn", replaces="ssim"),
        Number(
            name="turn_deg",
            label="best turn about the vertical axis",
            unit="degrees",
            digits=0,
            is_more_better=None,
            needs_truth=True,
        ),
        PSNR_START,
    )

    size: Annotated[int, whole(low=SSIM_WINDOW, high=MOST_PIXELS)]

    def measure(self, measurand: Measurand) -> Measurement:
        """Return PSNR, SSIM and the mode that they belong to; nothing if there are no true images.

        ``psnr`` (dB) and ``ssim`` are means over the views, ``psnr_min`` (dB) is the worst view's PSNR, and
        ``mode`` is the index of the mode. If the asset may face any side, ``psnr_turned`` and ``ssim_turned``
        compare with the object turned by ``turn_deg``, in (-180, 180] degrees, counterclockwise seen from
        above.
        """
        truth = measurand.truth
        if truth is None:
            return Measurement({})
        unturned = self._compare(measurand.render, truth)
        if truth.turn_deg is None:
            return Measurement(unturned)
        turned = self._compare(measurand.render, truth.turned()) if truth.turn_deg else unturned
        at_turn = {"psnr_turned": turned["psnr"], "ssim_turned": turned["ssim"], "turn_deg": truth.turn_deg}
        return Measurement(unturned | at_turn)

    def measure_start(self, measurand: Measurand) -> dict[str, float]:
        """Return ``psnr_start`` (dB), against the images with which ``psnr_turned`` compares the asset."""
        assert measurand.truth is not None
        return {"psnr_start": self._compare(measurand.render, measurand.truth.turned())["psnr"]}

    def _compare(self, render: RenderFn, truth: Truth) -> dict[str, float]:
        """Return the four numbers of the mode that fits best."""
        psnrs, ssims = [], []
        for cameras, background in self.parts():
            images = render(cameras, background).rgb.detach().float().cpu().clamp(0, 1)
            modes = truth.images(cameras, background).detach().float().cpu()
            psnrs.append(_psnr(images, modes))
            ssims.append(_ssim(images, modes))
        psnr_db, similarity = torch.cat(psnrs, dim=1), torch.cat(ssims, dim=1)
        best = int(psnr_db.mean(dim=1).argmax())
        return {
            "psnr": float(psnr_db[best].mean()),
            "psnr_min": float(psnr_db[best].min()),
            "ssim": float(similarity[best].mean()),
            "mode": float(best),
        }


def _psnr(images: Float[Tensor, "v h w 3"], modes: Float[Tensor, "m v h w 3"]) -> Float[Tensor, "m v"]:
    return (-10 * (images - modes).square().mean(dim=(2, 3, 4)).log10()).clamp_max(PSNR_MAX)


def _ssim(images: Float[Tensor, "v h w 3"], modes: Float[Tensor, "m v h w 3"]) -> Float[Tensor, "m v"]:
    from kornia.metrics import ssim  # slow to import, and not needed before training has ended

    ours = images.permute(0, 3, 1, 2)
    maps = [ssim(ours, mode.permute(0, 3, 1, 2), window_size=SSIM_WINDOW) for mode in modes]
    return torch.stack(maps).mean(dim=(2, 3, 4))
