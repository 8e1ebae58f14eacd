"""PreviewExporter: one picture that shows the object from all sides."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import UInt8

from cadam3d.core.pictures import Elevations, PictureSettings, Views
from cadam3d.core.rendering import Subject
from cadam3d.exporter.pictures import PictureExporter, captions_of, paper_of
from cadam3d.io.caption import side_by_side
from cadam3d.io.image import contact_sheet, to_uint8, write_png_bytes
from cadam3d.io.run_folder import PREVIEW


@dataclass(frozen=True, kw_only=True)
class PreviewExporter(PictureSettings, PictureExporter):
    """Write ``preview.png``: a row of azimuths for each elevation, starting at the front.

    Of several assets, the sheets are side by side, and their rows are broken so that each sheet is nearly
    square.
    """

    files: ClassVar = (PREVIEW,)

    views: Views  # per elevation
    elevations_deg: Elevations
    labels: bool

    def compare(self, subjects: Sequence[Subject], folder: Path) -> list[Path]:
        """Render row by row and write the sheet."""
        path = folder / self.file_name
        columns = self.views
        if len(subjects) > 1:
            # The divisor of ``views`` with which the sheet is nearest to a square.
            side = (self.views * len(self.elevations_deg)) ** 0.5
            divisors = [number for number in range(1, self.views + 1) if self.views % number == 0]
            columns = min(divisors, key=lambda number: abs(number - side))
        sheets = [self._sheet(subject, columns) for subject in subjects]
        write_png_bytes(path, side_by_side(sheets, captions_of(subjects), paper_of(self.background)))
        return [path]

    def _sheet(self, subject: Subject, columns: int) -> UInt8[np.ndarray, "h w 3"]:
        rows, labels = [], []
        for elevation_deg in self.elevations_deg:
            cameras = self.ring(self.views, elevation_deg)
            rows.append(subject.render(cameras, self.backgrounds(self.views)).rgb.cpu())
            labels += [f"{azimuth % 360:.0f}, {elevation_deg:g}" for azimuth in cameras.azimuth_deg.tolist()]
        images = torch.cat(rows).clamp(0, 1)
        return to_uint8(contact_sheet(images, columns=columns, labels=labels if self.labels else []))
