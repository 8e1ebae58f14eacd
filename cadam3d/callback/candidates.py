"""Candidates: whom each refinement chose, drawn, and how the scores were spread (paper fig. 6)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.callback.base import Callback
from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.checks import are_numbers, require, require_range, require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import rgb_to_sh0
from cadam3d.core.viewing import require_viewing
from cadam3d.io.image import step_picture, step_pictures, write_png
from cadam3d.io.jsonl import append_jsonl, truncate_after
from cadam3d.state import RefineReport, RunContext, TrainState

FOLDER_NAME = "candidates"
HISTOGRAMS = "histograms.jsonl"
SELECTED = (0.84, 0.37, 0.0)  # vermilion (Okabe and Ito): apart from grey for everyone, and in print
OTHERS = (0.72, 0.72, 0.72)
DECADES = (-12, 6)  # histograms end here; what lies beyond is counted in the outermost bins


@dataclass(frozen=True, kw_only=True)
class Candidates(Callback):
    """Writes ``candidates/step_000150.png`` and a line per score and refinement of ``histograms.jsonl``.

    A picture shows the population before the edit, as seen from each azimuth: as it looks, and beside it the
    selected Gaussians in vermilion among the others in grey. It looks and never draws a random number, so a
    run with it equals one without, bit for bit.
    """

    every: int  # steps; refinements at its multiples are drawn
    azimuths_deg: Sequence[float]  # one view each; 0 = front
    elevation_deg: float
    distance: float  # of the camera from the origin, world units
    fov_y_deg: float
    size: int  # pixels, height and width of each picture
    background: Sequence[float]  # RGB in [0, 1]
    bins_per_decade: int  # of the histograms, which are logarithmic

    def __post_init__(self) -> None:
        require_whole("callback.candidates.every", self.every, low=1, example=100)
        require(
            are_numbers(self.azimuths_deg, low=-360, high=360) and len(self.azimuths_deg) > 0,
            "callback.candidates.azimuths_deg",
            expected="at least one angle, each in [-360, 360]",
            got=self.azimuths_deg,
            example="'callback.candidates.azimuths_deg=[30]'",
        )
        require_range("callback.candidates.elevation_deg", self.elevation_deg, low=-90, high=90, example=15)
        require_viewing(
            "callback.candidates",
            distance=self.distance,
            fov_y_deg=self.fov_y_deg,
            size=self.size,
            background=self.background,
        )
        require_whole("callback.candidates.bins_per_decade", self.bins_per_decade, low=1, example=10)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Forget what a killed run had written after its last checkpoint."""
        folder = context.folder / FOLDER_NAME
        truncate_after(folder / HISTOGRAMS, state.step)
        for step, path in pictures(context.folder):
            if step > state.step:
                path.unlink()

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Write the histograms, and at multiples of ``every`` the picture."""
        population = report.population
        for score, values in population.scores.items():
            line = {"step": report.step, "score": score}
            line |= histogram(values, population.is_selected, self.bins_per_decade)
            append_jsonl(context.folder / FOLDER_NAME / HISTOGRAMS, line)
        if report.step % self.every == 0 and report.before > 0:
            path = step_picture(context.folder / FOLDER_NAME, report.step)
            write_png(path, self._picture(context, population.gaussians, population.is_selected))

    def _picture(
        self, context: RunContext, gaussians: Gaussians, is_selected: Bool[Tensor, "n"]
    ) -> Float[Tensor, "h w 3"]:
        """All views side by side, each as a pair: the look, then the mask."""
        cameras = self._cameras().to(gaussians.device)
        background = gaussians.means.new_tensor([list(self.background)] * len(cameras))
        with torch.no_grad():
            views = [
                context.rasterizer.render(each, cameras, background).rgb
                for each in (gaussians, marked(gaussians, is_selected))
            ]
        pairs = torch.cat(views, dim=2)
        return torch.cat(list(pairs), dim=1).cpu()

    def _cameras(self) -> Cameras:
        azimuth = torch.tensor(list(self.azimuths_deg), dtype=torch.float32)
        full = torch.ones_like(azimuth)
        around = full * self.elevation_deg, full * self.distance, full * self.fov_y_deg
        return orbit(azimuth, *around, self.size, self.size)


def marked(gaussians: Gaussians, is_selected: Bool[Tensor, "n"]) -> Gaussians:
    """The same Gaussians in two plain colours: the selected stand out, the others recede."""
    colors = gaussians.sh.new_tensor([OTHERS, SELECTED])[is_selected.long()]
    return Gaussians(
        means=gaussians.means,
        log_scales=gaussians.log_scales,
        quats=gaussians.quats,
        opacity_logits=gaussians.opacity_logits,
        sh=rgb_to_sh0(colors)[:, None],
    )


def histogram(
    values: Float[Tensor, "n"], is_selected: Bool[Tensor, "n"], bins_per_decade: int
) -> dict[str, Any]:
    """Counts over fixed logarithmic bins, of all and of the selected, and how many have no logarithm.

    Bin ``i`` of ``counts`` holds the values in ``[10**((first + i) / b), 10**((first + i + 1) / b))``, where
    ``b`` is ``bins_per_decade``; bins before and after those with counts are left out.
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
        "selected": _selected_counts(bins - first, is_selected[has_log], len(counts)),
        "without_log": int((~has_log).sum()),
    }


def _selected_counts(bins: Int[Tensor, "m"], is_selected: Bool[Tensor, "m"], length: int) -> list[int]:
    return bins[is_selected].bincount(minlength=length).tolist()


def pictures(run_folder: Path) -> list[tuple[int, Path]]:
    """Step and path of every picture of a run, in order."""
    return step_pictures(run_folder / FOLDER_NAME)
