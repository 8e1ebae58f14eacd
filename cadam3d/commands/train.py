"""``cadam3d train``: a prompt in, a run folder with an asset out."""

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
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from cadam3d import __version__
from cadam3d.commands.notes import note, note_backend
from cadam3d.commands.paths import shown
from cadam3d.core.checks import UserError, require, require_whole
from cadam3d.core.device import resolve_device
from cadam3d.exporter.base import Exporter
from cadam3d.io.atomic import remove_leftovers
from cadam3d.io.checkpoint import latest_checkpoint, load_checkpoint
from cadam3d.io.jsonl import read_jsonl, write_json
from cadam3d.metric.base import Metric
from cadam3d.prior.base import MemoryEstimate
from cadam3d.report import write_report
from cadam3d.settings.compose import component, components, flatten, load
from cadam3d.state import Outcome, RunContext, TrainState
from cadam3d.trainer import Trainer

log = logging.getLogger(__name__)

TOGETHER_SECONDS = 1.0  # signals closer than this are one
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "camera", "refine", "optimizer")


class StopOnSignal:
    """The first SIGINT or SIGTERM asks the loop to stop and save; a later one stops at once.

    Later than ``TOGETHER_SECONDS``: a scheduler sends its signal to a process and to its parent, which passes
    it on, and means one.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._received_at = 0.0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "StopOnSignal":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Whether a signal came."""
        return self.received is not None

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.received is not None:
            if time.monotonic() - self._received_at < TOGETHER_SECONDS:
                return
            raise KeyboardInterrupt
        self.received, self._received_at = number, time.monotonic()
        print("\nStopping as soon as all is saved; once more to stop at once.", file=sys.stderr)


def run(cfg: DictConfig) -> float | None:
    """Train, export, measure and report; returns the PSNR in dB where the prior knows the truth."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    device = resolve_device(cfg.device)
    for key, least in (("seed", 0), ("steps", 1), ("views", 1)):
        require_whole(key, cfg[key], low=least, example=3)
    # Same seed, same bytes: on the CPU every operation we use has a deterministic form.
    # The same as use_deterministic_algorithms, which would load torch's compiler first: more than a second.
    torch.set_deterministic_debug_mode("error" if device.type == "cpu" else "default")
    trainer = build_trainer(cfg, device)
    backend = trainer.rasterizer.prepare(device)
    exporters: dict[str, Exporter] = components(cfg.exporter)
    metrics: dict[str, Metric] = components(cfg.metric)

    estimate = _estimate_memory(cfg, trainer)
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    state = _start_or_resume(cfg, trainer, device, folder)
    trainer.prior.load()  # only now: an initializer may have needed the memory, and has given it back
    for text in filter(None, (trainer.prior.notice(), state.initial_note)):
        note(text)
    note_backend(backend)
    remove_leftovers(folder)
    config_text = OmegaConf.to_yaml(cfg, resolve=True)
    (folder / "config.yaml").write_text(config_text, encoding="utf-8")
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        _point_latest_at(folder)

    log.info("prompt %r, seed %d, on %s, from step %d", cfg.prompt, cfg.seed, device, state.step)
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
        summary = summarize(cfg, state, outcome)
        summary["backend"] = backend.name
        if backend.reason:
            summary["backend_reason"] = backend.reason
        summary |= _memory(estimate, device)
        write_json(folder / "summary.json", summary)  # first of all: pictures may fail, the numbers stay
        gaussians = state.gaussians.detach()
        warnings = _export(exporters, gaussians, render, folder)
        truth = trainer.prior.truth(cfg.prompt)
        for metric in metrics.values():
            summary |= metric.measure(gaussians, render, truth)
        summary |= {"warnings": warnings}
        if (asset := folder / "asset.ply").is_file():
            summary["asset_bytes"] = asset.stat().st_size
        log.info("%s after %d steps: %d Gaussians", outcome, state.step, len(gaussians))
        write_json(folder / "summary.json", summary)
        lines = read_jsonl(folder / "metrics.jsonl")
        charts = (*trainer.densifier.charts(), *trainer.guidance.charts())
        report = write_report(folder, summary=summary, metrics=lines, config_text=config_text, charts=charts)
    _say(folder, summary, report)
    if stop.received is not None:  # also where training was done already: a sweep must not go on
        sys.exit(128 + stop.received)
    return summary.get("psnr")


def build_trainer(cfg: DictConfig, device: torch.device) -> Trainer:
    """Wire the components that ``cfg`` names; the prior moves to ``device``."""
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
        refine=component(cfg.refine),
        optimizer=component(cfg.optimizer),
        exposure=component(cfg.exposure),
        regularizers=components(cfg.regularizer),
        callbacks=list(components(cfg.callback).values()),
    )


def summarize(cfg: DictConfig, state: TrainState, outcome: Outcome) -> dict[str, Any]:
    """The facts of a run, for ``summary.json`` and ``sweep.csv``."""
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
    }


def _estimate_memory(cfg: DictConfig, trainer: Trainer) -> MemoryEstimate | None:
    """Say what the prior will need before it is loaded: better now than by a failure minutes later."""
    size = cfg.camera.get("size")
    estimate = trainer.prior.memory(cfg.prompt, cfg.negative_prompt, trainer.views, size)
    if estimate is not None:
        note(f"The prior will need about {estimate}. Less: vram=low, or fewer views.")
    return estimate


def _memory(estimate: MemoryEstimate | None, device: torch.device) -> dict[str, float]:
    """The estimate beside what CUDA saw at its peak, in GiB; the Gaussians' share is in the latter only."""
    facts = {} if estimate is None else {"memory_estimate_gib": round(estimate.total / 2**30, 3)}
    if device.type == "cuda":
        facts["memory_peak_gib"] = round(torch.cuda.max_memory_allocated(device) / 2**30, 3)
    return facts


