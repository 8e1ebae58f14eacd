"""PictureExporter: pictures of one asset, or of several assets side by side from the same cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.normals import unit_normals, with_normals
from cadam3d.core.pictures import CutoutSettings
from cadam3d.core.rendering import RenderFn, Subject
from cadam3d.exporter.base import Exporter
from cadam3d.io.caption import PAPER, Caption, Color
from cadam3d.io.image import closeness, cutout

KINDS = ("rgb", "depth", "alpha", "normal")


@dataclass(frozen=True, kw_only=True)
class PictureExporter(Exporter):
    """Draw pictures of one asset or of several; a subclass defines ``compare``."""

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Draw a single asset, without a caption."""
        return self.compare([Subject(gaussians, render)], folder)


def captions_of(subjects: Sequence[Subject]) -> list[Caption]:
    """Return the label and the number of Gaussians of each of several subjects; nothing for a single one."""
    captions = [Caption(subject.label, f"{len(subject.gaussians):,} Gaussians") for subject in subjects]
    return captions if len(subjects) > 1 else []


def paper_of(background: Sequence[float] | str) -> Color:
    """Return the colour behind captions: the background's, or white beside transparent pictures."""
    if isinstance(background, str):
        return PAPER
    return tuple(round(255 * channel) for channel in background)


def paint(
    subject: Subject, cameras: Cameras, settings: CutoutSettings, kinds: Sequence[str]
) -> list[Float[Tensor, "v h w c"]]:
    """Return the pictures of each kind in ``KINDS``: three channels, or four with straight alpha.

    - rgb: the colours over the background of the settings, which is black for transparent pictures.
    - depth: closeness, as in ``io/image.py``, over black.
    - alpha: opacity in grey. It has no transparent parts.
    - normal: (n + 1) / 2 over the background, where n is the unit normal in the axes of normal maps: right,
      up, towards the camera.
    """
    background = settings.backgrounds(len(cameras))
    output = subject.render(cameras, background)
    alpha = output.alpha
    pictures = []
    for kind in kinds:
        if kind == "rgb":
            color, over = output.rgb, alpha
        elif kind == "depth":
            color, over = closeness(output.depth, alpha, settings.distance), alpha
        elif kind == "alpha":
            color, over = alpha[..., None].expand_as(output.rgb), torch.ones_like(alpha)
        else:
            color, over = _normals(subject, cameras), alpha
            behind = background.to(color)[:, None, None]
            color = color * alpha[..., None] + (1 - alpha[..., None]) * behind
        pictures.append(cutout(color, over) if settings.is_transparent else color)
    return pictures


def _normals(subject: Subject, cameras: Cameras) -> Float[Tensor, "v h w 3"]:
    """Return unit normals as colours.

    Each view is rendered alone, because the colours of the Gaussians depend on its camera.
    """
    gaussians, views = subject.gaussians.detach(), []
    for view in range(len(cameras)):
        camera = cameras.index(slice(view, view + 1))
        colored = with_normals(gaussians, camera.to(gaussians.device))
        output = subject.render(camera, torch.zeros(1, 3), colored)
        views.append(unit_normals(output.rgb, output.alpha))
    return torch.cat(views)
