"""Ball: a cloud of nearly grey Gaussians around the origin, which needs no model and no file."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from cadam3d.core.checks import require_color, require_range
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.points import FromPoints, PointCloud, one_color, points_in_ball, require_count


@dataclass(frozen=True, kw_only=True)
class Ball(FromPoints):
    """``count`` Gaussians at uniformly random points of a ball; the prompt is not used."""

    count: int
    radius: float  # world units
    color: Sequence[float]  # mean RGB, in [0, 1]
    color_noise: float  # in [0, 1]

    def __post_init__(self) -> None:
        super().__post_init__()
        require_count(self.count)
        require_range("initializer.radius", self.radius, above=0, high=1)
        require_range("initializer.color_noise", self.color_noise, low=0, high=1)
        require_color("initializer.color", self.color)

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return Gaussians on ``device`` that fill the ball with equal density."""
        points = points_in_ball(self.count, self.radius, generator)
        deviation = self.color_noise * (2 * torch.rand(self.count, 3, generator=generator) - 1)
        rgb = (one_color(self.color, self.count) + deviation).clamp(0, 1)
        return self.gaussians_at(PointCloud(points, rgb), device)
