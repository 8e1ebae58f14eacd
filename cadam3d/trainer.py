"""Trainer: one training step from top to bottom, the refinement that may end it, and the loop around both.

It sees interfaces only, never a concrete component. ``docs/architecture.md`` has the same step as a picture.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cadam3d.augmentation import Augmentation
from cadam3d.background import Background
from cadam3d.callback.base import Callback
from cadam3d.camera.base import CameraSampler
from cadam3d.core.cameras import Cameras
from cadam3d.core.contribution import contributions, ghosts
from cadam3d.core.device import upload_together
from cadam3d.core.edit import RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.memory import is_out_of_memory
from cadam3d.core.rendering import RenderFn, RenderOutput
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.densifier.refine import Refine, RefinePlan
from cadam3d.exposure import Exposure
from cadam3d.guidance.base import Guidance
from cadam3d.initializer.base import Initializer
from cadam3d.optimizer import AdamSettings
from cadam3d.prior.base import DiffusionPrior, PromptEmbedding
from cadam3d.rasterizer.base import Rasterizer, Render, render_fn
from cadam3d.regularizer import Regularizer
from cadam3d.state import (
    Outcome,
    Population,
    RefineReport,
    RunContext,
    StepReport,
    TrainState,
    start_generators,
)


@dataclass(frozen=True)
class Shot:
    """The images of a step, and how they were taken."""

    cameras: Cameras
    background: Tensor  # one RGB colour per view
    gaussians: Gaussians  # after augmentation
    output: RenderOutput


@dataclass(frozen=True)
class Losses:
    """The loss of a step: what the prior wants, and the penalties of the regularizers."""

    total: Tensor  # one number
    log: Mapping[str, Tensor | float]  # of the guidance and the regularizers


@dataclass(frozen=True)
class Evidence:
    """The findings of a step before anything moves."""

    densifier: RowState  # after it has observed the gradients
    loss: float
    log: dict[str, float]  # of the guidance and the regularizers
    is_finite: bool  # whether no gradient contains NaN or infinity
    dimming: float  # factor for all colour coefficients


@dataclass(frozen=True, kw_only=True)
class Trainer:
    """Everything about a run that does not change while it runs."""

    steps: int  # >= 1
    views: int  # >= 1: per step
    camera: CameraSampler
    background: Background
    augmentation: Augmentation
    rasterizer: Rasterizer
    prior: DiffusionPrior
    guidance: Guidance
    densifier: Densifier
    refine: Refine
    optimizer: AdamSettings
    exposure: Exposure
    regularizers: Mapping[str, Regularizer]
    callbacks: Sequence[Callback]

    def __post_init__(self) -> None:
        self.camera.check_views(self.views)

    def step(self, state: TrainState, embedding: PromptEmbedding) -> tuple[StepReport, RefineReport | None]:
        """Advance ``state`` in place by one step, and by a refinement or opacity reset if one is due.

        Callbacks are not called, and the times of ``state`` do not change.
        """

        def look(render: Render) -> Evidence:
            shot = self._render(state, render)
            losses = self._guide(state, shot, embedding)
            signal = self._backward(state, shot, losses)
            return self._observe(state, shot, losses, signal)

        # Looking changes only the random numbers and the gradients of ``state``, so it can be repeated.
        evidence = self.rasterizer.ahead(look, state.generators.values())
        self._move(state, evidence)
        count = len(state.gaussians)
        refined = self._refine(state, state.step + 1)
        state.step += 1
        log = evidence.log | ({"dimmed": float(state.dimmed)} if state.dimmed else {})
        return StepReport(step=state.step, loss=evidence.loss, log=log, num_gaussians=count), refined

    def _render(self, state: TrainState, render: Render) -> Shot:
        """Render the Gaussians from a few cameras."""
        draw = state.generators
        cameras = self.camera.sample(state.step, self.views, draw["camera"])
        background = self.background.sample(self.views, draw["background"])
        cameras, background = _uploaded(cameras, background, state.gaussians.device)
        gaussians = self.augmentation.perturb(state.gaussians, draw["augmentation"])
        output = render(gaussians, cameras, background, self.densifier.needs_absgrad)
        return Shot(cameras, background, gaussians, output)

    def _guide(self, state: TrainState, shot: Shot, embedding: PromptEmbedding) -> Losses:
        """Compare the images with what the prior expects to see, and add the penalties."""
        draw = state.generators
        images = self.augmentation.show(shot.output, draw["augmentation"])
        condition = embedding.at(shot.cameras, shot.background)
        guided = self.guidance(images, condition, self.prior, state.step, draw["guidance"])
        penalties = {
            name: penalty(shot.gaussians, shot.output, state.step)
            for name, penalty in self.regularizers.items()
        }
        return Losses(sum(penalties.values(), start=guided.loss), {**guided.log, **penalties})

    def _backward(self, state: TrainState, shot: Shot, losses: Losses) -> GradientSignal:
        """Differentiate the loss, and return the gradients for the densifier."""
        state.optimizer.zero_grad()
        losses.total.backward()
        return GradientSignal.read(state.gaussians, shot.output)

    def _observe(self, state: TrainState, shot: Shot, losses: Losses, signal: GradientSignal) -> Evidence:
        """Let the densifier observe the gradients, and read every number that the host needs.

        This waits for the device once, because the host is faster if it does not know the numbers before.
        """
        observed = self.densifier.observe(state.densifier, signal)
        dimming = self.exposure.dimming(shot.output, shot.background, state.step + 1)
        dimming, loss, *others = shot.output.read(
            [
                1.0 if dimming is None else dimming,
                losses.total.detach(),
                *losses.log.values(),
                *state.optimizer.extreme_gradients(),
            ]
        )
        log = dict(zip(losses.log, others, strict=False))
        is_finite = all(map(math.isfinite, others[len(log) :]))
        return Evidence(observed, loss, log, is_finite, dimming)

    def _move(self, state: TrainState, evidence: Evidence) -> None:
        """Move the Gaussians; a step with a NaN or infinite gradient moves none."""
        state.densifier = evidence.densifier
        if evidence.is_finite:
            state.optimizer.step(state.step)
            lr = self.optimizer.learning_rates(state.step)["means"]
            offsets = self.densifier.perturb(state.gaussians.detach(), lr, state.generators["densifier"])
            if offsets is not None:
                state.optimizer.displace(offsets)
        else:
            state.optimizer.zero_grad()
            state.skipped += 1
        if evidence.dimming != 1:
            state.optimizer.scale_colors(evidence.dimming)
            state.dimmed += 1

    def _refine(self, state: TrainState, step: int) -> RefineReport | None:
        """Grow, prune and reset opacities if the schedule says so after step number ``step`` (from 1).

        A last step that does not refine may still prune (``Refine.prunes_at``). A refinement is decided
        first and then applied to all three owners of rows: Gaussians, optimizer moments and densifier state.
        One that would exceed ``max_gaussians`` changes nothing except ``state.refused``.
        """
        refines, resets = self.refine.refines_at(step), self.refine.resets_at(step)
        prunes = self.refine.prunes_at(step)
        state.refused = False
        if not (refines or resets or prunes):
            return None
        before, seen = state.gaussians.detach(), state.densifier
        statistics, scores = self.densifier.statistics(seen, step), self.densifier.scores(seen)
        plan = RefinePlan(is_selected=torch.zeros(len(before), dtype=torch.bool, device=before.device))

        generator = state.generators["refine"]
        draws_before = generator.get_state()
        if refines:
            plan = self.densifier.plan(seen, state.gaussians, step, self.refine, generator)
            plan = plan.without(self._idle(before))
        elif prunes:
            plan = self.refine.plan(before, plan.is_selected, step, generator, self._ghosts(before))
        state.refused = self.refine.exceeds(plan)
        if state.refused:
            generator.set_state(draws_before)
            plan = RefinePlan(is_selected=plan.is_selected)
        if plan.edit is not None:
            # The state changes last: if memory runs out before, all owners still have the old rows.
            carried = seen.carry(plan.edit)
            state.optimizer.apply(plan.edit)
            state.densifier = carried

        reset = 0
        if resets and not state.refused:
            unreliable = self.densifier.unreliable(state.densifier)
            reset = state.optimizer.reset_opacity(unreliable, self.refine.reset_value)

        return RefineReport(
            step=step,
            before=len(before),
            after=len(state.gaussians),
            selected=plan.selected,
            cloned=plan.cloned,
            split=plan.split,
            pruned=plan.pruned,
            reset=reset,
            statistics=statistics,
            population=Population(gaussians=before, is_selected=plan.is_selected, scores=scores),
            edit=plan.edit,
        )

    def _idle(self, gaussians: Gaussians) -> Tensor | None:
        """Return the mask of Gaussians that a refinement prunes because they show too little, or None."""
        if self.refine.min_contribution is None:
            return None
        shown = contributions(gaussians, self.rasterizer.render)
        return shown < self.refine.min_contribution * shown.median()

    def _ghosts(self, gaussians: Gaussians) -> Tensor | None:
        """Return the mask of Gaussians that the last pruning removes as ghosts, or None if it keeps them."""
        if not self.refine.prunes_ghosts:
            return None
        assert self.refine.last_min_alpha is not None
        return ghosts(gaussians, self.rasterizer.render, self.refine.last_min_alpha)

    def start(self, prompt: str, initializer: Initializer, seed: int, device: torch.device) -> TrainState:
        """Return the state before the first step; every later random draw descends from ``seed``."""
        generators = start_generators(seed)
        beginning = initializer.begin(prompt, generators["initializer"], device)
        gaussians = beginning.gaussians
        return TrainState(
            step=0,
            seconds=0.0,
            cpu_seconds=0.0,
            num_initial=len(gaussians),
            initial_note=beginning.note,
            skipped=0,
            dimmed=0,
            refused=False,
            seed=seed,
            optimizer=self.optimizer.start(gaussians),
            densifier=self.densifier.init_state(len(gaussians), device),
            generators=generators,
        )

    def train(
        self,
        state: TrainState,
        embedding: PromptEmbedding,
        context: RunContext,
        stop: Callable[[], bool] = lambda: False,
    ) -> Outcome:
        """Advance ``state`` in place until ``steps`` are done or another outcome ends the run.

        ``stop()`` is called after every step and interrupts the run if it returns True. While the run is
        paused it does not return, and calls :meth:`wait` instead; this time is not part of
        ``state.seconds`` and ``state.cpu_seconds``. Running out of memory is an outcome. Any other exception
        is raised again after ``on_abort`` of the callbacks.
        """
        for callback in self.callbacks:
            callback.on_start(context, state)
        try:
            # A resumed run first repeats the refinement that ended it, because max_gaussians may be larger.
            if state.refused:
                self._report(context, state, self._refine(state, state.step), None)
            outcome = self.outcome(state)
            while outcome is None:
                started, cpu_started = time.perf_counter(), time.process_time()
                report, refined = self.step(state, embedding)
                state.seconds += time.perf_counter() - started
                state.cpu_seconds += time.process_time() - cpu_started
                self._report(context, state, refined, report)
                outcome = self.outcome(state)
                if outcome is None and stop():
                    outcome = Outcome.INTERRUPTED
        except BaseException as error:
            if not is_out_of_memory(error):
                for callback in self.callbacks:
                    callback.on_abort(context)
                raise
            outcome = Outcome.OUT_OF_MEMORY
        for callback in self.callbacks:
            callback.on_end(context, state, outcome)
        return outcome

    def wait(self, context: RunContext, state: TrainState) -> None:
        """Call the callbacks between two steps of a run that is paused."""
        for callback in self.callbacks:
            callback.on_pause(context, state)

    def outcome(self, state: TrainState) -> Outcome | None:
        """Return how the run has ended, or ``None`` if it goes on."""
        if state.refused:
            return Outcome.MAX_GAUSSIANS
        if len(state.gaussians) == 0:
            return Outcome.VANISHED
        return Outcome.FINISHED if state.step >= self.steps else None

    def _report(
        self,
        context: RunContext,
        state: TrainState,
        refined: RefineReport | None,
        report: StepReport | None,
    ) -> None:
        """Pass what was done to the callbacks, which must not change anything."""
        for callback in self.callbacks:
            if refined is not None:
                callback.on_refine(context, state, refined)
            if report is not None:
                callback.on_step(context, state, report)

    def renderer(self, state: TrainState) -> RenderFn:
        """Return a function that renders the current Gaussians of ``state``, without gradient."""
        return render_fn(self.rasterizer, lambda: state.gaussians)


def _uploaded(cameras: Cameras, background: Tensor, device: torch.device) -> tuple[Cameras, Tensor]:
    """Return cameras and background colours on ``device``, sent there in one copy."""
    tensors = cameras.tensors()
    *there, background = upload_together([*tensors.values(), background], device)
    return replace(cameras, **dict(zip(tensors, there, strict=True)), drawn=cameras), background
