"""``cadam3d train``: optimise an asset for a prompt and write it into a run folder."""

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from cadam3d import __version__
from cadam3d.augmentation import Augmentation
from cadam3d.background import Background
from cadam3d.callback.base import Callback
from cadam3d.camera.base import CameraSampler
from cadam3d.commands.control import Control
from cadam3d.commands.linking import link_latest
from cadam3d.commands.measuring import build_metrics, measure, rebuild_start
from cadam3d.commands.messages import note, note_backend
from cadam3d.commands.timetable import describe
from cadam3d.commands.writing import run_exporters
from cadam3d.core.chart import Chart
from cadam3d.core.checks import require, require_whole
from cadam3d.core.console import say
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.memory import CAMERA, PIXEL, require_memory
from cadam3d.core.schedule import FAR_STEP
from cadam3d.densifier.base import Densifier
from cadam3d.densifier.baseline import Baseline
from cadam3d.densifier.refine import Refine
from cadam3d.exporter.base import Exporter
from cadam3d.exposure import Exposure
from cadam3d.guidance.base import Guidance
from cadam3d.initializer.base import Initializer
from cadam3d.io.atomic import remove_leftovers, replacing
from cadam3d.io.checkpoint import DamagedCheckpointError, latest_checkpoint, load_checkpoint
from cadam3d.io.jsonl import write_json
from cadam3d.io.lock import INHERITED
from cadam3d.io.records import psnr_of, read_metrics
from cadam3d.io.run_folder import (
    ASSET,
    CHECKPOINTS,
    CONFIG,
    PREVIEW,
    SUMMARY,
    TURNTABLE,
    checkpoint_step,
    shown,
)
from cadam3d.metric.base import Measurand
from cadam3d.optimizer import AdamSettings
from cadam3d.prior.base import DiffusionPrior
from cadam3d.prior.prompting import Prompting
from cadam3d.prior.truth import TruthSource
from cadam3d.rasterizer.base import Backend, Rasterizer
from cadam3d.regularizer import Regularizer
from cadam3d.report import write_report
from cadam3d.report.declarations import write_declarations
from cadam3d.settings.compose import component, components, flatten, load_config
from cadam3d.settings.line import NOT_OF_A_RUN
from cadam3d.settings.options import TARGET
from cadam3d.state import Outcome, PayloadError, RunContext, TrainState
from cadam3d.trainer import Trainer

log = logging.getLogger(__name__)

# Signals that arrive within this time of each other count as one.
TOGETHER_SECONDS = 1.0
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "camera", "refine", "optimizer")


def run(cfg: DictConfig) -> float | None:
    """Train in the folder of this job and print the result. Return the PSNR in dB if it was measured."""
    stop = StopOnSignal((signal.SIGINT, signal.SIGTERM))
    folder, summary, report = train(cfg, stop)
    print_result(folder, summary, report)
    # This also applies if all steps were done already, so that a loop in a shell script ends.
    if stop.received is not None:
        sys.exit(128 + stop.received)
    return psnr_of(summary)


def train(
    cfg: DictConfig, stop: "StopOnSignal", callbacks: Sequence[Callback] = ()
) -> tuple[Path, dict[str, Any], Path]:
    """Train, export, measure and report in the folder of this job. Return folder, summary and report.

    ``callbacks`` are called after those of ``cfg``.
    """
    device = resolve_device(cfg.device)
    require_whole("seed", cfg.seed, low=0, example=3)
    with deterministic(device):
        return _train(cfg, device, stop, callbacks)


