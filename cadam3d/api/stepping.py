"""Stepping from Python: a trainer that makes one step per call, with objects in place of components."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Unpack, cast

import torch
from omegaconf import OmegaConf
from torch import Tensor

from cadam3d.api.asset import Asset
from cadam3d.api.components import Components, given_objects
from cadam3d.api.guest import as_guest, logging_messages, usual_modes
from cadam3d.build import build_trainer, chosen
from cadam3d.commands.beginning import deterministic, load_prior
from cadam3d.core.checks import require_whole
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.outcome import Outcome
from cadam3d.initializer.base import Initializer
from cadam3d.launch import completing, prepare
from cadam3d.prior.base import PromptEmbedding
from cadam3d.settings.line import key_of
from cadam3d.state import RefineReport, StepReport, TrainState
from cadam3d.trainer import Trainer


@dataclass(frozen=True)
class Step(StepReport):
    """Result of one step, with the refinement that followed it, if any.

    ``num_gaussians`` is the number that was rendered, before that refinement.
    """

    # What the refinement or opacity reset after this step has changed; None if none was due.
    refinement: RefineReport | None


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Stepper:
    """A run that the caller steps by hand. It does not change; the state that :meth:`start` returns does.

    Nothing is written, and the callbacks, exporters and metrics of the settings are not used. The bytes of
    the last Gaussians equal :func:`cadam3d.train`'s with the same settings.
    """

    prompt: str
    negative_prompt: str
    seed: int
    device: torch.device
    config: dict[str, Any]  # all settings, resolved
    initializer: Initializer  # makes the Gaussians of the start
    parts: Trainer  # the other components: parts.densifier, parts.guidance, parts.prior and so on

    @property
    def steps(self) -> int:
        """Return the number of steps of the whole run."""
        return self.parts.steps

    def start(self, seed: int | None = None) -> TrainState:
        """Return the state before the first step; ``seed`` replaces the settings' seed.

        The prior is loaded and the rasterizer compiled, if they need that.
        """
        seed = self.seed if seed is None else seed
        require_whole("seed", seed, low=0)
        with logging_messages(), usual_modes(), deterministic(self.device):
            backend = self.parts.rasterizer.prepare(self.device)
            state = self.parts.start(self.prompt, self.initializer, seed, self.device)
            load_prior(self.parts, state, backend)
        return state

    def step(self, state: TrainState) -> Step:
        """Advance ``state`` in place by one step, with its refinement or opacity reset if one is due.

        This also works after the end of the run, which only :meth:`outcome` and :meth:`run` know.
        """
        started = time.perf_counter()
        with usual_modes(), deterministic(self.device):
            report, refinement = self.parts.step(state, self._embedding)
        state.seconds += time.perf_counter() - started
        return Step(**vars(report), refinement=refinement)

    def run(self, state: TrainState) -> Iterator[Step]:
        """Advance ``state`` in place until the run ends, and yield every step after it is done."""
        while self.outcome(state) is None:
            yield self.step(state)

    def outcome(self, state: TrainState) -> Outcome | None:
        """Return how the run has ended, such as ``"finished"``, or ``None`` if more steps are to be done."""
        return self.parts.outcome(state)

    @usual_modes()
    def asset(self, state: TrainState) -> Asset:
        """Return a copy of the present Gaussians as an asset, to render, show and export."""
        return Asset(
            state.gaussians.detach().map(Tensor.clone), title=self.prompt, rasterizer=self.parts.rasterizer
        )

    @cached_property
    def _embedding(self) -> PromptEmbedding:
        return self.parts.prior.embed(self.prompt, self.negative_prompt)


def compose(*overrides: str, **components: Unpack[Components]) -> Stepper:
    """Return a trainer with the settings of ``cadam3d train OVERRIDES``, to be stepped by hand.

    ``overrides`` are the words of the command line, without quotes for a shell; one of them must be the
    prompt, such as ``"prompt=a red cube"``. Every other argument is an object that replaces the component of
    this name, such as ``densifier=``. Its settings must then not be among the overrides.

    Raises ``UserError`` for mistakes, as :func:`cadam3d.train` does.
    """
    with as_guest(), completing():
        given = given_objects(components, overrides)
        if any(key_of(word) == "resume" for word in overrides):
            raise UserError(
                'resume: only a whole run continues another. Try: cadam3d.train(None, "resume=RUN")'
            )
        cfg, _ = prepare("train", overrides)
        device = resolve_device(cfg.device)
        trainer = build_trainer(cfg, device, given)
        return Stepper(
            prompt=cfg.prompt,
            negative_prompt=cfg.negative_prompt,
            seed=cfg.seed,
            device=device,
            config=cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True)),
            initializer=chosen(cfg, given, "initializer", Initializer),
            parts=trainer,
        )
