"""Ply: starts from a file of Gaussians, or from a PLY file with a cloud of coloured points."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from cadam3d.core.checks import Color, Count, one_of, require
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.points import (
    Copies,
    FromObject,
    PointCloud,
    Radius,
    ReplicateLaw,
    one_color,
    replicated,
    rows_of,
)
from cadam3d.io.asset_file import PLY, file_format, read_gaussians, say_assumed
from cadam3d.io.frames import UPS, points_to_world, turned, turned_points
from cadam3d.io.ply import holds_gaussians, read_points
from cadam3d.io.ply_tables import read_header
from cadam3d.io.run_folder import found_file

# Point-E and most scans use this axis.
UP_OF_POINTS = "+z"
# Elements of a PLY that make a mesh of its vertices.
SURFACES = ("face", "tristrips")


@dataclass(frozen=True, kw_only=True)
class Ply(FromObject):
    """The Gaussians of a file, or the points of a PLY file; the prompt is not used.

    Gaussians (any format of ``io/asset_file.py``, any SH degree, written by any program) keep their shapes,
    colours and opacities. Points (text or binary, for example from Point-E or a scan) become round Gaussians
    with their colours.
    """

    path: str
    up: Annotated[str, one_of(UPS)] | None
    count: Count | None  # largest number of rows
    replicate: Copies  # Gaussians per point
    replicate_radius: Radius  # world units
    replicate_law: ReplicateLaw
    color: Color

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return the Gaussians of the file, or Gaussians at its points, on ``device``.

        Raises ``UserError`` if the file is missing, cannot be read or holds neither.
        """
        path = found_file(self.path, "initializer.path")
        if file_format(path) == PLY and not holds_gaussians(path):
            return self._cloud(path, generator, device)
        return self._asset(path, generator).to(device)

    def _asset(self, path: Path, generator: torch.Generator) -> Gaussians:
        require(
            self.replicate == 1,
            "initializer.replicate",
            expected="1, since this file holds Gaussians",
            got=self.replicate,
        )
        asset = turned(read_gaussians(path, up=self.up, key="initializer.up"), self.turn_deg)
        _require_finite(path, "means", asset.means)
        asset = asset.index(rows_of(len(asset), self.count, generator))
        means, factor = self.placed(asset.means)
        sh = asset.sh
        if self.sh_degree is not None:
            wanted = (self.sh_degree + 1) ** 2
            sh = torch.nn.functional.pad(sh[:, :wanted], (0, 0, 0, max(wanted - sh.shape[1], 0)))
        return replace(asset, means=means, log_scales=asset.log_scales + math.log(factor), sh=sh)

    def _cloud(self, path: Path, generator: torch.Generator, device: torch.device) -> Gaussians:
        header = read_header(path)
        if any(element.name in SURFACES and element.count for element in header.elements):
            raise UserError(
                f"initializer.path: expected a file of Gaussians or points, got {self.path!r}, which is a "
                "mesh. Try: initializer=mesh"
            )
        positions, colors = read_points(header)
        if self.up is None:
            say_assumed(path, UP_OF_POINTS, "initializer.up")
        points = torch.from_numpy(positions)
        _require_finite(path, "points", points)
        rgb = one_color(self.color, len(points)) if colors is None else torch.from_numpy(colors)
        upright = turned_points(points_to_world(points, self.up or UP_OF_POINTS), self.turn_deg)
        rows = rows_of(len(points), self.count, generator)
        cloud = PointCloud(self.placed(upright[rows])[0], rgb[rows])
        cloud = replicated(cloud, self.replicate, self.replicate_radius, generator, self.replicate_law)
        return self.gaussians_at(cloud, device)


def _require_finite(path: Path, name: str, rows: Tensor) -> None:
    is_usable = len(rows) > 0 and bool(rows.isfinite().all())
    require(is_usable, "initializer.path", expected=f"finite {name} in the file", got=str(path))
