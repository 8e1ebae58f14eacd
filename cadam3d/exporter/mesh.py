"""MeshExporter: the surface of the asset as triangles, for programs that do not read Gaussians."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cadam3d.core.checks import one_of, require_extra, whole
from cadam3d.core.console import say
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.surface import SurfaceSettings
from cadam3d.core.rendering import RenderFn
from cadam3d.exporter.base import Contents, Exporter
from cadam3d.io.atlas import paint
from cadam3d.io.frames import UPS
from cadam3d.io.mesh import FORMATS, read_mesh, write_glb, write_mesh_ply, write_obj, write_stl

# Slicers and printers have +z up, glTF and most editors +y.
USUAL_UP = {"glb": "+y", "obj": "+y", "ply": "+y", "stl": "+z"}


@dataclass(frozen=True, kw_only=True)
class MeshExporter(SurfaceSettings, Exporter):
    """Write ``asset_mesh.glb``, ``.obj``, ``.ply`` or ``.stl``: the outer surface, in stl without colours."""

    node: ClassVar[str] = "exporter.mesh"
    files: ClassVar = tuple(f"asset_mesh.{each}" for each in FORMATS)
    suffix_setting: ClassVar = "format"
    yields: ClassVar = True
    loss: ClassVar = "a closed surface in place of Gaussians"
    sh_loss: ClassVar = "without view-dependent colours"

    format: Annotated[str, one_of(FORMATS)]
    up: Annotated[str, one_of(UPS)] | None  # axis of the file; None = USUAL_UP
    texture: Annotated[int, whole(low=64, high=8192)] | None  # pixels per side; None = vertex colours
    textured_triangles: Annotated[int, whole(low=100, high=2**31)]  # at most, with a texture

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.texture is not None:
            has_textures = self.format not in ("ply", "stl")
            self.expect(has_textures, "texture", f"null, because {self.format} has no textures", "null")
            require_extra("exporter.mesh.texture", "texture", "xatlas")

    @property
    def up_axis(self) -> str:
        """Return the up axis of the file."""
        return self.up or USUAL_UP[self.format]

    def losses(self, sh_degree: int) -> str:
        """Return what a mesh loses of Gaussians."""
        return f"{self.loss}, without colours" if self.format == "stl" else super().losses(sh_degree)

    def most_triangles(self) -> int | None:
        """Return the most triangles that the surface may have.

        A texture has the details of the colours, so it needs fewer of them, and large ones. Many small
        triangles are slow to unwrap, and some get no texel of their own.
        """
        if self.texture is None:
            return self.triangles
        return min(self.textured_triangles, self.triangles or self.textured_triangles)

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write the mesh, and return the paths of its files; only an obj with a texture has several.

        Raises ``UserError`` if the asset has no surface or if a file cannot be written.
        """
        surface, painter = self.surface(gaussians)
        if surface.is_smoothed:
            lost = f"smoothing removes {surface.roughness:.0%} of the area of its surface"
            say(f"Note: {self.node}: the asset is fuzzy, and {lost}. The mesh is smooth.", logging.WARNING)
        texture = None if self.texture is None else paint(surface, painter.colors, self.texture)
        path = folder / self.file_name
        if self.format == "obj":
            return write_obj(path, surface, up=self.up_axis, texture=texture)
        if self.format == "ply":
            write_mesh_ply(path, surface, up=self.up_axis)
        elif self.format == "stl":
            write_stl(path, surface, up=self.up_axis)
        else:
            write_glb(path, surface, up=self.up_axis, texture=texture)
        return [path]

    def contents(self, path: Path, gaussians: Gaussians) -> Contents:
        """Return the number of triangles and the axes; a texture or a material has none.

        Raises ``UserError`` if the file cannot be read.
        """
        if path.suffix.removeprefix(".") != self.format:
            return Contents(words="belongs to the mesh")
        mesh = read_mesh(path)
        closed = "watertight" if mesh.is_watertight else "not watertight"
        words = f"{len(mesh.faces):,} triangles, {closed}, area {mesh.area:.3g}, volume {mesh.volume:.3g}"
        return Contents(words=words, up=self.up_axis, triangles=len(mesh.faces))
