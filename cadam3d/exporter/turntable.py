"""TurntableExporter: turns around the object, colour beside depth, alpha or normals."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import torch
from jaxtyping import UInt8

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import Count, Elevation, one_of, require, whole, within
from cadam3d.core.pictures import CutoutSettings, Views
from cadam3d.core.rendering import Subject
from cadam3d.exporter.pictures import PictureExporter, captions_of, paint, paper_of
from cadam3d.io.caption import side_by_side
from cadam3d.io.image import to_uint8
from cadam3d.io.run_folder import TURNTABLE
from cadam3d.io.video import CODECS, FORMATS, write_video

# A frame may be as wide as the codecs allow. With a second picture beside it, the largest size just fits.
WIDEST = 16384  # pixels
LARGEST = WIDEST // 2  # pixels
MOST_TURNS = 100
VIEWS_AT_ONCE = 4  # bounds the memory of rendering for a video of any length


@dataclass(frozen=True, kw_only=True)
class TurntableExporter(CutoutSettings, PictureExporter):
    """Write ``turntable.mp4``, ``.webm`` or ``.gif``: the camera circles the object, first at its front."""

    files: ClassVar = (TURNTABLE, "turntable.webm", "turntable.gif")
    suffix_setting: ClassVar = "codec"

    size: Annotated[int, whole(low=1, high=LARGEST)]  # pixels
    views: Views  # frames
    turns: Annotated[float, within(low=-MOST_TURNS, high=MOST_TURNS)]  # negative = the other way round
    elevation_deg: Elevation
    fps: Count  # frames per second
    codec: Annotated[str, one_of(CODECS)]
    beside: Annotated[str, one_of(("depth", "alpha", "normal", "none"))]

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = FORMATS[f".{self.codec}"]
        most = kind.most_fps
        self.expect(self.fps <= most, "fps", f"at most {most} with codec={self.codec}", most)
        is_possible = kind.transparent_pixels is not None or not self.is_transparent
        self.expect(is_possible, "codec", "webm, because the background is transparent", "webm")

    def compare(self, subjects: Sequence[Subject], folder: Path) -> list[Path]:
        """Render and encode frame by frame."""
        pictures = len(subjects) * len(self._kinds())
        # The gaps between pictures are narrower than a sixteenth of them.
        most = int(WIDEST / pictures / (1.0 if len(subjects) == 1 else 1.0625))
        require(
            self.size <= most,
            "exporter.turntable.size",
            expected=f"at most {most}, because {pictures} pictures are side by side",
            got=self.size,
            example=f"exporter.turntable.size={min(256, most)}",
        )
        path = folder / self.file_name
        write_video(path, self._frames(self.cameras(), subjects), fps=self.fps)
        return [path]

    def cameras(self) -> Cameras:
        """Return the cameras of all frames."""
        azimuths_deg = torch.arange(self.views, dtype=torch.float32) * (360.0 * self.turns / self.views)
        return self.cameras_at(azimuths_deg, torch.full_like(azimuths_deg, self.elevation_deg))

    def _frames(self, cameras: Cameras, subjects: Sequence[Subject]) -> Iterator[UInt8[np.ndarray, "h w c"]]:
        captions, paper = captions_of(subjects), paper_of(self.background)
        for first in range(0, self.views, VIEWS_AT_ONCE):
            some = cameras.index(slice(first, first + VIEWS_AT_ONCE))
            painted = [paint(subject, some, self, self._kinds()) for subject in subjects]
            panels = [to_uint8(torch.cat(pictures, dim=2)) for pictures in painted]
            for pictures in zip(*panels, strict=True):
                yield side_by_side(pictures, captions, paper)

    def _kinds(self) -> tuple[str, ...]:
        return ("rgb",) if self.beside == "none" else ("rgb", self.beside)
