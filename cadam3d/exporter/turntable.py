"""TurntableExporter: one full turn around the object, colour beside depth or alpha."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import UInt8

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require_choice, require_range, require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.pictures import PictureSettings
from cadam3d.core.render import RenderFn, RenderOutput
from cadam3d.exporter.base import Exporter
from cadam3d.io.image import closeness, to_uint8
from cadam3d.io.run_folder import TURNTABLE
from cadam3d.io.video import write_video

# Frames per second. Players handle such rates; much larger ones overflow in ffmpeg.
HIGHEST_FPS = 240
# With a second picture beside it, such a frame is as wide as libx264 allows.
LARGEST = 8192  # pixels
VIEWS_AT_ONCE = 4  # bounds the memory of rendering for a video of any length


@dataclass(frozen=True, kw_only=True)
class TurntableExporter(PictureSettings, Exporter):
    """Write ``turntable.mp4``: the camera circles the object once, starting at its front."""

    node: ClassVar[str] = "exporter.turntable"

    views: int  # in [1, 100000], frames
    elevation_deg: float  # in [-90, 90]
    fps: int  # in [1, 240], frames per second
    beside: str  # depth, alpha or none

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_views(self.views, example=60)
        require_range("exporter.turntable.elevation_deg", self.elevation_deg, low=-90, high=90, example=15)
        require_whole("exporter.turntable.fps", self.fps, low=1, high=HIGHEST_FPS, example=30)
        require_choice("exporter.turntable.beside", self.beside, ("depth", "alpha", "none"))
        require_whole("exporter.turntable.size", self.size, low=1, high=LARGEST, example=256)

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Render and encode frame by frame."""
        path = folder / TURNTABLE
        cameras = self.ring(self.views, self.elevation_deg)
        write_video(path, self._frames(cameras, render), fps=self.fps)
        return [path]

    def _frames(self, cameras: Cameras, render: RenderFn) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for first in range(0, self.views, VIEWS_AT_ONCE):
            some = cameras.index(slice(first, first + VIEWS_AT_ONCE))
            output = render(some, self.backgrounds(len(some)))
            yield from to_uint8(self._pictures(output))

    def _pictures(self, output: RenderOutput) -> torch.Tensor:
        if self.beside == "none":
            return output.rgb
        if self.beside == "alpha":
            second = output.alpha[..., None].expand_as(output.rgb)
        else:
            second = closeness(output.depth, output.alpha, self.distance)
        return torch.cat([output.rgb, second], dim=2)
