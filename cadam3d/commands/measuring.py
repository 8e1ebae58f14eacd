"""Measure: what the metrics say about an asset and about the Gaussians that its run started from."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from cadam3d.commands.messages import keeping_others, note
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, Truth
from cadam3d.initializer.base import Initializer
from cadam3d.metric.base import Metric
from cadam3d.metric.turn import facing
from cadam3d.state import start_generators


def measure(
    metrics: Mapping[str, Metric],
    gaussians: Gaussians,
    render: RenderFn,
    truth: Truth | None,
    asset: Path | None,
    start: Callable[[], Gaussians] | None,
    warnings: list[str],
) -> dict[str, Any]:
    """Return the numbers of all metrics. A metric that fails costs only its own numbers, and adds a warning.

    ``start`` returns the Gaussians at the start of the run. If it is None, they are not measured.
    """
    numbers: dict[str, Any] = {}
    if truth is not None and metrics:
        with keeping_others("truth", warnings):
            truth = facing(truth, render)
    for name, metric in metrics.items():
        with keeping_others(f"metric.{name}", warnings):
            numbers |= metric.measure(gaussians, render, truth, asset)
    if truth is not None and start is not None and metrics:
        with keeping_others("initializer", warnings):
            first = start()
            for metric in metrics.values():
                numbers |= metric.measure_start(first, partial(render, shown=first), truth)
    return numbers


def rebuild_start(prompt: str, initializer: Initializer, seed: int, device: torch.device) -> Gaussians:
    """Return the Gaussians that a run with these settings starts from."""
    beginning = initializer.begin(prompt, start_generators(seed)["initializer"], device)
    if beginning.note:
        note(beginning.note)
    return beginning.gaussians
