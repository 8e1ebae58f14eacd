"""ImagesExporter: one PNG per view, for a paper, a web page or another program."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cadam3d.core.checks import each, one_of
from cadam3d.core.pictures import CutoutSettings, Elevations, Views
from cadam3d.core.rendering import Subject
from cadam3d.exporter.pictures import KINDS, PictureExporter, captions_of, paint, paper_of
from cadam3d.io.atomic import replacing_series
from cadam3d.io.caption import side_by_side
from cadam3d.io.image import to_uint8, write_png_bytes

FOLDER = "images"
# The names of the pictures: number, azimuth and elevation, and the kind unless it is rgb.
NAME = re.compile(r"\d{3,}_az\d{3}_el[+-]\d{2}(_depth|_alpha|_normal)?\.png")


@dataclass(frozen=True, kw_only=True)
class ImagesExporter(CutoutSettings, PictureExporter):
    """Write ``images/000_az000_el+20.png`` and so on: numbered, with azimuth and elevation in degrees.

    The pictures of other kinds have the same number and, for example, ``_normal`` at the end of their names.
    All pictures with such names in ``images`` are replaced, so that none of an earlier export is left.
    """

    views: Views  # per elevation
    elevations_deg: Elevations
    kinds: Annotated[Sequence[str], each(one_of(KINDS))]

    def compare(self, subjects: Sequence[Subject], folder: Path) -> list[Path]:
        """Render and write view by view, so that memory does not grow with the number of views."""
        names: list[str] = []
        target, number = folder / FOLDER, 0
        captions, paper = captions_of(subjects), paper_of(self.background)
        with replacing_series(target, lambda name: NAME.fullmatch(name) is not None) as temporary:
            for elevation_deg in self.elevations_deg:
                ring = self.ring(self.views, elevation_deg)
                for view in range(self.views):
                    camera = ring.index(slice(view, view + 1))
                    azimuth = round(float(camera.azimuth_deg[0]) % 360)
                    stem = f"{number:03d}_az{azimuth:03d}_el{elevation_deg:+03.0f}"
                    painted = [paint(subject, camera, self, self.kinds) for subject in subjects]
                    for kind, pictures in zip(self.kinds, zip(*painted, strict=True), strict=True):
                        name = f"{stem}.png" if kind == "rgb" else f"{stem}_{kind}.png"
                        sheet = side_by_side([to_uint8(each[0]) for each in pictures], captions, paper)
                        write_png_bytes(temporary / name, sheet)
                        names.append(name)
                    number += 1
        return [target / name for name in names]
