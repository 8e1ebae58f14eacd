"""Previews: writes a contact sheet every so many steps, so that a failing run is noticed early."""

from dataclasses import dataclass

from cadam3d.callback.base import Callback
from cadam3d.core.checks import Count, Elevation
from cadam3d.core.pictures import PictureSettings, Views
from cadam3d.io.image import contact_sheet, drop_step_pictures, step_picture, write_png
from cadam3d.io.run_folder import PREVIEWS
from cadam3d.state import RunContext, StepReport, TrainState


@dataclass(frozen=True, kw_only=True)
class Previews(PictureSettings, Callback):
    """Write ``previews/step_000100.png``: the object from all sides, the front first.

    Several faces, or an object that is empty, flat or off centre, are visible here long before the end.
    """

    every: Count | None  # steps
    views: Views
    elevation_deg: Elevation

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Delete pictures that a killed run drew after its last checkpoint."""
        drop_step_pictures(context.folder / PREVIEWS, state.step)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Draw the current Gaussians at multiples of ``every``."""
        if self.every is None or report.step % self.every != 0:
            return
        cameras = self.ring(self.views, self.elevation_deg)
        images = context.render(cameras, self.backgrounds(self.views)).rgb.cpu()
        labels = [f"{azimuth % 360:.0f}" for azimuth in cameras.azimuth_deg.tolist()]
        sheet = contact_sheet(images.clamp(0, 1), columns=self.views, labels=labels)
        write_png(step_picture(context.folder / PREVIEWS, report.step), sheet)
