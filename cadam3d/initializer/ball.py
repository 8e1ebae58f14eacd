"""Ball: a cloud of nearly grey Gaussians around the origin, which needs no model and no file."""

from dataclasses import dataclass

import torch

from cadam3d.core.checks import Color, Share
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.points import FromPoints, PointCloud, Radius, Rows, one_color, points_in_ball


@dataclass(frozen=True, kw_only=True)
class Ball(FromPoints):
    """``count`` Gaussians at uniformly random points of a ball; the prompt is not used."""

    count: Rows
    radius: Radius  # world units
    color: Color  # mean
    color_noise: Share

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return Gaussians on ``device`` that fill the ball with equal density."""
        points = points_in_ball(self.count, self.radius, generator)
        deviation = self.color_noise * (2 * torch.rand(self.count, 3, generator=generator) - 1)
        rgb = (one_color(self.color, self.count) + deviation).clamp(0, 1)
        return self.gaussians_at(PointCloud(points, rgb), device)
