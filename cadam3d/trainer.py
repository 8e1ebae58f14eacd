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
from cadam3d.core.checks import require_range
from cadam3d.core.device import read_numbers, upload_together
from cadam3d.core.edit import RowState
from cadam3d.core.memory import is_out_of_memory
from cadam3d.core.render import RenderFn, RenderOutput
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.densifier.refine import Refine
from cadam3d.exposure import Exposure
from cadam3d.guidance.base import Guidance
from cadam3d.initializer.base import Initializer
from cadam3d.optimizer import AdamSettings
from cadam3d.prior.base import DiffusionPrior, PromptEmbedding
from cadam3d.rasterizer.base import Rasterizer, render_fn
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


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Result of differentiating the loss of a step, before anything has moved."""

    densifier: RowState  # after it has observed the gradients
    loss: float
    log: dict[str, float]  # of the guidance and the regularizers
    is_finite: bool  # whether no gradient contains NaN or infinity
    dimming: float  # factor for all colour coefficients
    # Whether the rasterizer had reserved too little memory, so that everything else is meaningless.
    overflowed: bool


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
        require_range("steps", self.steps, low=1, example=600)
        require_range("views", self.views, low=1, example=2)
        self.camera.check_views(self.views)

    def step(self, state: TrainState, embedding: PromptEmbedding) -> tuple[StepReport, RefineReport | None]:
        """Advance ``state`` in place by one step, and by a refinement or opacity reset if one is due.

        Callbacks are not called, and ``state.seconds`` does not change.
        """
        draws_before = {name: generator.get_state() for name, generator in state.generators.items()}
        evidence = self._differentiate(state, embedding, self.rasterizer.render_ahead)
        if evidence.overflowed:
            # Nothing has changed except the random numbers and the gradients.
            state.optimizer.zero_grad()
            for name, draws in draws_before.items():
                state.generators[name].set_state(draws)
            evidence = self._differentiate(state, embedding, self.rasterizer.render)

        # A step with a NaN or infinite gradient moves nothing.
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
        log = {**evidence.log, **({"dimmed": float(state.dimmed)} if state.dimmed else {})}
        num_gaussians = len(state.gaussians)

        refined = self._refine(state, state.step + 1)
        state.step += 1
        report = StepReport(step=state.step, loss=evidence.loss, log=log, num_gaussians=num_gaussians)
        return report, refined

    def _differentiate(
        self, state: TrainState, embedding: PromptEmbedding, render: Callable[..., RenderOutput]
    ) -> Evidence:
        """Render some views, differentiate the loss, and let the densifier observe the gradients.

        This changes only the random numbers and the gradients of ``state``. It waits for the device once, at
        its end, because the host is faster if it does not know the numbers before.
        """
        gaussians, draw = state.gaussians, state.generators

        # Render the Gaussians from a few cameras.
        cameras = self.camera.sample(state.step, self.views, draw["camera"])
        background = self.background.sample(self.views, draw["background"])
        cameras, background = _uploaded(cameras, background, gaussians.device)
        rendered = self.augmentation.perturb(gaussians, draw["augmentation"])
        output = render(rendered, cameras, background, self.densifier.needs_absgrad)
        images = self.augmentation.show(output, draw["augmentation"])

        # Compare the images with what the prior expects to see, and add the penalties.
        condition = embedding.at(cameras, background)
        guided = self.guidance(images, condition, self.prior, state.step, draw["guidance"])
        penalties = {name: fn(rendered, output, state.step) for name, fn in self.regularizers.items()}
        loss = sum(penalties.values(), start=guided.loss)

        # Differentiate. A densifier that ignores the penalties reads the gradients before these are added. If
        # a penalty depends on the images, each pass differentiates the rasterizer, and one pass could not do
        # both: the densifier needs the gradients of one loss, and the optimizer those of another.
        if penalties and self.densifier.guidance_only:
            guided.loss.backward(retain_graph=True)
            signal = GradientSignal.read(gaussians, output).copy()
            torch.stack(list(penalties.values())).sum().backward()
        else:
            loss.backward()
            signal = GradientSignal.read(gaussians, output)
        observed = self.densifier.observe(state.densifier, signal)

        # Read every number that the host needs.
        dimming = self.exposure.dimming(output, background, state.step + 1)
        overflowed, dimming, loss, *others = read_numbers(
            [
                False if output.overflowed is None else output.overflowed,
                1.0 if dimming is None else dimming,
                loss,
                *guided.log.values(),
                *penalties.values(),
                *state.optimizer.extreme_gradients(),
            ],
            gaussians.device,
        )
        names = (*guided.log, *penalties)
        return Evidence(
            densifier=observed,
            loss=loss,
            log=dict(zip(names, others[: len(names)], strict=True)),
            is_finite=all(map(math.isfinite, others[len(names) :])),
            dimming=dimming,
            overflowed=bool(overflowed),
        )

    def _refine(self, state: TrainState, step: int) -> RefineReport | None:
        """Grow, prune and reset opacities if the schedule says so after step number ``step`` (from 1).

        With ``refine.last_max_scale``, a last step that does not refine still prunes.

        A refinement is decided first and then applied to all three owners of rows: Gaussians, optimizer
        moments and densifier state. One that would exceed ``max_gaussians`` changes nothing except
        ``state.refused``.
        """
        refines, resets = self.refine.refines_at(step), self.refine.resets_at(step)
        prunes = self.refine.prunes_at(step)
        state.refused = False
        if not (refines or resets or prunes):
            return None
        before, seen = state.gaussians.detach(), state.densifier
        statistics, scores = self.densifier.statistics(seen, step), self.densifier.scores(seen)
        is_selected = torch.zeros(len(before), dtype=torch.bool, device=before.device)
        cloned = split = pruned = reset = 0
        edit = None

        if refines or prunes:
            generator = state.generators["refine"]
            draws_before = generator.get_state()
            if refines:
                plan = self.densifier.plan(state.densifier, state.gaussians, step, self.refine, generator)
            else:
                plan = self.refine.plan(state.gaussians, is_selected, step, generator)
            is_selected = plan.is_selected
            state.refused = self.refine.exceeds(plan)
            if state.refused:
                generator.set_state(draws_before)
            else:
                # The state changes last: if memory runs out before, all owners still have the old rows.
                carried = self.densifier.carry(state.densifier, plan.edit)
                state.optimizer.apply(plan.edit)
                state.densifier = carried
                edit = plan.edit
                cloned, split, pruned = plan.cloned, plan.split, plan.pruned

        if resets and not state.refused:
            unreliable = self.densifier.unreliable(state.densifier)
            reset = state.optimizer.reset_opacity(unreliable, self.refine.reset_value)
            state.densifier = self.densifier.after_reset(state.densifier, unreliable)

        return RefineReport(
            step=step,
            before=len(before),
            after=len(state.gaussians),
            selected=int(is_selected.sum()),
            cloned=cloned,
            split=split,
            pruned=pruned,
            reset=reset,
            statistics=statistics,
            population=Population(gaussians=before, is_selected=is_selected, scores=scores),
            edit=edit,
        )

    def start(self, prompt: str, initializer: Initializer, seed: int, device: torch.device) -> TrainState:
        """Return the state before the first step; every later random draw descends from ``seed``."""
        generators = start_generators(seed)
        beginning = initializer.begin(prompt, generators["initializer"], device)
        gaussians = beginning.gaussians
        return TrainState(
            step=0,
            seconds=0.0,
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
        ``state.seconds``. Running out of memory is an outcome. Any other exception is raised again after
        ``on_abort`` of the callbacks.
        """
        for callback in self.callbacks:
            callback.on_start(context, state)
        try:
            outcome = self._loop(state, embedding, context, stop)
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

    def _loop(
        self, state: TrainState, embedding: PromptEmbedding, context: RunContext, stop: Callable[[], bool]
    ) -> Outcome:
        # A resumed run first repeats the refinement that ended it, because max_gaussians may be larger now.
        if state.refused:
            self._report(context, state, self._refine(state, state.step), None)
        outcome = self.outcome(state)
        while outcome is None:
            started = time.perf_counter()
            report, refined = self.step(state, embedding)
            state.seconds += time.perf_counter() - started
            self._report(context, state, refined, report)
            outcome = self.outcome(state)
            if outcome is None and stop():
                outcome = Outcome.INTERRUPTED
        return outcome

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
    if device.type == "cpu":
        return cameras, background
    columns = (
        cameras.world_to_camera,
        cameras.intrinsics,
        background,
        cameras.azimuth_deg,
        cameras.elevation_deg,
    )
    matrices, intrinsics, colors, azimuth_deg, elevation_deg = upload_together(columns, device)
    there = replace(
        cameras,
        world_to_camera=matrices,
        intrinsics=intrinsics,
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        drawn=cameras,
    )
    return there, colors
