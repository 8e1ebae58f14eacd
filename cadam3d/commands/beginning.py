"""Beginning: what training prints and writes before its first step."""

import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from cadam3d.commands.messages import note, note_backend
from cadam3d.core.console import visible
from cadam3d.io.atomic import remove_leftovers, replacing
from cadam3d.io.links import link
from cadam3d.io.lock import INHERITED
from cadam3d.io.run_folder import CONFIG, HYDRA_CONFIG, HYDRA_SETTINGS, LATEST, LOG, OVERRIDES
from cadam3d.rasterizer.base import Backend
from cadam3d.settings.compose import Call
from cadam3d.state import RunContext, TrainState
from cadam3d.trainer import Trainer

log = logging.getLogger("cadam3d")
# The messages that the command line prints. They are not part of train.log.
messages = logging.getLogger("cadam3d.messages")
LOG_LINE = "[%(asctime)s][%(name)s][%(levelname)s] - %(message)s"


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


def load_prior(trainer: Trainer, state: TrainState, backend: Backend) -> None:
    """Load the prior, and print what the user must know about it, the start and the rasterizer.

    The prior is loaded last, because an initializer may have needed the memory and has freed it now.
    """
    trainer.prior.load()
    for text in filter(None, (trainer.prior.notice(), state.initial_note)):
        note(text)
    note_backend(backend)


def note_memory(cfg: DictConfig, trainer: Trainer) -> dict[str, float]:
    """Return the memory that the prior will need, in GiB, and print it before the work begins."""
    size = cfg.camera.get("size")
    estimate = trainer.prior.memory(cfg.prompt, cfg.negative_prompt, trainer.views, size)
    if estimate is None:
        return {}
    note(f"The prior will need about {estimate}. To reduce this, set vram=low or fewer views.")
    return {"memory_estimate_gib": round(estimate.total / 2**30, 3)}


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


def describe_schedule(trainer: Trainer) -> str:
    """Return the refinements and opacity resets of a run in one line, and whether anything will grow."""
    refine, densifier = trainer.refine, trainer.densifier
    resets = refine.resets if densifier.resets else range(0)
    parts = [_counted("refinement", refine.refinements), _counted("opacity reset", resets)]
    parts += ["a last pruning"] if refine.prunes_at(refine.steps) else []
    text = f"{', '.join(parts)}."
    first = densifier.grows_from
    if first is not None and not any(step >= first for step in refine.refinements[-1:]):
        text += f" Nothing will grow before step {first}. Try: refine.start=0 refine.end={refine.steps}"
    return text


def _counted(noun: str, steps: range) -> str:
    """Return a number of events and their steps, such as "2 resets (steps 300 to 450, every 150)"."""
    if len(steps) < 2:
        return f"1 {noun} (step {steps[0]})" if steps else f"no {noun}"
    return f"{len(steps)} {noun}s (steps {steps[0]} to {steps[-1]}, every {steps.step})"


@contextmanager
def begun(cfg: DictConfig, call: Call, folder: Path) -> Iterator[None]:
    """Write the settings into the folder of a run, and its log while the block runs.

    All files appear together, or none of them does. Raises ``UserError`` if one cannot be written.
    """
    remove_leftovers(folder)
    texts = {
        HYDRA_CONFIG: OmegaConf.to_yaml(cfg),
        HYDRA_SETTINGS: OmegaConf.to_yaml({"hydra": call.hydra}),
        OVERRIDES: OmegaConf.to_yaml(call.hydra.overrides.task),
        CONFIG: OmegaConf.to_yaml(cfg, resolve=True),
    }
    with logged_to(folder / LOG):
        with ExitStack() as files:
            for name, text in texts.items():
                temporary = files.enter_context(replacing(folder / name))
                temporary.write_text(text, encoding="utf-8")
        # This is for single runs: a sweep locks the folders of its jobs and passes the locks on.
        if INHERITED not in os.environ:
            link(Path(LATEST), folder)
        yield


@contextmanager
def logged_to(path: Path) -> Iterator[None]:
    """Write what cadam3d logs into ``path``, from the level INFO on, while the block runs.

    The handlers of the root logger get no record that they would not get otherwise.
    """
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(_Visible(LOG_LINE))
    file.addFilter(lambda record: record.name != messages.name)
    onward = _Onward(log.getEffectiveLevel())
    level, is_propagating = log.level, log.propagate
    for handler in (file, *([onward] if is_propagating else [])):
        log.addHandler(handler)
    log.setLevel(min(logging.INFO, onward.level))
    log.propagate = False
    try:
        yield
    finally:
        log.setLevel(level)
        log.propagate = is_propagating
        log.removeHandler(onward)
        log.removeHandler(file)
        file.close()


class _Visible(logging.Formatter):
    """Formats records so that no text from a file can steer the terminal that shows the log."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of one record."""
        return visible(super().format(record))


class _Onward(logging.Handler):
    """Passes records on to the handlers of the root, as propagation does, but no records of lower levels."""

    def emit(self, record: logging.LogRecord) -> None:
        """Pass one record on."""
        logging.getLogger().callHandlers(record)
