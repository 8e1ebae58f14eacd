"""The loop: sample views, render, ask the prior, step, and at times refine. It sees interfaces only."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from cadam3d.augmentation import Augmentation
from cadam3d.background import Background
from cadam3d.callback.base import Callback
from cadam3d.camera.base import CameraSampler
from cadam3d.core.checks import require, require_range
from cadam3d.core.gaussians import Gaussians
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


def never() -> bool:
    """The stop signal of a run that nobody interrupts."""
    return False


@dataclass(frozen=True, kw_only=True)
class Trainer:
    """Everything about a run that does not change while it runs."""

    steps: int
    views: int  # per step
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

    def start(self, prompt: str, initializer: Initializer, seed: int, device: torch.device) -> TrainState:
        """The state before the first step; every later draw descends from ``seed``."""
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

    def restore(self, payload: Mapping[str, Any], device: torch.device) -> TrainState:
        """The state that ``TrainState.to_payload`` described, on ``device``.

        Raises ``UserError`` if the checkpoint belongs to another kind of densifier.
        """
        gaussians = Gaussians(**payload["gaussians"]).to(device)
        optimizer = self.optimizer.start(gaussians)
        optimizer.load_state_dict(payload["optimizer"])
        blank = self.densifier.init_state(len(gaussians), device)
        expected = {field.name for field in fields(blank)}
        require(
            expected == set(payload["densifier"]),
            "densifier",
            expected=f"the one of the checkpoint (state: {sorted(payload['densifier'])})",
            got=sorted(expected),
            example="resume without densifier=...",
        )
        require(
            all(len(rows) == len(gaussians) for rows in payload["densifier"].values()),
            "resume",
            expected="a checkpoint whose densifier state has one row per Gaussian",
            got=f"{len(gaussians)} Gaussians and another number of rows",
            example="resume=RUN/checkpoints/<an earlier one>",
        )
        generators = start_generators(payload["seed"])
        for name, generator in generators.items():
            if name in payload["generators"]:  # a checkpoint from before the name was: nothing was drawn yet
                generator.set_state(payload["generators"][name])
        return TrainState(
            step=payload["step"],
            seconds=payload["seconds"],
            num_initial=payload["num_initial"],
            initial_note=payload.get("initial_note"),  # older checkpoints have none
            skipped=payload["skipped"],
            dimmed=payload.get("dimmed", 0),  # a checkpoint from before there was a guard
            refused=payload["refused"],
            seed=payload["seed"],
            optimizer=optimizer,
            densifier=type(blank)(**{k: v.to(device) for k, v in payload["densifier"].items()}),
            generators=generators,
        )

    def renderer(self, state: TrainState) -> RenderFn:
        """Renders the Gaussians as they stand, without gradient."""
        return render_fn(self.rasterizer, lambda: state.gaussians)

    def train(
        self,
        state: TrainState,
        embedding: PromptEmbedding,
        context: RunContext,
        stop: Callable[[], bool] = never,
    ) -> Outcome:
        """Advance ``state`` (in place) to ``steps`` or to another outcome; every step asks ``stop()``."""
        for callback in self.callbacks:
            callback.on_start(context, state)
        try:
            outcome = self._loop(state, embedding, context, stop)
        except BaseException:
            for callback in self.callbacks:
                callback.on_abort(context)
            raise
        for callback in self.callbacks:
            callback.on_end(context, state, outcome)
        return outcome

    def _loop(
        self, state: TrainState, embedding: PromptEmbedding, context: RunContext, stop: Callable[[], bool]
    ) -> Outcome:
        outcome = self._take_up(state, context)
        while outcome is None and state.step < self.steps:
            try:
                outcome = self._advance(state, embedding, context)
            except (torch.OutOfMemoryError, MemoryError):
                return Outcome.OUT_OF_MEMORY
            except RuntimeError as error:
                if "can't allocate memory" in str(error):  # what torch's CPU allocator says
                    return Outcome.OUT_OF_MEMORY
                raise
            if outcome is None and state.step < self.steps and stop():
                outcome = Outcome.INTERRUPTED
        return outcome or Outcome.FINISHED

    def _take_up(self, state: TrainState, context: RunContext) -> Outcome | None:
        """Begin where a resumed run ended: a refused refinement comes first, perhaps under a larger cap."""
        if state.refused:
            refined, outcome = self._refine(state, state.step)
            self._tell(context, state, refined, None)
            return outcome
        return Outcome.VANISHED if len(state.gaussians) == 0 else None

    def _advance(self, state: TrainState, embedding: PromptEmbedding, context: RunContext) -> Outcome | None:
        """One step with its refinement, and the callbacks' look at it."""
        started = time.perf_counter()
        report = self._step(state, embedding)
        refined, outcome = self._refine(state, state.step + 1)
        state.step += 1
        state.seconds += time.perf_counter() - started
        self._tell(context, state, refined, report)
        return outcome

    def _tell(
        self,
        context: RunContext,
        state: TrainState,
        refined: RefineReport | None,
        report: StepReport | None,
    ) -> None:
        for callback in self.callbacks:
            if refined is not None:
                callback.on_refine(context, state, refined)
            if report is not None:
                callback.on_step(context, state, report)

    def _step(self, state: TrainState, embedding: PromptEmbedding) -> StepReport:
        """Render, judge, differentiate, observe and step."""
        gaussians, draw = state.gaussians, state.generators
        cameras = self.camera.sample(state.step, self.views, draw["camera"]).to(gaussians.device)
        background = self.background.sample(self.views, draw["background"]).to(gaussians.device)
        rendered = self.augmentation.perturb(gaussians, draw["augmentation"])
        output = self.rasterizer.render(rendered, cameras, background, self.densifier.needs_absgrad)
        images = self.augmentation.show(output, draw["augmentation"])
        condition = embedding.at(cameras, background)
        judged = self.guidance(images, condition, self.prior, state.step, draw["guidance"])
        penalties = {name: fn(rendered, output, state.step) for name, fn in self.regularizers.items()}
        loss = sum(penalties.values(), start=judged.loss)
        if penalties and self.densifier.guidance_only:
            judged.loss.backward(retain_graph=True)
            signal = _signal(gaussians, output)
            torch.stack(list(penalties.values())).sum().backward()
        else:
            loss.backward()
            signal = _signal(gaussians, output)

        state.densifier = self.densifier.observe(state.densifier, signal)
        if state.optimizer.finite_gradients():
            state.optimizer.step(state.step)
            self._perturb(state)
        else:
            state.skipped += 1
            state.optimizer.zero_grad()
        log = {**judged.log, **{name: float(value.detach()) for name, value in penalties.items()}}
        if (factor := self.exposure.dimming(output, background, state.step + 1)) is not None:
            state.optimizer.scale_colors(factor)
            state.dimmed += 1
        if state.dimmed:
            log["dimmed"] = float(state.dimmed)
        return StepReport(
            step=state.step + 1, loss=float(loss.detach()), log=log, num_gaussians=len(gaussians)
        )

    def _perturb(self, state: TrainState) -> None:
        """Move the means at random, if the densifier wants it."""
        lr = self.optimizer.learning_rates(state.step)["means"]
        offsets = self.densifier.perturb(state.gaussians.detach(), lr, state.generators["densifier"])
        if offsets is not None:
            state.optimizer.displace(offsets)

    def _refine(self, state: TrainState, step: int) -> tuple[RefineReport | None, Outcome | None]:
        """Grow, prune and reset where the schedule says so: a pure plan, then one edit for everybody."""
        refines, resets = self.refine.refines_at(step), self.refine.resets_at(step)
        if not (refines or resets):
            return None, None
        report = self._look(state, step)
        if refines:
            report = self._grow(state, report)
            if state.refused:
                return report, Outcome.MAX_GAUSSIANS
        if resets:
            unreliable = self.densifier.unreliable(state.densifier)
            lowered = state.optimizer.reset_opacity(unreliable, self.refine.reset_value)
            state.densifier = self.densifier.after_reset(state.densifier, unreliable)
            report = replace(report, reset=lowered)
        return report, (Outcome.VANISHED if report.after == 0 else None)

    def _look(self, state: TrainState, step: int) -> RefineReport:
        """What the densifier sees, before anything is decided."""
        gaussians, seen = state.gaussians.detach(), state.densifier
        n = len(gaussians)
        return RefineReport(
            step=step,
            before=n,
            after=n,
            selected=0,
            cloned=0,
            split=0,
            pruned=0,
            reset=0,
            statistics=self.densifier.statistics(seen, step),
            population=Population(
                gaussians=gaussians,
                is_selected=torch.zeros(n, dtype=torch.bool, device=gaussians.device),
                scores=self.densifier.scores(seen),
            ),
        )

    def _grow(self, state: TrainState, report: RefineReport) -> RefineReport:
        """Apply one refinement to all owners of rows, or refuse it whole; ``state.refused`` says which."""
        generator = state.generators["refine"]
        draws_before = generator.get_state()
        plan = self.densifier.plan(state.densifier, state.gaussians, report.step, self.refine, generator)
        population = replace(report.population, is_selected=plan.is_selected)
        report = replace(report, selected=plan.selected, population=population)
        state.refused = self.refine.exceeds(plan)
        if state.refused:
            generator.set_state(draws_before)
            return report
        carried = self.densifier.carry(state.densifier, plan.edit)
        state.optimizer.apply(plan.edit)
        state.densifier = carried  # only now: memory may run out above, and owners must agree even then
        after = len(state.gaussians)
        return replace(report, after=after, cloned=plan.cloned, split=plan.split, pruned=plan.pruned)


def _signal(gaussians: Gaussians, output: RenderOutput) -> GradientSignal:
    """What the last backward pass left: copies, for another pass would add to it in place."""
    return GradientSignal(
        means=_gradient_of(gaussians.means),
        means2d=_gradient_of(output.means2d),
        radii=output.radii.detach(),
        height=output.rgb.shape[1],
        width=output.rgb.shape[2],
        absgrad=None if output.absgrad is None else _gradient_of(output.absgrad),
    )


def _gradient_of(tensor: Tensor) -> Tensor:
    """A copy of what backward left there; zeros if that was nothing."""
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad.detach().clone()
