"""HtmlExporter: one page that shows the asset in any browser, without a network."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cadam3d.core.checks import Color, Elevation, within
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderFn
from cadam3d.core.simplify import Simplify
from cadam3d.exporter.base import Contents, Exporter, gaussians_in
from cadam3d.io.atomic import replacing
from cadam3d.viewer.pack import pack
from cadam3d.viewer.page import viewer_page

UNTITLED = "3D Gaussians"


@dataclass(frozen=True, kw_only=True)
class HtmlExporter(Simplify, Exporter):
    """Write ``viewer.html``, which contains the asset and everything that draws it."""

    files: ClassVar = ("viewer.html",)
    hint: ClassVar = "opens in any browser, without a network"

    title: str | None  # None = UNTITLED
    azimuth_deg: Annotated[float, within(low=-360, high=360)]  # 0 = front
    elevation_deg: Elevation
    background: Color | None  # None = as light or dark as the reader's other pages

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write the page and return its path."""
        page = viewer_page(
            pack(gaussians),
            title=UNTITLED if self.title is None else self.title,
            azimuth_deg=self.azimuth_deg,
            elevation_deg=self.elevation_deg,
            background=self.background,
        )
        path = folder / self.file_name
        with replacing(path) as temporary:
            temporary.write_text(page, encoding="utf-8")
        return [path]

    def contents(self, path: Path, gaussians: Gaussians) -> Contents:
        """Return the number of Gaussians and their SH degree; a page turns them upright itself."""
        return gaussians_in(self.size(len(gaussians)), up=None, sh_degree=gaussians.sh_degree)
