"""The settings that all pictures of Gaussians share, with their checks and cameras.

``PictureSettings`` have a background colour. ``CutoutSettings`` may have a transparent background instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit, turntable
from cadam3d.core.checks import are_numbers, require, require_color, require_range, require_whole

# Far more than anyone looks at.
MOST_VIEWS = 10_000  # pictures of one asset
MOST_PIXELS = 16_384  # along the edge of a picture
TRANSPARENT = "transparent"


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """Distance, field of view and size of square pictures of an asset."""

    # Node of the configuration, such as "exporter.preview", with which error messages begin.
    node: ClassVar[str]

    distance: float  # > 0, world units
    fov_y_deg: float  # in (0, 180)
    size: int  # >= 1, pixels
    background: Sequence[float] | str  # RGB in [0, 1], or TRANSPARENT where that is allowed

    def __post_init__(self) -> None:
        require_range(f"{self.node}.distance", self.distance, above=0)
        require_range(f"{self.node}.fov_y_deg", self.fov_y_deg, above=0, below=180)
        require_whole(f"{self.node}.size", self.size, low=1, high=MOST_PIXELS)

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

    def require_views(self, views: int) -> None:
        """Raise ``UserError`` unless ``views`` is a reasonable number of pictures."""
        require_whole(f"{self.node}.views", views, low=1, high=MOST_VIEWS)

    def require_angles(self, name: str, angles_deg: object, *, limit: int) -> None:
        """Raise ``UserError`` unless setting ``name`` is a list of angles in [-limit, limit] degrees."""
        key = f"{self.node}.{name}"
        require(
            are_numbers(angles_deg, low=-limit, high=limit) and len(angles_deg) > 0,
            key,
            expected=f"at least one angle, each in [-{limit}, {limit}]",
            got=angles_deg,
        )


@dataclass(frozen=True, kw_only=True)
class PictureSettings(ViewSettings):
    """Distance, field of view, size and background of square pictures of an asset.

    Exporters, callbacks and metrics that render inherit these four settings and add their own angles.
    """

    background: Sequence[float]  # RGB in [0, 1]

    def __post_init__(self) -> None:
        super().__post_init__()
        require_color(f"{self.node}.background", self.background)


@dataclass(frozen=True, kw_only=True)
class CutoutSettings(ViewSettings):
    """The same four settings for pictures that may be transparent where there is no object."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.is_transparent:
            require_color(f"{self.node}.background", self.background, otherwise=f" or {TRANSPARENT}")

    @property
    def is_transparent(self) -> bool:
        """Return whether the pictures have a fourth channel instead of a background."""
        return isinstance(self.background, str) and self.background == TRANSPARENT