def _train(
    cfg: DictConfig, device: torch.device, stop: "StopOnSignal", callbacks: Sequence[Callback]
) -> tuple[Path, dict[str, Any], Path]:
    folder = Path(HydraConfig.get().runtime.output_dir)
    require_unused(cfg)

    # Everything that can be refused is refused here, before the folder changes.
    trainer = build_trainer(cfg, device)
    trainer = replace(trainer, callbacks=[*trainer.callbacks, *callbacks])
    backend = trainer.rasterizer.prepare(device)
    exporters: dict[str, Exporter] = components(cfg.exporter, Exporter, "exporter")
    metrics = build_metrics(cfg.metric)
    initializer = component(cfg.initializer, Initializer, "initializer")
    memory = estimate_memory(cfg, trainer)
    source: TruthSource = component(cfg.truth, TruthSource, "truth")
    truth = source.of(cfg.prompt, trainer.prior)
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    state = start_or_resume(cfg, trainer, initializer, device, folder)
    start = keep_start(cfg, state, initializer, device) if source.measures_start else None
    # The prior is loaded last, because an initializer may have needed the memory and has freed it now.
    trainer.prior.load()
    note_beginning((trainer.prior.notice(), embedding.notice(), state.initial_note), backend)
    timetable = describe(trainer)
    say(f"Schedule: {timetable}")

    remove_leftovers(folder)
    config_text = OmegaConf.to_yaml(cfg, resolve=True)
    with replacing(folder / CONFIG) as temporary:
        temporary.write_text(config_text, encoding="utf-8")
    # This is for single runs: a sweep locks the folders of its jobs and passes the locks on.
    if INHERITED not in os.environ:
        link_latest(folder)
    log.info("prompt %r, seed %d, on %s, from step %d", cfg.prompt, cfg.seed, device, state.step)
    log.info("schedule: %s", timetable)
    log.info("rasterizer=%s; %s", backend.name, backend.reason or "nothing faster is known here")

    charts = declare_charts(trainer, folder)
    context = run_context(cfg.prompt, trainer, state, folder)
    with stop, Control(folder, state, stop, partial(trainer.wait, context, state)) as control:
        outcome = trainer.train(state, embedding, context, control)
        log.info("%s after %d steps: %d Gaussians", outcome, state.step, len(state.gaussians))

        summary = summarize(cfg, state, outcome, backend) | memory | measure_memory(device)
        summary["schedule"] = timetable
        # The summary is written before the exports, which may fail.
        write_json(folder / SUMMARY, summary)
        gaussians = state.gaussians.detach()
        outputs, warnings = run_exporters(
            exporters,
            gaussians,
            lambda exporter: exporter.export(gaussians, context.render, folder),
            is_needed=False,
        )
        asset = folder / ASSET if any(output.path == folder / ASSET for output in outputs) else None
        measurand = Measurand(
            gaussians=gaussians, render=context.render, prompt=cfg.prompt, truth=truth, asset=asset
        )
        summary |= measure(metrics, measurand, start, warnings)
        if asset is not None:
            summary["asset_bytes"] = asset.stat().st_size
        # This is the last entry of a complete summary.
        summary["warnings"] = warnings
        write_json(folder / SUMMARY, summary)
        for callback in trainer.callbacks:
            callback.on_result(context, summary)

        report = write_report(
            folder,
            summary=summary,
            metrics=read_metrics(folder),
            config_text=config_text,
            charts=charts,
        )
    return folder, summary, report


def note_beginning(notes: Iterable[str | None], backend: Backend) -> None:
    """Print what the user must know about the prior, the prompt, the start and the rasterizer."""
    for text in filter(None, notes):
        note(text)
    note_backend(backend)


@contextmanager
def deterministic(device: torch.device) -> Iterator[None]:
    """Let torch refuse operations without reproducible results on the CPU, where training needs none.

    This has the effect of ``use_deterministic_algorithms``, which would load torch's compiler first and thus
    take more than a second. The mode of the process is restored afterwards.
    """
    before = torch.get_deterministic_debug_mode()
    torch.set_deterministic_debug_mode("error" if device.type == "cpu" else "default")
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(before)


