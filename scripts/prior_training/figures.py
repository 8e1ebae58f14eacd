"""The picture of a training: its losses, and the errors of the denoiser on held-out views."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from prior_training.denoiser import LEVELS

CAPTIONS = ("right", "empty", "wrong")


def write_curves(logged: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG with the loss of each stage over its steps, and the last errors of the denoiser.

    ``logged`` is what ``stages.curves`` returns. A stage that was too short to log a loss has an empty plot.
    """
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    plots = figure.subplots(1, 3)
    for plot, stage in zip(plots, ("autoencoder", "denoiser"), strict=False):
        rows = [row for row in logged if row["stage"] == stage and "loss" in row]
        plot.plot([row["step"] for row in rows], [row["loss"] for row in rows])
        plot.set(title=f"{stage}: loss", xlabel="step")
        if rows:
            plot.set_yscale("log")
    last = next(row for row in reversed(logged) if "right" in row)
    for caption in CAPTIONS:
        plots[2].plot(LEVELS, last[caption], marker="o", label=caption)
    plots[2].set(title="denoiser: error on held-out views", xlabel="level of noise t")
    plots[2].legend(title="caption")
    figure.savefig(path, dpi=100)
