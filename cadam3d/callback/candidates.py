"""Candidates: pictures of the Gaussians that each refinement selects, and score histograms (paper fig. 6)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.callback.base import Callback
from cadam3d.core.checks import Count, Elevation, whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.pictures import PictureSettings, require_angles
from cadam3d.core.sh import rgb_to_sh0
from cadam3d.io.image import drop_step_pictures, step_picture, write_png
from cadam3d.io.jsonl import append_jsonl, truncate_after
from cadam3d.io.run_folder import CANDIDATES, HISTOGRAMS
from cadam3d.state import RefineReport, RunContext, TrainState

# Vermilion of Okabe and Ito, which differs from grey with any colour vision, and in print.
SELECTED = (0.84, 0.37, 0.0)
OTHERS = (0.72, 0.72, 0.72)
# Powers of ten at which histograms end; values beyond are counted in the outermost bins.
DECADES = (-12, 6)


@dataclass(frozen=True, kw_only=True)
class Candidates(PictureSettings, Callback):
    """Write ``candidates/step_000150.png``, and a line per score and refinement of ``histograms.jsonl``.

    A picture shows the population before the edit from each azimuth: as it is rendered, and beside it the
    selected Gaussians in vermilion among the others in grey. This callback never draws a random number, so it
    does not change the run.
    """

    every: Count  # steps
    azimuths_deg: Annotated[Sequence[float], partial(require_angles, limit=360)]
    elevation_deg: Elevation
    bins_per_decade: Annotated[int, whole(low=1, high=1000)]

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Delete lines and pictures that a killed run wrote after its last checkpoint."""
        truncate_after(context.folder / HISTOGRAMS, state.step)
        drop_step_pictures(context.folder / CANDIDATES, state.step)

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Write the histograms, and at multiples of ``every`` the picture too."""
        population = report.population
        for score, values in population.scores.items():
            line = {"step": report.step, "score": score}
            line |= histogram(values, population.is_selected, self.bins_per_decade)
            append_jsonl(context.folder / HISTOGRAMS, line)
        if report.step % self.every == 0 and report.before > 0:
            path = step_picture(context.folder / CANDIDATES, report.step)
            write_png(path, self._picture(context, population.gaussians, population.is_selected))

    def _picture(
        self, context: RunContext, gaussians: Gaussians, is_selected: Bool[Tensor, "n"]
    ) -> Float[Tensor, "h w 3"]:
        """Return all views side by side, each as a pair: the rendered image, then the selection."""
        azimuths = torch.tensor([float(azimuth) for azimuth in self.azimuths_deg])
        elevations = torch.full_like(azimuths, self.elevation_deg)
        cameras = self.cameras_at(azimuths, elevations).to(gaussians.device)
        background = self.backgrounds(len(cameras)).to(gaussians.means)
        with torch.no_grad():
            views = [
                context.rasterizer.render(each, cameras, background).rgb
                for each in (gaussians, marked(gaussians, is_selected))
            ]
        pairs = torch.cat(views, dim=2)
        return torch.cat(list(pairs), dim=1).cpu()


def marked(gaussians: Gaussians, is_selected: Bool[Tensor, "n"]) -> Gaussians:
    """Return the same Gaussians in two plain colours, one for the selected and one for the others."""
    colors = gaussians.sh.new_tensor([OTHERS, SELECTED])[is_selected.long()]
    return replace(gaussians, sh=rgb_to_sh0(colors)[:, None])


def histogram(
    values: Float[Tensor, "n"], is_selected: Bool[Tensor, "n"], bins_per_decade: int
) -> dict[str, Any]:
    """Return counts over fixed logarithmic bins, of all and of the selected, and how many have no logarithm.

    Bin ``i`` of ``counts`` contains the values in ``[10**((first + i) / b), 10**((first + i + 1) / b))``,
    where ``b`` is ``bins_per_decade``. Empty bins at both ends are left out.
    """
    values, is_selected = values.detach().double().cpu(), is_selected.cpu()
    has_log = values.isfinite() & (values > 0)
    outermost = bins_per_decade * DECADES[0], bins_per_decade * DECADES[1] - 1
    bins = (values[has_log].log10() * bins_per_decade).floor().clamp(*outermost).long()
    first = int(bins.min()) if len(bins) else 0
    counts = (bins - first).bincount()
    return {
        "bins_per_decade": bins_per_decade,
        "first": first,
        "counts": counts.tolist(),
        "selected": (bins - first)[is_selected[has_log]].bincount(minlength=len(counts)).tolist(),
        "without_log": int((~has_log).sum()),
    }
