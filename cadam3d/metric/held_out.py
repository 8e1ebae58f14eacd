"""HeldOutSettings: the views from which metrics look at an asset, none of which a turntable shows."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.pictures import Elevations, PictureSettings, Views

# Views that are compared at once. This bounds the memory, because there is a true image per mode and view.
VIEWS_AT_ONCE = 4


@dataclass(frozen=True, kw_only=True)
class HeldOutSettings(PictureSettings):
    """The settings of pictures, and rings of azimuths at several elevations."""

    views: Views  # per elevation
    elevations_deg: Elevations

    def cameras(self) -> Cameras:
        """Return the held-out views.

        Their azimuths are half a step off a turntable's azimuths. Each elevation is shifted a little more, so
        that no two rings look from the same side.
        """
        step = 360.0 / self.views
        rings = len(self.elevations_deg)
        azimuth = torch.tensor(
            [(view + 0.5 + ring / (2 * rings)) * step for ring in range(rings) for view in range(self.views)]
        )
        elevation = torch.tensor([float(angle) for angle in self.elevations_deg]).repeat_interleave(
            self.views
        )
        return self.cameras_at(azimuth, elevation)

    def parts(self) -> Iterator[tuple[Cameras, Float[Tensor, "v 3"]]]:
        """Yield the held-out views and their backgrounds, a few views at a time."""
        for some in self.cameras().parts(VIEWS_AT_ONCE):
            yield some, self.backgrounds(len(some))
