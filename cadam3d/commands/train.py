"""``cadam3d train``: optimise an asset for a prompt and write it into a run folder."""

import logging
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from cadam3d import __version__
from cadam3d.commands.messages import note, note_backend
from cadam3d.commands.timetable import describe
from cadam3d.core.checks import require, require_whole
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn
from cadam3d.core.schedule import FAR_STEP
from cadam3d.densifier.refine import Refine
from cadam3d.exporter.base import Exporter
from cadam3d.io.atomic import remove_leftovers
from cadam3d.io.checkpoint import latest_checkpoint, load_checkpoint
from cadam3d.io.jsonl import read_jsonl, write_json
from cadam3d.io.run_folder import (
    ASSET,
    CHECKPOINTS,
    CONFIG,
    LOCK,
    METRICS,
    PREVIEW,
    SUMMARY,
    TURNTABLE,
    shown,
)
from cadam3d.metric.base import Metric
from cadam3d.rasterizer.base import Backend
from cadam3d.report import write_report
from cadam3d.settings.compose import component, components, flatten, load_config
from cadam3d.state import Outcome, RunContext, TrainState
from cadam3d.trainer import Trainer

log = logging.getLogger(__name__)

# Signals that arrive within this time of each other count as one.
TOGETHER_SECONDS = 1.0
LATEST = Path("outputs") / "latest"
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "camera", "refine", "optimizer")


