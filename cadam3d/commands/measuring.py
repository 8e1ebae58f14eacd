"""Measuring: call the metrics for an asset, and for the Gaussians from which its run started."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig

from cadam3d.build import component, components
from cadam3d.commands.messages import keeping_others, note, warn
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.base import Initializer
from cadam3d.io.records import MEASUREMENTS, NUMBERS
from cadam3d.metric.base import Measurand, Metric
from cadam3d.metric.protocol import Protocol
from cadam3d.metric.turn import facing
from cadam3d.state import start_generators


def build_metrics(cfg: DictConfig) -> dict[str, Metric]:
    """Return the chosen metrics by name. Raises ``UserError`` if something that one needs is missing.

    The protocol is checked even if no metric reads it.
    """
    component(cfg.protocol, Protocol, "protocol")
    metrics: dict[str, Metric] = components(cfg.metric, Metric, "metric")
    for metric in metrics.values():
        metric.prepare()
    return metrics


def measure(
    metrics: Mapping[str, Metric],
    measurand: Measurand,
    start: Callable[[], Gaussians] | None,
    warnings: list[str],
) -> dict[str, Any]:
    """Return the numbers of all metrics. If a metric fails, only its own are missing, and a warning is added.

    What the metrics declare about these numbers is under ``NUMBERS``. The records of how numbers were
    measured are under ``MEASUREMENTS``, which is missing if there are none.
    ``start`` returns the Gaussians at the start of the run. If it is None, they are not measured.
    """
    numbers: dict[str, Any] = {}
    details: dict[str, dict[str, Any]] = {}
    if measurand.truth is not None and metrics:
        with keeping_others("truth", warnings):
            measurand = replace(measurand, truth=facing(measurand.truth, measurand.render))
    for name, metric in metrics.items():
        with keeping_others(f"metric.{name}", warnings):
            measurement = metric.measure(measurand)
            numbers |= measurement.numbers
            details |= measurement.details
            for text in measurement.warnings:
                warn(f"metric.{name}: {text}", warnings)
    if measurand.truth is not None and start is not None and metrics:
        with keeping_others("initializer", warnings):
            first = start()
            beginning = replace(
                measurand, gaussians=first, render=partial(measurand.render, shown=first), asset=None
            )
            for metric in metrics.values():
                numbers |= metric.measure_start(beginning)
    declarations = {
        number.name: replace(number, metric=name).declaration()
        for name, metric in metrics.items()
        for number in metric.numbers
        if number.name in numbers
    }
    return {**numbers, NUMBERS: declarations} | ({MEASUREMENTS: details} if details else {})


def rebuild_start(prompt: str, initializer: Initializer, seed: int, device: torch.device) -> Gaussians:
    """Return the Gaussians that a run with these settings starts from."""
    beginning = initializer.begin(prompt, start_generators(seed)["initializer"], device)
    if beginning.note:
        note(beginning.note)
    return beginning.gaussians