def require_unused(cfg: DictConfig) -> None:
    """Raise ``UserError`` for wrong values of settings that some priors or densifiers do not read."""
    component(cfg.prompting, Prompting, "prompting")
    key, published = "published_baseline", cfg.published_baseline
    is_node = OmegaConf.is_dict(published) and not OmegaConf.is_missing(cfg, key) and published is not None
    example = f"'{key}.views=sum_norm'"
    require(is_node, key, expected="the keys of a node", got=published, example=example)
    target = f"{Baseline.__module__}.{Baseline.__name__}"
    node = OmegaConf.merge({TARGET: target, "screen_px": None}, published)
    node._set_parent(cfg)
    node._set_key(key)
    component(node, Baseline)


def require_views(cfg: DictConfig) -> None:
    """Raise ``UserError`` if the images of one step cannot fit into memory."""
    # A camera from elsewhere may use this key differently, or may have no such key.
    size = cfg.camera.get("size")
    size = size if isinstance(size, int) and size > 0 else 1
    require_memory("camera.size", size, unit=PIXEL, power=2, example=128)
    require_memory("views", cfg.views, unit=max(CAMERA, PIXEL * float(size) ** 2), example=2)


def build_trainer(
    cfg: DictConfig, device: torch.device, given: Mapping[str, Any] = MappingProxyType({})
) -> Trainer:
    """Build the components that ``cfg`` names, and move the prior to ``device``.

    The objects in ``given``, by the name of their group, replace components of ``cfg``, which are then not
    built.
    """

    def part(name: str, kind: type) -> Any:
        return given[name] if name in given else component(cfg[name], kind, name)

    require_whole("steps", cfg.steps, low=1, high=FAR_STEP, example=600)
    refine: Refine = part("refine", Refine)
    require(
        refine.steps == cfg.steps,
        "refine.steps",
        expected=f"the length of the run, steps={cfg.steps}",
        got=refine.steps,
        example="refine.steps='${steps}'",
    )
    trainer = Trainer(
        steps=cfg.steps,
        views=cfg.views,
        camera=part("camera", CameraSampler),
        background=part("background", Background),
        augmentation=part("augmentation", Augmentation),
        rasterizer=part("rasterizer", Rasterizer),
        prior=part("prior", DiffusionPrior).to(device),
        guidance=part("guidance", Guidance),
        densifier=part("densifier", Densifier),
        refine=refine,
        optimizer=part("optimizer", AdamSettings),
        exposure=part("exposure", Exposure),
        regularizers=components(cfg.regularizer, Regularizer, "regularizer"),
        callbacks=list(components(cfg.callback, Callback, "callback").values()),
    )
    # The camera has checked its size by now, so that too many views are the only possible reason.
    require_views(cfg)
    return trainer


def declare_charts(trainer: Trainer, folder: Path) -> list[Chart]:
    """Return the charts that the components declare, and write them for pages that show the run live."""
    charts = [*trainer.densifier.charts(), *trainer.guidance.charts()]
    write_declarations(folder, charts)
    return charts


