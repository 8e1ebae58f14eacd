"""Resuming: the state from which a run starts, which is new or comes from a checkpoint."""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from cadam3d.commands.measuring import rebuild_start
from cadam3d.core.checks import require
from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.base import Initializer
from cadam3d.io.checkpoint import DamagedCheckpointError, latest_checkpoint, load_checkpoint
from cadam3d.io.records import read_config
from cadam3d.io.run_folder import CHECKPOINTS, CONFIG, checkpoint_step
from cadam3d.settings.compose import flatten
from cadam3d.settings.line import NOT_OF_A_RUN
from cadam3d.state import PayloadError, TrainState
from cadam3d.trainer import Trainer


def start_or_resume(
    cfg: DictConfig, trainer: Trainer, initializer: Initializer, device: torch.device, folder: Path
) -> TrainState:
    """Return the state before the first step, or a checkpoint's state if ``resume=`` names a run with one."""
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
    require(cfg.seed == state.seed, "seed", expected=f"{state.seed} as in {path.name}", got=cfg.seed)
    steps = f"at least {state.step}, which {path.name} has done"
    require(state.step <= trainer.steps, "steps", expected=steps, got=trainer.steps)
    note_changes(cfg, folder)
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
        raise DamagedCheckpointError(path, f"step: expected the step in its name, got {state.step}")
    return state


def note_damage(error: UserError) -> None:
    """Print which checkpoint is left out, and why."""
    say(f"Note: left out {str(error).partition(' Try: ')[0]}", logging.WARNING)


def note_changes(cfg: DictConfig, folder: Path) -> None:
    """Print the settings that have changed, because the run then differs from an uninterrupted one."""
    if not (folder / CONFIG).is_file():
        return
    before = dict(flatten(read_config(folder / CONFIG)))
    now = dict(flatten(OmegaConf.to_container(cfg, resolve=True)))
    for key in sorted(before.keys() | now.keys()):
        if key not in NOT_OF_A_RUN and before.get(key) != now.get(key):
            say(f"Note: {key} was {before.get(key)!r}, is now {now.get(key)!r}", logging.WARNING)
