"""The settings that all pictures of Gaussians share, with their checks and cameras.

``PictureSettings`` have a background colour. ``CutoutSettings`` may have a transparent background instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit, turntable
from cadam3d.core.checks import Color, Declared, Positive, are_numbers, require, require_color, whole, within

# Far more than anyone looks at.
MOST_VIEWS = 10_000  # pictures of one asset
MOST_PIXELS = 16_384  # along the edge of a picture
TRANSPARENT = "transparent"


def require_angles(key: str, angles_deg: object, *, limit: int) -> None:
    """Raise ``UserError`` unless ``angles_deg`` is a list of angles in [-limit, limit] degrees."""
    is_angles = are_numbers(angles_deg, low=-limit, high=limit) and len(angles_deg) > 0
    require(is_angles, key, expected=f"at least one angle, each in [-{limit}, {limit}]", got=angles_deg)


Views = Annotated[int, whole(low=1, high=MOST_VIEWS)]
Elevations = Annotated[Sequence[float], partial(require_angles, limit=90)]


@dataclass(frozen=True, kw_only=True)
class ViewSettings(Declared):
    """Distance, field of view and size of square pictures of an asset."""

    distance: Positive  # world units
    fov_y_deg: Annotated[float, within(above=0, below=180)]
    size: Annotated[int, whole(low=1, high=MOST_PIXELS)]
    background: Sequence[float] | str  # RGB in [0, 1], or TRANSPARENT where that is allowed

    def ring(self, views: int, elevation_deg: float) -> Cameras:
        """Return ``views`` cameras evenly spaced over one full turn, starting at the front."""
        return turntable(
            views,
            elevation_deg=elevation_deg,
            distance=self.distance,
            fov_y_deg=self.fov_y_deg,
            size=self.size,
        )

    def cameras_at(self, azimuths_deg: Float[Tensor, "v"], elevations_deg: Float[Tensor, "v"]) -> Cameras:
        """Return one camera for each pair of angles, in degrees; azimuth 0 is the front."""
        full = torch.ones_like(azimuths_deg)
        return orbit(
            azimuths_deg, elevations_deg, full * self.distance, full * self.fov_y_deg, self.size, self.size
        )

    def backgrounds(self, views: int) -> Float[Tensor, "v 3"]:
        """Return the background colour once per view; black if the pictures are transparent."""
        color = (0.0, 0.0, 0.0) if isinstance(self.background, str) else self.background
        return torch.tensor([[float(channel) for channel in color]] * views)


@dataclass(frozen=True, kw_only=True)
class PictureSettings(ViewSettings):
    """Distance, field of view, size and background of square pictures of an asset.

    Exporters, callbacks and metrics that render inherit these four settings and add their own angles.
    """

    background: Color


@dataclass(frozen=True, kw_only=True)
class CutoutSettings(ViewSettings):
    """The same four settings for pictures that may be transparent where there is no object."""

    background: Annotated[Sequence[float] | str, partial(require_color, otherwise=TRANSPARENT)]

    @property
    def is_transparent(self) -> bool:
        """Return whether the pictures have a fourth channel instead of a background."""
        return isinstance(self.background, str) and self.background == TRANSPARENT
