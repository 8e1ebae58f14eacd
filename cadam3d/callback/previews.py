"""Previews: a contact sheet every so many steps, so that a run gone wrong is seen early."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from cadam3d.callback.base import Callback
from cadam3d.core.cameras import turntable
from cadam3d.core.checks import require_range, require_whole
from cadam3d.core.viewing import require_viewing
from cadam3d.io.image import contact_sheet, step_picture, step_pictures, write_png
from cadam3d.state import RunContext, StepReport, TrainState

FOLDER_NAME = "previews"


@dataclass(frozen=True, kw_only=True)
class Previews(Callback):
    """Writes ``previews/step_000100.png``: the object from all around, the front first.

    Several faces, or an object that is empty, flat or off centre, show here long before the end.
    """

    every: int | None  # steps between sheets; null = never
    views: int  # azimuths, evenly spaced
    elevation_deg: float
    distance: float  # of the camera from the origin, world units
    fov_y_deg: float
    size: int  # pixels, height and width of each picture
    background: Sequence[float]  # RGB in [0, 1]

    def __post_init__(self) -> None:
        if self.every is not None:
            require_whole("callback.previews.every", self.every, low=1, example=100)
        require_whole("callback.previews.views", self.views, low=1, example=4)
        require_range("callback.previews.elevation_deg", self.elevation_deg, low=-90, high=90, example=15)
        require_viewing(
            "callback.previews",
            distance=self.distance,
            fov_y_deg=self.fov_y_deg,
            size=self.size,
            background=self.background,
        )

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Forget what a killed run had drawn after its last checkpoint."""
        for step, path in step_pictures(context.folder / FOLDER_NAME):
            if step > state.step:
                path.unlink()

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Draw the Gaussians as they stand, at multiples of ``every``."""
        if self.every is None or report.step % self.every != 0:
            return
        cameras = turntable(
            self.views,
            elevation_deg=self.elevation_deg,
            distance=self.distance,
            fov_y_deg=self.fov_y_deg,
            size=self.size,
        )
        images = context.render(cameras, torch.tensor([list(self.background)] * self.views)).rgb.cpu()
        labels = [f"{azimuth % 360:.0f}" for azimuth in cameras.azimuth_deg.tolist()]
        sheet = contact_sheet(images.clamp(0, 1), columns=self.views, labels=labels)
        write_png(step_picture(context.folder / FOLDER_NAME, report.step), sheet)