def run(cfg: DictConfig) -> float | None:
    """Train, export, measure and report. Return the PSNR in dB if the prior has true images."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    device = resolve_device(cfg.device)
    for key, least in (("seed", 0), ("views", 1)):
        require_whole(key, cfg[key], low=least, example=3)
    require_determinism(device)

    # Everything that can be refused is refused here, before the folder changes.
    trainer = build_trainer(cfg, device)
    backend = trainer.rasterizer.prepare(device)
    exporters: dict[str, Exporter] = components(cfg.exporter)
    metrics: dict[str, Metric] = components(cfg.metric)
    memory = estimate_memory(cfg, trainer)
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    state = start_or_resume(cfg, trainer, device, folder)
    # The prior is loaded last, because an initializer may have needed the memory and has freed it now.
    trainer.prior.load()
    for text in filter(None, (trainer.prior.notice(), state.initial_note)):
        note(text)
    note_backend(backend)
    timetable = describe(trainer)
    print(f"Schedule: {timetable}", file=sys.stderr)

    remove_leftovers(folder)
    config_text = OmegaConf.to_yaml(cfg, resolve=True)
    (folder / CONFIG).write_text(config_text, encoding="utf-8")
    if not (folder / LOCK).exists():  # a sweep locks the folders of its jobs
        link_latest(folder)
    log.info("prompt %r, seed %d, on %s, from step %d", cfg.prompt, cfg.seed, device, state.step)
    log.info("schedule: %s", timetable)
    log.info("rasterizer=%s; %s", backend.name, backend.reason or "nothing faster is known here")

    render = trainer.renderer(state)
    context = RunContext(
        folder=folder,
        prompt=cfg.prompt,
        total_steps=trainer.steps,
        render=render,
        rasterizer=trainer.rasterizer,
    )
    with StopOnSignal() as stop:
        outcome = trainer.train(state, embedding, context, stop)
        log.info("%s after %d steps: %d Gaussians", outcome, state.step, len(state.gaussians))

        summary = summarize(cfg, state, outcome, backend) | memory | measure_memory(device)
        summary["schedule"] = timetable
        # The summary is written before the exports, which may fail.
        write_json(folder / SUMMARY, summary)
        gaussians = state.gaussians.detach()
        written, warnings = export(exporters, gaussians, render, folder)
        asset = folder / ASSET if folder / ASSET in written else None
        truth = trainer.prior.truth(cfg.prompt)
        for metric in metrics.values():
            summary |= metric.measure(gaussians, render, truth, asset)
        if asset is not None:
            summary["asset_bytes"] = asset.stat().st_size
        # This is the last entry of a complete summary.
        summary["warnings"] = warnings
        write_json(folder / SUMMARY, summary)

        report = write_report(
            folder,
            summary=summary,
            metrics=read_jsonl(folder / METRICS),
            config_text=config_text,
            charts=[*trainer.densifier.charts(), *trainer.guidance.charts()],
        )
    print_result(folder, summary, report)
    # This also applies if all steps were done already, so that a loop in a shell script ends.
    if stop.received is not None:
        sys.exit(128 + stop.received)
    return summary.get("psnr")


def require_determinism(device: torch.device) -> None:
    """Make torch refuse operations without reproducible results on the CPU, where training needs none.

    This has the effect of ``use_deterministic_algorithms``, which would load torch's compiler first and thus
    take more than a second.
    """
    torch.set_deterministic_debug_mode("error" if device.type == "cpu" else "default")


def build_trainer(cfg: DictConfig, device: torch.device) -> Trainer:
    """Build the components that ``cfg`` names, and move the prior to ``device``."""
    require_whole("steps", cfg.steps, low=1, high=FAR_STEP, example=600)
    refine: Refine = component(cfg.refine)
    require(
        refine.steps == cfg.steps,
        "refine.steps",
        expected=f"the length of the run, steps={cfg.steps}",
        got=refine.steps,
        example="refine.steps='${steps}'",
    )
    return Trainer(
        steps=cfg.steps,
        views=cfg.views,
        camera=component(cfg.camera),
        background=component(cfg.background),
        augmentation=component(cfg.augmentation),
        rasterizer=component(cfg.rasterizer),
        prior=component(cfg.prior).to(device),
        guidance=component(cfg.guidance),
        densifier=component(cfg.densifier),
        refine=refine,
        optimizer=component(cfg.optimizer),
        exposure=component(cfg.exposure),
        regularizers=components(cfg.regularizer),
        callbacks=list(components(cfg.callback).values()),
    )


def estimate_memory(cfg: DictConfig, trainer: Trainer) -> dict[str, float]:
    """Return the memory that the prior will need, in GiB, and print it before the work begins."""
    size = cfg.camera.get("size")
    estimate = trainer.prior.memory(cfg.prompt, cfg.negative_prompt, trainer.views, size)
    if estimate is None:
        return {}
    note(f"The prior will need about {estimate}. To reduce this, set vram=low or fewer views.")
    return {"memory_estimate_gib": round(estimate.total / 2**30, 3)}


def measure_memory(device: torch.device) -> dict[str, float]:
    """Return the peak memory of a CUDA device so far, in GiB, the Gaussians included."""
    if device.type != "cuda":
        return {}
    return {"memory_peak_gib": round(torch.cuda.max_memory_allocated(device) / 2**30, 3)}


def start_or_resume(cfg: DictConfig, trainer: Trainer, device: torch.device, folder: Path) -> TrainState:
    """Return the state before the first step, or that of a checkpoint if ``resume=`` names a run with one."""
    if cfg.resume is None:
        return trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, device)
    named = Path(cfg.resume)
    path = named if named.is_file() else latest_checkpoint(folder / CHECKPOINTS)
    if path is None:
        print(f"No checkpoint in {folder / CHECKPOINTS} yet: starting at step 0.", file=sys.stderr)
        return trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, device)
    state = TrainState.restore(load_checkpoint(path), trainer.optimizer, trainer.densifier, device)
    require(
        cfg.seed == state.seed,
        "seed",
        expected=f"{state.seed}, with which this run was started",
        got=cfg.seed,
        example="resume without seed=..., or start another run",
    )
    note_changes(cfg, folder)
    if state.step >= trainer.steps:
        print(f"{path.name} has all {state.step} steps; writing the outputs again.", file=sys.stderr)
    return state


def note_changes(cfg: DictConfig, folder: Path) -> None:
    """Print the settings that have changed, because the run then differs from an uninterrupted one."""
    if not (folder / CONFIG).is_file():
        return
    before = dict(flatten(OmegaConf.to_container(load_config(folder / CONFIG), resolve=True)))
    now = dict(flatten(OmegaConf.to_container(cfg, resolve=True)))
    for key in sorted(before.keys() | now.keys()):
        if key != "resume" and before.get(key) != now.get(key):
            print(f"Note: {key} was {before.get(key)!r}, is now {now.get(key)!r}", file=sys.stderr)


def link_latest(folder: Path) -> None:
    """Make ``outputs/latest`` a link to ``folder``. If the file system has no links, print a note."""
    try:
        LATEST.parent.mkdir(parents=True, exist_ok=True)
        target, base = folder.resolve(), LATEST.parent.resolve()
        fresh = LATEST.with_name(f".latest-{folder.name}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(target.relative_to(base) if target.is_relative_to(base) else target)
        try:
            fresh.replace(LATEST)
        finally:
            fresh.unlink(missing_ok=True)
    except OSError as error:
        print(f"Note: {LATEST} not updated ({error.strerror}).", file=sys.stderr)


def summarize(cfg: DictConfig, state: TrainState, outcome: Outcome, backend: Backend) -> dict[str, Any]:
    """Return the facts of a run, for ``summary.json`` and ``sweep.csv``."""
    choices: Mapping[str, str] = HydraConfig.get().runtime.choices
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
        "skipped_steps": state.skipped,
        "dimmed_steps": state.dimmed,
        **{name: choices.get(name) for name in COMPONENTS},
        **({"initializer_note": state.initial_note} if state.initial_note else {}),
        "device": str(state.gaussians.device),
        "cadam3d": __version__,
        "torch": torch.__version__,
        "finished_at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "backend": backend.name,
        **({"backend_reason": backend.reason} if backend.reason else {}),
    }


def export(
    exporters: Mapping[str, Exporter], gaussians: Gaussians, render: RenderFn, folder: Path
) -> tuple[list[Path], list[str]]:
    """Run all exporters; return the paths that they have written and a warning for each one that failed."""
    written: list[Path] = []
    warnings: list[str] = []
    for name, exporter in exporters.items():
        try:
            written += exporter.export(gaussians, render, folder)
        except (UserError, MemoryError, torch.OutOfMemoryError) as error:
            warnings.append(f"exporter.{name}: {error}")
            log.info("exporter.%s: %s", name, error)
            print(f"Warning: exporter.{name}: {error}", file=sys.stderr)
    return written, warnings


def print_result(folder: Path, summary: Mapping[str, Any], report: Path) -> None:
    """Print how the run ended, where its files are, and how to continue it if it was interrupted."""
    quality = f", PSNR {summary['psnr']:.2f} dB" if summary.get("psnr") is not None else ""
    print(
        f"{summary['outcome']} after {summary['steps']} steps, {summary['seconds']:.0f} s: "
        f"{summary['num_gaussians']} Gaussians{quality}"
    )
    for label, name in (("asset", ASSET), ("video", TURNTABLE), ("pictures", PREVIEW)):
        if (folder / name).exists():
            print(f"  {label:<9}{shown(folder / name)}")
    print(f"  {'report':<9}{shown(report)}")
    if summary["outcome"] == Outcome.INTERRUPTED:
        print(f"  continue with: cadam3d train resume={shown(folder)}")


class StopOnSignal:
    """Handles SIGINT and SIGTERM: after the first one the loop stops and saves, a later one stops it at once.

    Signals within ``TOGETHER_SECONDS`` count as one, because a scheduler sends its signal to a process and
    also to its parent, which passes it on.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._received_at = 0.0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "StopOnSignal":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self.received is not None

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        if self.received is not None:
            if time.monotonic() - self._received_at < TOGETHER_SECONDS:
                return
            raise KeyboardInterrupt
        self.received, self._received_at = number, time.monotonic()
        print("\nStopping as soon as everything is saved; interrupt again to stop at once.", file=sys.stderr)