def run_context(prompt: str, trainer: Trainer, state: TrainState, folder: Path) -> RunContext:
    """Return what callbacks may use of a run in ``folder``."""
    return RunContext(
        folder=folder,
        prompt=prompt,
        total_steps=trainer.steps,
        render=trainer.renderer(state),
        rasterizer=trainer.rasterizer,
        densifier=trainer.densifier,
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


def start_or_resume(
    cfg: DictConfig, trainer: Trainer, initializer: Initializer, device: torch.device, folder: Path
) -> TrainState:
    """Return the state before the first step, or that of a checkpoint if ``resume=`` names a run with one."""
    if cfg.resume is None:
        return trainer.start(cfg.prompt, initializer, cfg.seed, device)
    named = Path(cfg.resume)
    read = partial(read_state, trainer=trainer, device=device)
    if not named.is_dir():
        path, state = named, read(named)
    elif (found := latest_checkpoint(folder / CHECKPOINTS, read, note_damage)) is not None:
        path, state = found
    else:
        say(f"No checkpoint in {folder / CHECKPOINTS} yet: starting at step 0.")
        return trainer.start(cfg.prompt, initializer, cfg.seed, device)
    require(
        cfg.seed == state.seed,
        "seed",
        expected=f"{state.seed}, with which this run was started",
        got=cfg.seed,
        example=f"seed={state.seed}",
    )
    require(
        state.step <= trainer.steps,
        "steps",
        expected=f"at least {state.step}, which {path.name} has done already",
        got=trainer.steps,
        example=f"steps={state.step}",
    )
    note_changes(cfg, folder)
    if state.step == trainer.steps:
        say(f"{path.name} has all {state.step} steps; writing the outputs again.")
    return state


def keep_start(
    cfg: DictConfig, state: TrainState, initializer: Initializer, device: torch.device
) -> Callable[[], Gaussians]:
    """Return a function that returns the Gaussians at the start of the run, also after training.

    They are copied now, or built again if the run is resumed.
    """
    if state.step > 0:
        return partial(rebuild_start, cfg.prompt, initializer, cfg.seed, device)
    copy = state.gaussians.detach().map(Tensor.clone)
    return lambda: copy


def read_state(path: Path, trainer: Trainer, device: torch.device) -> TrainState:
    """Return the state in a checkpoint. Raises ``DamagedCheckpointError`` unless it is sound throughout."""
    payload = load_checkpoint(path)
    try:
        state = TrainState.restore(payload, trainer.optimizer, trainer.densifier, device)
    except PayloadError as error:
        raise DamagedCheckpointError(path, error) from error
    if checkpoint_step(path) not in (None, state.step):
        raise DamagedCheckpointError(path, f"step: expected that of its name, got {state.step}")
    return state


def note_damage(error: UserError) -> None:
    """Print which checkpoint is left out, and why."""
    say(f"Note: left out {str(error).partition(' Try: ')[0]}", logging.WARNING)


def note_changes(cfg: DictConfig, folder: Path) -> None:
    """Print the settings that have changed, because the run then differs from an uninterrupted one."""
    if not (folder / CONFIG).is_file():
        return
    before = dict(flatten(OmegaConf.to_container(load_config(folder / CONFIG), resolve=True)))
    now = dict(flatten(OmegaConf.to_container(cfg, resolve=True)))
    for key in sorted(before.keys() | now.keys()):
        if key not in NOT_OF_A_RUN and before.get(key) != now.get(key):
            say(f"Note: {key} was {before.get(key)!r}, is now {now.get(key)!r}", logging.WARNING)


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
        **({"truth": choices["truth"]} if choices.get("truth", "prior") != "prior" else {}),
        **({"initializer_note": state.initial_note} if state.initial_note else {}),
        "device": str(state.gaussians.device),
        "cadam3d": __version__,
        "torch": torch.__version__,
        "finished_at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "backend": backend.name,
        **({"backend_reason": backend.reason} if backend.reason else {}),
    }


def print_result(folder: Path, summary: Mapping[str, Any], report: Path) -> None:
    """Print how the run ended, where its files are, and how to continue it if it was interrupted."""
    psnr = psnr_of(summary)
    quality = "" if psnr is None else f", PSNR {psnr:.2f} dB"
    if turn := summary.get("turn_deg"):
        quality += f" at a turn of {turn:.0f} degrees"
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
    """Handles signals: after the first one the loop stops and saves, a later one stops it at once.

    Signals within ``TOGETHER_SECONDS`` count as one, because a scheduler sends its signal to a process and
    also to its parent, which passes it on.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        self.received: int | None = None
        self._numbers = numbers
        self._received_at = 0.0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "StopOnSignal":
        for number in self._numbers:
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
        say("\nStopping as soon as everything is saved; interrupt again to stop at once.", logging.WARNING)
