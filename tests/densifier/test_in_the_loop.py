"""Laws of densifiers inside the training loop: what they observe, and the effects of what they return."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import torch
from composed import composed

from cadam3d.build import build_trainer, component
from cadam3d.callback.base import Callback
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.settings.compose import compose
from cadam3d.state import Outcome, RefineReport, RunContext, TrainState

CPU = torch.device("cpu")
SMALL = [
    "prompt=a red cube",
    "prior=tiny",
    "rasterizer=auto",
    "steps=6",
    "camera.size=16",
    "initializer.count=30",
    "refine.start=0",
    "refine.end=100",
    "refine.interval=2",
    "refine.prune_from=0",
    "refine.max_scale=null",
    "refine.min_opacity=0",
    "refine.reset_interval=4",
    "refine.reset_from=4",
    "refine.reset_until=100",
    "refine.recovery=1",
    "callback=[]",
]


@dataclass
class Recorder(Callback):
    """Records reports, and the densifier state after each refinement."""

    reports: list[RefineReport] = field(default_factory=list)
    states: list[dict[str, torch.Tensor]] = field(default_factory=list)

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        self.reports.append(report)
        self.states.append({name: rows.clone() for name, rows in state.densifier.to_dict().items()})


def run(overrides: Sequence[str], folder: Path) -> tuple[TrainState, Recorder, Outcome]:
    is_cadam = not any(line.startswith("densifier=") and "cadam" not in line for line in overrides)
    cfg = composed(*SMALL, *(["densifier.min_age=0"] if is_cadam else []), *overrides)
    recorder = Recorder()
    trainer = replace(build_trainer(cfg, CPU), callbacks=[recorder])
    state = trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, CPU)
    context = RunContext(
        folder, cfg.prompt, trainer.steps, trainer.renderer(state), trainer.rasterizer, trainer.densifier
    )
    outcome = trainer.train(state, trainer.prior.embed(cfg.prompt, ""), context)
    return state, recorder, outcome


# The report that callbacks see.


def test_a_report_has_the_population_before_the_edit_and_the_selected_gaussians(tmp_path, monkeypatch):
    seen: list[Gaussians] = []
    refine = type(component(compose(SMALL).refine))
    plan = refine.plan

    def spy(self, gaussians, *args):
        seen.append(gaussians.map(lambda tensor: tensor.detach().clone()))
        return plan(self, gaussians, *args)

    monkeypatch.setattr(refine, "plan", spy)
    _, recorder, _ = run([], tmp_path)
    assert any(report.after > report.before for report in recorder.reports)
    for report, gaussians in zip(recorder.reports, seen, strict=True):
        population = report.population
        for name in FIELDS:
            assert torch.equal(getattr(population.gaussians, name), getattr(gaussians, name))
            assert not getattr(population.gaussians, name).requires_grad
        assert int(population.is_selected.sum()) == report.selected
        assert {len(rows) for rows in population.scores.values()} == {report.before}
        chosen = population.scores["snr"][population.is_selected]
        assert (chosen > 0.1).all()


# Effects on the run.


@pytest.mark.parametrize(("screen_px", "outcome"), [("null", Outcome.FINISHED), ("0.01", Outcome.VANISHED)])
def test_screen_size_prunes_as_intended_or_as_shipped(screen_px, outcome, tmp_path):
    quiet = ["densifier=baseline", "densifier.tau_pos=1e9", "refine.reset_interval=null"]
    assert run([*quiet, f"densifier.screen_px={screen_px}"], tmp_path)[2] is outcome


@pytest.mark.parametrize(("choice", "is_global"), [("cadam_no_reset", False), ("cadam_global_reset", True)])
def test_the_densifier_decides_which_opacities_are_reset(choice, is_global, tmp_path):
    _, recorder, _ = run([f"densifier={choice}"], tmp_path)
    at_reset = recorder.reports[1]
    assert at_reset.step == 4
    assert at_reset.reset == (at_reset.after if is_global else 0)


def test_noise_moves_the_means_after_the_optimizer_step_and_nothing_else(tmp_path):
    still, _, _ = run(["densifier=mcmc", "densifier.noise_lr=0", "steps=1"], tmp_path)
    moved, _, _ = run(["densifier=mcmc", "densifier.noise_lr=1e5", "steps=1"], tmp_path)
    cfg = composed(*SMALL, "densifier=mcmc", "densifier.noise_lr=1e5")
    trainer = build_trainer(cfg, CPU)
    draws = trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, CPU).generators["densifier"]
    lr = trainer.optimizer.learning_rates(0)["means"]
    expected = trainer.densifier.perturb(still.gaussians.detach(), lr, draws)
    torch.testing.assert_close(moved.gaussians.means - still.gaussians.means, expected, rtol=1e-3, atol=1e-6)
    assert expected.abs().max() > 1e-3
    for name in set(FIELDS) - {"means"}:
        assert torch.equal(getattr(moved.gaussians, name), getattr(still.gaussians, name))
