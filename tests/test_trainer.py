"""Laws of the training loop: the same seed gives the same bytes, resuming too, and outcomes are recorded."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import composed

from cadam3d.augmentation import LucidAugmentation
from cadam3d.build import build_trainer, component
from cadam3d.callback.base import Callback
from cadam3d.core.errors import UserError
from cadam3d.regularizer import MeanScale
from cadam3d.settings.compose import compose
from cadam3d.state import (
    TIMES,
    Outcome,
    RefineReport,
    RunContext,
    StepReport,
    TrainState,
    start_generators,
)
from cadam3d.trainer import Trainer

CPU = torch.device("cpu")
SMALL = [
    "prompt=a red cube",
    "prior=tiny",
    "rasterizer=auto",
    "steps=8",
    "camera.size=16",
    "initializer.count=30",
    "refine.start=0",
    "refine.end=100",
    "refine.interval=2",
    "refine.reset_interval=4",
    "refine.reset_from=4",
    "refine.reset_until=100",
    "refine.recovery=1",
    "callback=[]",
]


@dataclass
class Recorder(Callback):
    """Records the reports and outcomes that the trainer passes on."""

    steps: list[StepReport] = field(default_factory=list)
    refinements: list[RefineReport] = field(default_factory=list)
    ends: list[Outcome] = field(default_factory=list)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        assert report.step == state.step
        self.steps.append(report)

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        self.refinements.append(report)

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        self.ends.append(outcome)


def make(overrides: Sequence[str] = ()) -> tuple[Trainer, TrainState]:
    is_cadam = not any(line.startswith("densifier=") and line != "densifier=cadam" for line in overrides)
    cfg = composed(*SMALL, *(["densifier.min_age=0"] if is_cadam else []), *overrides)
    trainer = build_trainer(cfg, CPU)
    return trainer, trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, CPU)


def go(trainer: Trainer, state: TrainState, tmp_path: Path, **kwargs) -> Outcome:
    embedding = trainer.prior.embed("a red cube", "")
    context = RunContext(
        tmp_path, "a red cube", trainer.steps, trainer.renderer(state), trainer.rasterizer, trainer.densifier
    )
    return trainer.train(state, embedding, context, **kwargs)


def restore(trainer: Trainer, payload: dict) -> TrainState:
    return TrainState.restore(payload, trainer.optimizer, trainer.densifier, CPU)


def same(left: dict, right: dict) -> bool:
    """Return whether two payloads are equal to the bit, apart from wall-clock time."""
    assert left.keys() == right.keys()
    for key, value in left.items():
        other = right[key]
        if isinstance(value, dict):
            if not same(value, other):
                return False
        elif isinstance(value, torch.Tensor):
            if not torch.equal(value, other):
                return False
        elif key not in TIMES and value != other:
            return False
    return True


@pytest.mark.parametrize("densifier", ["cadam", "baseline", "absgs", "none", "random", "mcmc"])
def test_the_same_seed_gives_the_same_bytes(tmp_path, densifier):
    payloads = []
    for _ in range(2):
        trainer, state = make([f"densifier={densifier}"])
        go(trainer, state, tmp_path)
        payloads.append(state.to_payload())
    assert same(*payloads)


def test_the_fallback_of_an_initializer_is_recorded_in_checkpoints():
    lines = ["initializer=shap_e", "initializer.path=nowhere", "initializer/fallback=ball"]
    trainer, state = make(lines)
    assert state.initial_note.startswith("Ball is used instead of Shap-E")
    assert len(state.gaussians) == state.num_initial == 4000
    assert restore(trainer, state.to_payload()).initial_note == state.initial_note


SIMPLIFIED = "baseline_simplified densifier.count=9 densifier.at=4 refine.max_scale=null refine.min_opacity=0"


@pytest.mark.parametrize("densifier", ["cadam", "baseline", "absgs", "random", "mcmc", SIMPLIFIED])
def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(tmp_path, densifier):
    lines = f"densifier={densifier}".split()
    trainer, whole = make(lines)
    go(trainer, whole, tmp_path)
    assert densifier != SIMPLIFIED or len(whole.gaussians) == 9

    _, state = make(lines)
    for cut in (1, 4, 5, 8):
        spent = [getattr(state, name) for name in TIMES]
        # The run stops early but has the schedules of the whole run.
        go(replace(trainer, steps=cut), state, tmp_path)
        torch.save(state.to_payload(), tmp_path / "part.pt")
        state = restore(trainer, torch.load(tmp_path / "part.pt", weights_only=True))
        assert all(getattr(state, name) > before for name, before in zip(TIMES, spent, strict=True))
    assert same(whole.to_payload(), state.to_payload())


def test_a_reset_follows_the_refinement_of_its_step(tmp_path):
    trainer, state = make(["densifier=baseline", "densifier.tau_pos=1e-9"])
    recorder = Recorder()
    go(replace(trainer, steps=4, callbacks=[recorder]), state, tmp_path)
    last = recorder.refinements[-1]
    assert (last.step, last.reset) == (4, last.after)
    assert last.after > last.before


def test_densifiers_with_one_seed_see_the_same_views_and_noise(tmp_path):
    ends = {}
    for densifier in ("cadam", "none"):
        trainer, state = make([f"densifier={densifier}"])
        go(trainer, state, tmp_path)
        ends[densifier] = state.to_payload()["generators"]
    for source in ("camera", "background", "guidance"):
        assert torch.equal(ends["cadam"][source], ends["none"][source])


def test_a_random_stream_depends_only_on_its_position_in_the_list():
    """A new source of randomness then changes no other stream, and old results stay reproducible."""
    children = np.random.SeedSequence(7).spawn(5)
    old = [
        torch.Generator().manual_seed(int(child.generate_state(1, np.uint64)[0] >> 1)) for child in children
    ]
    names = ("initializer", "camera", "background", "guidance", "refine")
    new = start_generators(7)
    for name, generator in zip(names, old, strict=True):
        assert torch.equal(new[name].get_state(), generator.get_state())


AUGMENTED = ["augmentation=lucid", "augmentation.disparity=0.5"]


def test_augmentation_changes_the_result_and_no_other_random_stream(tmp_path):
    ends = {}
    for lines in ([], AUGMENTED):
        trainer, state = make(["densifier=none", *lines])
        go(trainer, state, tmp_path)
        ends[len(lines)] = state.to_payload()
    assert not torch.equal(ends[0]["gaussians"]["log_scales"], ends[2]["gaussians"]["log_scales"])
    for name in ("initializer", "camera", "background", "guidance", "refine"):
        assert torch.equal(ends[0]["generators"][name], ends[2]["generators"][name])
    fresh = start_generators(0)["augmentation"].get_state()
    assert torch.equal(ends[0]["generators"]["augmentation"], fresh)
    assert not torch.equal(ends[2]["generators"]["augmentation"], fresh)


def test_guidance_gets_the_shown_images_and_regularizers_the_rendered_ones(tmp_path):
    seen = {}

    class WatchedAugmentation(LucidAugmentation):
        def perturb(self, gaussians, generator):
            seen["perturbed"] = super().perturb(gaussians, generator)
            return seen["perturbed"]

        def show(self, output, generator):
            seen["output"], seen["shown"] = output, super().show(output, generator)
            return seen["shown"]

    class WatchedGuidance(type(make()[0].guidance)):
        def __call__(self, rgb, *args):
            assert rgb is seen["shown"]
            return super().__call__(rgb, *args)

    class WatchedRegularizer(MeanScale):
        def penalty(self, gaussians, output):
            assert gaussians is seen["perturbed"]
            assert output is seen["output"]
            return super().penalty(gaussians, output)

    trainer, state = make(["steps=2"])
    watched = replace(
        trainer,
        augmentation=WatchedAugmentation(scale_noise=0.1, disparity=0.5, flip=1.0),
        guidance=WatchedGuidance(**vars(trainer.guidance)),
        regularizers={"mean_scale": WatchedRegularizer(weight=1.0)},
    )
    assert go(watched, state, tmp_path) is Outcome.FINISHED
    assert seen.keys() == {"perturbed", "output", "shown"}


ALWAYS = ["exposure=beg", "exposure.begin=2", "exposure.end=6", "exposure.threshold=0", "exposure.rate=0.5"]


def test_colours_are_dimmed_after_steps_that_are_too_bright_and_the_steps_are_counted(tmp_path):
    trainer, state = make(["densifier=none", *ALWAYS])
    recorder = Recorder()
    go(replace(trainer, callbacks=[recorder]), state, tmp_path)
    counts = [report.log.get("dimmed") for report in recorder.steps]
    assert counts == [None, None, 1, 2, 3, 3, 3, 3]
    assert state.to_payload()["dimmed"] == 3


def test_dimming_comes_after_the_step_and_changes_only_colours(tmp_path):
    results = []
    for lines in (["exposure=none"], [*ALWAYS, "exposure.begin=7", "exposure.end=9"]):
        trainer, state = make(["densifier=none", *lines])
        go(trainer, state, tmp_path)
        results.append(state.to_payload())
    plain, dimmed = results
    torch.testing.assert_close(dimmed["gaussians"]["sh"], 0.5 * plain["gaussians"]["sh"])
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        assert torch.equal(dimmed["gaussians"][name], plain["gaussians"][name])
    assert not dimmed["optimizer"]["exp_avg"]["sh_dc"].any()


def test_a_dimmed_run_resumes_to_the_bit_and_keeps_its_count(tmp_path):
    trainer, whole = make(ALWAYS)
    go(trainer, whole, tmp_path)
    _, state = make(ALWAYS)
    go(replace(trainer, steps=4), state, tmp_path)
    torch.save(state.to_payload(), tmp_path / "half.pt")
    resumed = restore(trainer, torch.load(tmp_path / "half.pt", weights_only=True))
    assert resumed.dimmed == 2
    go(trainer, resumed, tmp_path)
    assert same(whole.to_payload(), resumed.to_payload())


def test_the_densifier_observes_gradients_that_are_not_clipped(tmp_path):
    states = {}
    for bound in ("null", "1e-6"):
        trainer, state = make(["steps=1", f"optimizer.clip_norm={bound}"])
        go(trainer, state, tmp_path)
        states[bound] = state.to_payload()
    assert torch.equal(states["null"]["densifier"]["m"], states["1e-6"]["densifier"]["m"])
    clipped = states["1e-6"]["optimizer"]["exp_avg"]["means"]
    assert float(clipped.norm()) == pytest.approx(1e-7, rel=1e-4)
    assert float(states["null"]["optimizer"]["exp_avg"]["means"].norm()) > 1e-4


def test_rows_of_all_three_owners_agree_after_every_refinement(tmp_path):
    class RowCheck(Callback):
        def on_refine(self, context, state, report):
            assert report.after == len(state.gaussians)
            assert report.after == report.before + report.cloned + report.split - report.pruned
            assert state.densifier.to_dict()["m"].shape[0] == report.after
            assert state.optimizer.state_dict()["exp_avg"]["means"].shape[0] == report.after

    trainer, state = make()
    recorder = Recorder()
    go(replace(trainer, callbacks=[RowCheck(), recorder]), state, tmp_path)
    assert [report.step for report in recorder.refinements] == [2, 4, 6, 8]
    assert any(report.cloned + report.split for report in recorder.refinements)


@pytest.mark.parametrize("end", [5, 100])
@pytest.mark.parametrize("densifier", ["cadam", "mcmc"])
def test_the_last_pruning_leaves_no_large_gaussian_whether_the_last_step_refines_or_not(
    tmp_path, end, densifier
):
    limit = 0.19
    words = [f"refine.last_max_scale={limit}", f"refine.end={end}", f"densifier={densifier}"]
    trainer, state = make(words)
    recorder = Recorder()
    assert go(replace(trainer, callbacks=[recorder]), state, tmp_path) is Outcome.FINISHED
    [*earlier, last] = recorder.refinements
    assert last.step == 8
    assert last.pruned > 0 or densifier == "mcmc"
    assert all(float(each.population.gaussians.scales.max()) > limit for each in earlier)
    assert float(state.gaussians.scales.max()) <= limit
    if end == 5:
        assert (last.selected, last.cloned, last.split) == (0, 0, 0)
        assert last.pruned > 0


def test_the_last_pruning_removes_ghosts_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr("cadam3d.trainer.ghosts", lambda gaussians, *_: gaussians.means[:, 0] > 0)
    trainer, state = make(["refine.end=5", "refine.min_opacity=0", "refine.max_scale=null"])
    recorder = Recorder()
    assert go(replace(trainer, callbacks=[recorder]), state, tmp_path) is Outcome.FINISHED
    last = recorder.refinements[-1]
    assert (last.step, last.selected) == (8, 0)
    kept = last.population.gaussians.means[last.population.gaussians.means[:, 0] <= 0]
    assert 0 < len(kept) < last.before
    assert torch.equal(state.gaussians.means.detach(), kept)


def test_every_refinement_prunes_gaussians_that_contribute_little(tmp_path, monkeypatch):
    monkeypatch.setattr("cadam3d.trainer.contributions", lambda gaussians, _: gaussians.means[:, 0].exp())
    trainer, state = make(["refine.min_contribution=0.5", "refine.end=9", "refine.min_opacity=0"])
    recorder = Recorder()
    go(replace(trainer, callbacks=[recorder]), state, tmp_path)
    for each in recorder.refinements:
        shown = each.population.gaussians.means[:, 0].exp()
        idle = shown < 0.5 * shown.median()
        assert not idle[each.edit.keep].any()
    assert sum(each.pruned for each in recorder.refinements) > 0


def test_a_stop_signal_ends_the_run_after_the_current_step(tmp_path):
    trainer, state = make()
    answers = iter([False, False, True])
    assert go(trainer, state, tmp_path, stop=lambda: next(answers)) is Outcome.INTERRUPTED
    assert state.step == 3


def test_growth_beyond_max_gaussians_is_an_outcome_and_is_not_applied(tmp_path):
    trainer, state = make(["refine.max_gaussians=30"])
    recorder = Recorder()
    outcome = go(replace(trainer, callbacks=[recorder]), state, tmp_path)
    assert outcome is Outcome.MAX_GAUSSIANS
    assert recorder.ends == [outcome]
    assert len(state.gaussians) == 30
    assert recorder.refinements[-1].selected > 0


@pytest.mark.parametrize("densifier", ["cadam", "random", "mcmc"])
def test_a_resumed_run_with_a_larger_cap_equals_a_run_without_a_cap(tmp_path, densifier):
    free, whole = make([f"densifier={densifier}"])
    go(free, whole, tmp_path)

    capped, state = make([f"densifier={densifier}", "refine.max_gaussians=30"])
    assert go(capped, state, tmp_path) is Outcome.MAX_GAUSSIANS
    torch.save(state.to_payload(), tmp_path / "capped.pt")

    def restored() -> TrainState:
        return restore(free, torch.load(tmp_path / "capped.pt", weights_only=True))

    again = restored()
    # The same cap refuses the same refinement.
    assert go(capped, again, tmp_path) is Outcome.MAX_GAUSSIANS
    assert again.step == state.step
    resumed = restored()
    assert go(free, resumed, tmp_path) is Outcome.FINISHED
    assert same(whole.to_payload(), resumed.to_payload())


def test_a_refused_refinement_that_a_new_schedule_leaves_out_does_not_end_the_resumed_run(tmp_path):
    capped, state = make(["refine.max_gaussians=30"])
    assert go(capped, state, tmp_path) is Outcome.MAX_GAUSSIANS
    without_growth, _ = make(["refine.max_gaussians=30", "refine.end=0", "refine.reset_interval=null"])
    assert go(without_growth, state, tmp_path) is Outcome.FINISHED
    assert not state.refused


def test_memory_that_runs_out_while_a_refused_refinement_is_repeated_is_an_outcome(tmp_path, monkeypatch):
    capped, state = make(["refine.max_gaussians=30"])
    assert go(capped, state, tmp_path) is Outcome.MAX_GAUSSIANS

    def exhausted(*_args):
        raise MemoryError

    monkeypatch.setattr("cadam3d.core.edit.RowEdit.apply", exhausted)
    free, _ = make()
    assert go(free, state, tmp_path) is Outcome.OUT_OF_MEMORY


def test_losing_every_gaussian_is_an_outcome(tmp_path):
    trainer, state = make(["refine.min_opacity=0.999999", "refine.reset_interval=null"])
    assert go(trainer, state, tmp_path) is Outcome.VANISHED
    assert len(state.gaussians) == 0
    assert go(trainer, state, tmp_path) is Outcome.VANISHED  # resuming it changes nothing
    camera = component(compose(SMALL).camera).sample(0, 1, torch.Generator())
    image = trainer.renderer(state)(camera, torch.ones(1, 3))
    assert torch.equal(image.rgb, torch.ones_like(image.rgb))


@pytest.mark.parametrize(
    "error",
    [torch.OutOfMemoryError("no"), RuntimeError("DefaultCPUAllocator: can't allocate memory: 9 bytes")],
)
def test_running_out_of_memory_is_an_outcome(tmp_path, error, monkeypatch):
    trainer, state = make(["rasterizer=reference"])

    def exhausted(*_args):
        raise error

    monkeypatch.setattr(type(trainer.rasterizer), "render", exhausted)
    assert go(trainer, state, tmp_path) is Outcome.OUT_OF_MEMORY
    assert state.step == 0


@pytest.mark.parametrize("where", ["cadam3d.core.edit.RowState.carry", "cadam3d.core.edit.RowEdit.apply"])
def test_owners_of_rows_agree_even_if_memory_runs_out_within_a_refinement(tmp_path, monkeypatch, where):
    trainer, state = make()

    def exhausted(*_args):
        raise MemoryError

    monkeypatch.setattr(where, exhausted)
    assert go(trainer, state, tmp_path) is Outcome.OUT_OF_MEMORY
    rows = len(state.gaussians)
    assert state.densifier.to_dict()["m"].shape[0] == rows
    assert state.optimizer.state_dict()["exp_avg"]["means"].shape[0] == rows


@pytest.mark.parametrize("densifier", ["cadam", "mcmc"])
def test_a_step_with_a_non_finite_gradient_changes_nothing_but_is_counted(tmp_path, densifier):
    trainer, state = make(["steps=1", f"densifier={densifier}"])

    class Poison(type(trainer.guidance)):
        def __call__(self, rgb, *args):
            output = super().__call__(rgb, *args)
            return replace(output, loss=output.loss + float("nan") * rgb.sum())

    before = state.to_payload()
    poisoned = Poison(**vars(trainer.guidance))
    go(replace(trainer, guidance=poisoned), state, tmp_path)
    after = state.to_payload()
    assert after["skipped"] == 1
    # The noise of MCMC is skipped too.
    for owner in ("gaussians", "optimizer", "densifier"):
        assert same({owner: before[owner]}, {owner: after[owner]})


def test_a_checkpoint_of_another_densifier_is_refused():
    _, state = make(["densifier=baseline"])
    other, _ = make(["densifier=cadam"])
    with pytest.raises(UserError, match="densifier"):
        restore(other, state.to_payload())


def test_a_loop_that_raises_calls_on_abort(tmp_path, monkeypatch):
    class Holder(Callback):
        was_called = False

        def on_abort(self, context: RunContext) -> None:
            self.was_called = True

    trainer, state = make(["rasterizer=reference"])
    holder = Holder()
    monkeypatch.setattr(type(trainer.rasterizer), "render", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        go(replace(trainer, callbacks=[holder]), state, tmp_path)
    assert holder.was_called
