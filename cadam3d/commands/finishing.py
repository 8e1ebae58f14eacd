"""Finishing: what training writes and prints after its last step."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from cadam3d import __version__
from cadam3d.build import component, components
from cadam3d.commands.measuring import build_metrics, measure
from cadam3d.commands.writing import run_exporters
from cadam3d.core.console import show
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import Truth
from cadam3d.exporter.base import Exporter
from cadam3d.io.jsonl import write_json
from cadam3d.io.records import psnr_of
from cadam3d.io.run_folder import ASSET, PREVIEW, REPORT, SUMMARY, TURNTABLE, shown
from cadam3d.metric.base import Measurand, Metric
from cadam3d.prior.base import DiffusionPrior
from cadam3d.prior.truth import TruthSource
from cadam3d.rasterizer.base import Backend
from cadam3d.settings.line import continuing
from cadam3d.state import Outcome, RunContext, TrainState

COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "camera", "refine", "optimizer")


@dataclass(frozen=True)
class Results:
    """The files and numbers that are made of the Gaussians after the last step."""

    exporters: Mapping[str, Exporter]
    metrics: Mapping[str, Metric]
    measures_start: bool  # whether the Gaussians at the start are measured too
    truth: Truth | None  # the true object of the prompt

    @classmethod
    def of(cls, cfg: DictConfig, prior: DiffusionPrior) -> "Results":
        """Return what the settings ask for. Raises ``UserError`` for wrong settings."""
        source: TruthSource = component(cfg.truth, TruthSource, "truth")
        return cls(
            exporters=components(cfg.exporter, Exporter, "exporter"),
            metrics=build_metrics(cfg),
            measures_start=source.measures_start,
            truth=source.of(cfg.prompt, prior),
        )

    def write(
        self,
        context: RunContext,
        gaussians: Gaussians,
        start: Callable[[], Gaussians] | None,
        summary: dict[str, Any],
    ) -> None:
        """Export and measure ``gaussians``, and complete ``summary``, in place and on disk."""
        # The summary is written before the exports, which may fail.
        write_json(context.folder / SUMMARY, summary)

        def write(exporter: Exporter) -> list[Path]:
            chosen = exporter.simplified(gaussians, context.rasterizer.render)
            return exporter.export(chosen, context.render, context.folder)

        outputs, warnings = run_exporters(self.exporters, gaussians, write, is_needed=False)
        path = context.folder / ASSET
        asset = path if any(output.path == path for output in outputs) else None
        measurand = Measurand(
            gaussians=gaussians, render=context.render, prompt=context.prompt, truth=self.truth, asset=asset
        )
        summary |= measure(self.metrics, measurand, start, warnings)
        summary["files"] = [
            output.path.name for output in outputs if output.exporter and output.exporter.files
        ]
        if asset is not None:
            summary["asset_bytes"] = asset.stat().st_size
        # This is the last entry of a complete summary.
        summary["warnings"] = warnings
        write_json(context.folder / SUMMARY, summary)


def summarize(
    cfg: DictConfig, choices: Mapping[str, str], state: TrainState, outcome: Outcome, backend: Backend
) -> dict[str, Any]:
    """Return the facts of a run, for ``summary.json`` and ``sweep.csv``."""
    return {
        "prompt": cfg.prompt,
        "negative_prompt": cfg.negative_prompt,
        "seed": cfg.seed,
        "steps": state.step,
        "steps_asked": cfg.steps,
        "outcome": str(outcome),
        "num_gaussians_initial": state.num_initial,
        "num_gaussians": len(state.gaussians),
        "seconds": round(state.seconds, 2),
        "cpu_seconds": round(state.cpu_seconds, 2),
        "skipped_steps": state.skipped,
        "dimmed_steps": state.dimmed,
        **{name: choices.get(name) for name in COMPONENTS},
        **({"truth": choices["truth"]} if choices.get("truth", "prior") != "prior" else {}),
        **({"initializer_note": state.initial_note} if state.initial_note else {}),
        "device": str(state.gaussians.device),
        "cadam3d": __version__,
        "torch": torch.__version__,
        "finished_at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "backend": backend.name,
        **({"backend_reason": backend.reason} if backend.reason else {}),
    }


def measure_memory(device: torch.device) -> dict[str, float]:
    """Return the peak memory of a CUDA device so far, in GiB, the Gaussians included."""
    if device.type != "cuda":
        return {}
    return {"memory_peak_gib": round(torch.cuda.max_memory_allocated(device) / 2**30, 3)}


def print_result(folder: Path, summary: Mapping[str, Any]) -> None:
    """Print how the run ended, where its files are, and how to continue it if it was interrupted."""
    psnr = psnr_of(summary)
    quality = "" if psnr is None else f", PSNR {psnr:.2f} dB"
    if turn := summary.get("turn_deg"):
        quality += f" at a turn of {turn:.0f} degrees"
    show(
        f"{summary['outcome']} after {summary['steps']} steps, {summary['seconds']:.0f} s: "
        f"{summary['num_gaussians']} Gaussians{quality}"
    )
    for label, name in (("asset", ASSET), ("video", TURNTABLE), ("pictures", PREVIEW), ("report", REPORT)):
        if (folder / name).exists():
            show(f"  {label:<9}{shown(folder / name)}")
    for name in summary.get("files", []):
        if name not in (ASSET, TURNTABLE, PREVIEW):
            show(f"  {'file':<9}{shown(folder / name)}")
    if summary["outcome"] == Outcome.INTERRUPTED:
        show(f"  continue with: {continuing(folder)}")
