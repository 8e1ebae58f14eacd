"""``cadam3d train``: optimise an asset for a prompt and write it into a run folder."""

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from omegaconf import DictConfig

from cadam3d.build import build_trainer, chosen
from cadam3d.callback.base import Callback
from cadam3d.commands.beginning import (
    begun,
    describe_schedule,
    deterministic,
    load_prior,
    note_memory,
    run_context,
)
from cadam3d.commands.control import Control
from cadam3d.commands.finishing import Results, measure_memory, print_result, summarize
from cadam3d.commands.resuming import keep_start, start_or_resume
from cadam3d.core.console import say
from cadam3d.core.device import resolve_device
from cadam3d.core.origin import origin_on
from cadam3d.core.signals import ENDING, StopOnSignal
from cadam3d.initializer.base import Initializer
from cadam3d.io.declarations import write_declarations
from cadam3d.io.occupied import occupied
from cadam3d.report import write_report
from cadam3d.settings.compose import Call

log = logging.getLogger(__name__)


def run(cfg: DictConfig, call: Call) -> int:
    """Train and print the result. Return the exit code, which is 128 plus its number after a signal."""
    stop = StopOnSignal(ENDING)
    folder, summary = optimise(cfg, call, stop)
    print_result(folder, summary)
    # This also applies if all steps were done already, so that a loop in a shell script ends.
    return 0 if stop.received is None else 128 + stop.received


def optimise(
    cfg: DictConfig,
    call: Call,
    stop: StopOnSignal,
    callbacks: Sequence[Callback] = (),
    given: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Path, dict[str, Any]]:
    """Train, export, measure and report. Return the folder of the run and the content of its summary.

    ``callbacks`` are called after ``cfg``'s own, and the objects in ``given`` replace its components, by
    the names of their groups. Raises ``UserError`` for wrong settings, before the folder changes.
    """
    device = resolve_device(cfg.device)
    origin = origin_on(device)  # now, because the checkout may change while the run lasts
    resume = Path(str(cfg.resume)) if cfg.resume else None
    with (
        occupied(call.folder, is_chosen=call.has_chosen_folder, resume=resume) as folder,
        deterministic(device),
    ):
        trainer = build_trainer(cfg, device, given, callbacks)
        backend = trainer.rasterizer.prepare(device)
        initializer: Initializer = chosen(cfg, given, "initializer", Initializer)
        results = Results.of(cfg, trainer.prior)
        memory = note_memory(cfg, trainer)
        embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
        state = start_or_resume(cfg, trainer, initializer, device, folder)
        start = keep_start(cfg, state, initializer, device) if results.measures_start else None
        load_prior(trainer, state, backend)
        schedule = describe_schedule(trainer)
        say(f"Schedule: {schedule}")

        with begun(cfg, call, folder):
            log.info("prompt %r, seed %d, on %s, from step %d", cfg.prompt, cfg.seed, device, state.step)
            log.info("schedule: %s", schedule)
            log.info("rasterizer=%s; %s", backend.name, backend.reason or "nothing faster is known here")
            write_declarations(folder, [*trainer.densifier.charts(), *trainer.guidance.charts()])
            context = run_context(cfg.prompt, trainer, state, folder)
            with stop, Control(folder, state, stop, partial(trainer.wait, context, state)) as control:
                outcome = trainer.train(state, embedding, context, control)
                log.info("%s after %d steps: %d Gaussians", outcome, state.step, len(state.gaussians))
                summary = summarize(cfg, call.choices, state, outcome, backend)
                summary |= origin | memory | measure_memory(device) | {"schedule": schedule}
                summary["grows"] = trainer.densifier.grows_from is not None
                results.write(context, state.gaussians.detach(), start, summary)
                for callback in trainer.callbacks:
                    callback.on_result(context, summary)
                write_report(folder)
    return folder, summary
