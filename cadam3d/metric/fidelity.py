"""Fidelity: how close the renders are to the true images, if the prior knows those."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.pictures import PictureSettings
from cadam3d.core.render import RenderFn, Truth
from cadam3d.metric.base import Metric

SSIM_WINDOW = 11  # pixels (Wang et al. 2004)
# In dB. The PSNR of equal images is infinite, which can neither be averaged nor written as JSON.
PSNR_MAX = 100.0
# Views that are compared at once. This bounds the memory, because there is a true image per mode and view.
VIEWS_AT_ONCE = 4


@dataclass(frozen=True, kw_only=True)
class Fidelity(PictureSettings, Metric):
    """PSNR and SSIM of held-out views against the true images.

    Each view's PSNR comes from the mean squared error over all its pixels and channels, renders clamped to
    [0, 1]; the views are then averaged in dB. If the prompt leaves something open, the truth is a mixture:
    the asset is compared with every mode over all views, and only the mode with the best mean PSNR counts.
    """

    node: ClassVar[str] = "metric.fidelity"

    views: int  # >= 1, per elevation
    elevations_deg: Sequence[float]  # in [-90, 90]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_views(self.views, example=12)
        self.require_angles("elevations_deg", self.elevations_deg, limit=90, example=15)
        require_whole("metric.fidelity.size", self.size, low=SSIM_WINDOW, example=128)

    def cameras(self) -> Cameras:
        """Return the held-out views.

        Their azimuths are half a step off those of a turntable. Each elevation is shifted a little more, so
        that no two rings look from the same side.
        """
        step = 360.0 / self.views
        rings = len(self.elevations_deg)
        azimuth = torch.tensor(
            [(view + 0.5 + ring / (2 * rings)) * step for ring in range(rings) for view in range(self.views)]
        )
        elevation = torch.tensor([float(angle) for angle in self.elevations_deg]).repeat_interleave(
            self.views
        )
        return self.cameras_at(azimuth, elevation)

    def measure(
        self, gaussians: Gaussians, render: RenderFn, truth: Truth | None, asset: Path | None
    ) -> dict[str, float]:
        """Return PSNR, SSIM and the mode that they belong to; {} if there are no true images.

        ``psnr`` (dB) and ``ssim`` are means over the views, ``psnr_min`` (dB) is that of the worst view, and
        ``mode`` is the index of the mode.
        """
        if truth is None:
            return {}
        cameras = self.cameras()
        psnrs, ssims = [], []
        for first in range(0, len(cameras), VIEWS_AT_ONCE):
            some = cameras.index(slice(first, first + VIEWS_AT_ONCE))
            background = self.backgrounds(len(some))
            images = render(some, background).rgb.detach().float().cpu().clamp(0, 1)
            modes = truth.images(some, background).detach().float().cpu()
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
    from kornia.metrics import psnr  # slow to import, and not needed before training has ended

    rows = [
        torch.stack([psnr(image, true, max_val=1.0) for image, true in zip(images, mode, strict=True)])
        for mode in modes
    ]
    return torch.stack(rows).clamp_max(PSNR_MAX)


def _ssim(images: Float[Tensor, "v h w 3"], modes: Float[Tensor, "m v h w 3"]) -> Float[Tensor, "m v"]:
    from kornia.metrics import ssim

    ours = images.permute(0, 3, 1, 2)
    maps = [ssim(ours, mode.permute(0, 3, 1, 2), window_size=SSIM_WINDOW) for mode in modes]
    return torch.stack(maps).mean(dim=(2, 3, 4))