def _start_or_resume(cfg: DictConfig, trainer: Trainer, device: torch.device, folder: Path) -> TrainState:
    path = _checkpoint(cfg, folder)
    if path is None:
        return trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, device)
    state = TrainState.restore(load_checkpoint(path), trainer.optimizer, trainer.densifier, device)
    require(
        cfg.seed == state.seed,
        "seed",
        expected=f"{state.seed}, which this run was started with",
        got=cfg.seed,
        example="resume without seed=..., or start another run",
    )
    _say_what_changed(cfg, folder)
    if state.step >= trainer.steps:
        print(f"{path.name} has all {state.step} steps; writing the outputs again.", file=sys.stderr)
    return state


def _checkpoint(cfg: DictConfig, folder: Path) -> Path | None:
    """What to go on from; None: start at the beginning."""
    if cfg.resume is None:
        return None
    asked = Path(cfg.resume)
    path = asked if asked.is_file() else latest_checkpoint(folder / "checkpoints")
    if path is None:
        print(f"No checkpoint in {folder / 'checkpoints'} yet: starting at step 0.", file=sys.stderr)
    return path


def _say_what_changed(cfg: DictConfig, folder: Path) -> None:
    """A resumed run equals an uninterrupted one only under the same settings: name those that differ."""
    file = folder / "config.yaml"
    if not file.is_file():
        return
    before = dict(flatten(OmegaConf.to_container(load(file), resolve=True)))
    now = dict(flatten(OmegaConf.to_container(cfg, resolve=True)))
    for key in sorted(before.keys() | now.keys()):
        if key != "resume" and before.get(key) != now.get(key):
            print(f"Note: {key} was {before.get(key)!r}, is now {now.get(key)!r}", file=sys.stderr)


def _export(exporters: Mapping[str, Exporter], gaussians, render, folder: Path) -> list[str]:
    """Write every export; one that fails is reported and does not take the others with it."""
    warnings = []
    for name, exporter in exporters.items():
        try:
            exporter.export(gaussians, render, folder)
        except (UserError, MemoryError, torch.OutOfMemoryError) as error:
            warnings.append(f"exporter.{name}: {error}")
            log.info("exporter.%s: %s", name, error)
            print(f"Warning: exporter.{name}: {error}", file=sys.stderr)
    return warnings


def _point_latest_at(folder: Path) -> None:
    """Make ``outputs/latest`` a link to ``folder``; a file system without links only loses the shortcut."""
    link = Path("outputs") / "latest"
    try:
        link.parent.mkdir(parents=True, exist_ok=True)
        fresh = link.with_name(f".latest-{folder.name}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(_relative_if_inside(folder, link.parent))
        try:
            fresh.replace(link)
        finally:
            fresh.unlink(missing_ok=True)
    except OSError as error:
        print(f"Note: outputs/latest not updated ({error.strerror}).", file=sys.stderr)


def _relative_if_inside(folder: Path, base: Path) -> Path:
    folder, base = folder.resolve(), base.resolve()
    return folder.relative_to(base) if folder.is_relative_to(base) else folder


def _say(folder: Path, summary: Mapping[str, Any], report: Path) -> None:
    quality = f", PSNR {summary['psnr']:.2f} dB" if summary.get("psnr") is not None else ""
    print(
        f"{summary['outcome']} after {summary['steps']} steps, {summary['seconds']:.0f} s: "
        f"{summary['num_gaussians']} Gaussians{quality}"
    )
    for label, name in (("asset", "asset.ply"), ("video", "turntable.mp4"), ("pictures", "preview.png")):
        if (folder / name).exists():
            print(f"  {label:<9}{shown(folder / name)}")
    print(f"  {'report':<9}{shown(report)}")
    if summary["outcome"] == Outcome.INTERRUPTED:
        print(f"  go on with: cadam3d train resume={shown(folder)}")
