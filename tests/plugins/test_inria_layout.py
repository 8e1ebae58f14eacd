"""The subclass in ``docs/your_trainer.md`` lets a trainer of Inria's layout decide as ``densifier=cadam``."""

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from composed import composed
from evidence import CPU, DRAWS, noise, signal
from splats import make_gaussians

from cadam3d.build import component
from cadam3d.core.gaussians import Gaussians

PAGE = Path(__file__).parents[2] / "docs/your_trainer.md"
SETTINGS = {"tau_Q": 0.6, "tau_SNR": 0.25, "min_age": 4, "reset_min_age": 4}
EXTENT = 1.0  # of the scene, world units
GROUPS = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
}


class GaussianModel:
    """A small class with the attributes and methods that descendants of Inria's class share."""

    percent_dense = 0.13

    def __init__(self, gaussians: Gaussians):
        self._set(
            xyz=gaussians.means,
            f_dc=gaussians.sh,
            opacity=gaussians.opacity_logits[:, None],
            scaling=gaussians.log_scales,
            rotation=gaussians.quats,
        )

    def _set(self, **tensors):
        for name, tensor in tensors.items():
            setattr(self, GROUPS[name], torch.nn.Parameter(tensor.detach().clone()))

    def training_setup(self, training_args):
        self.optimizer = torch.optim.Adam(
            [{"params": [getattr(self, attribute)], "name": name} for name, attribute in GROUPS.items()],
            lr=0.01,
        )
        self._clear_stats()

    def _clear_stats(self):
        self.xyz_gradient_accum = torch.zeros(len(self._xyz), 1)
        self.denom = torch.zeros(len(self._xyz), 1)

    def add_densification_stats(self, viewspace_points, update_filter):
        self.xyz_gradient_accum[update_filter] += viewspace_points[update_filter].norm(dim=-1, keepdim=True)
        self.denom[update_filter] += 1

    def _replace(self, change):
        """Replace each parameter by ``change(name, parameter)``, and its moments in the same way."""
        for group in self.optimizer.param_groups:
            old = group["params"][0]
            state = self.optimizer.state.pop(old, {})
            new = torch.nn.Parameter(change(group["name"], old.detach()))
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key] = change(None, state[key])
            group["params"][0] = new
            self.optimizer.state[new] = state
            setattr(self, GROUPS[group["name"]], new)

    def densification_postfix(self, xyz, f_dc, opacity, scaling, rotation):
        new = {"xyz": xyz, "f_dc": f_dc, "opacity": opacity, "scaling": scaling, "rotation": rotation}
        count = len(xyz)
        self._replace(
            lambda name, rows: torch.cat(
                [rows, new[name] if name else rows.new_zeros(count, *rows.shape[1:])]
            )
        )
        self._clear_stats()

    def prune_points(self, mask):
        self._replace(lambda name, rows: rows[~mask])
        self.xyz_gradient_accum, self.denom = self.xyz_gradient_accum[~mask], self.denom[~mask]

    def _large(self):
        return self._scaling.exp().amax(dim=1) > self.percent_dense * EXTENT

    def densify_and_clone(self, grads, grad_threshold, extent):
        mask = (grads.norm(dim=-1) >= grad_threshold) & ~self._large()
        self.densification_postfix(
            *(getattr(self, attribute)[mask].detach() for attribute in GROUPS.values())
        )

    def densify_and_split(self, grads, grad_threshold, extent, N=2):
        padded = torch.zeros(len(self._xyz))
        padded[: len(grads)] = grads.squeeze()
        mask = (padded >= grad_threshold) & self._large()
        rows = [
            getattr(self, name)[mask].detach().repeat(N, *[1] * (getattr(self, name).ndim - 1))
            for name in GROUPS.values()
        ]
        rows[3] = rows[3] - torch.tensor(1.6).log()
        self.densification_postfix(*rows)
        self.prune_points(torch.cat([mask, torch.zeros(N * int(mask.sum()), dtype=torch.bool)]))

    def densify_and_prune(self, max_grad, min_opacity, extent, max_screen_size):
        grads = self.xyz_gradient_accum / self.denom
        grads[grads.isnan()] = 0.0
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split(grads, max_grad, extent)
        self.prune_points((self._opacity.sigmoid() < min_opacity).squeeze())

    def reset_opacity(self):
        raise AssertionError("the subclass has its own reset")

    def capture(self):
        tensors = {name: getattr(self, attribute) for name, attribute in GROUPS.items()}
        return tensors, self.optimizer.state_dict()

    def restore(self, model_args, training_args):
        tensors, optimizer = model_args
        self._set(**tensors)
        self.training_setup(training_args)
        self.optimizer.load_state_dict(optimizer)


@pytest.fixture
def model_class(monkeypatch) -> type[GaussianModel]:
    """Return the class that a reader of the page writes."""
    text = PAGE.read_text(encoding="utf-8")
    source = re.search(
        r"`cadam_gaussian_model\.py`:\n\n```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL
    )
    assert source is not None
    for name in ("scene", "scene.gaussian_model"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["scene.gaussian_model"].GaussianModel = GaussianModel
    names = {}
    exec(compile(source.group(1), str(PAGE), "exec"), names)
    return names["CAdamGaussianModel"]


def gaussians_of(model: GaussianModel) -> Gaussians:
    return Gaussians(
        model._xyz, model._scaling, model._rotation, model._opacity[:, 0], model._features_dc
    ).detach()


def train(model: GaussianModel, iterations: range, seen: list | None = None) -> None:
    """Train as ``train.py`` does: statistics, refinement and reset come before the step of the optimizer."""
    for iteration in iterations:
        gradient = noise(1, len(model._xyz), seed=iteration)[0]
        rest = [model._opacity.square().sum(), model._scaling.sum(), model._rotation.sum()]
        ((model._xyz * gradient).sum() + model._features_dc.sum() + sum(rest)).backward()
        model.add_densification_stats(
            torch.ones(len(model._xyz), 2), torch.ones(len(model._xyz), dtype=torch.bool)
        )
        if seen is not None:
            seen.append((iteration, gradient, gaussians_of(model)))
        if iteration % 10 == 0:
            model.densify_and_prune(0.0002, 0.3, EXTENT, None)
        if iteration % 20 == 0:
            model.reset_opacity()
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)


def start(model_class, gaussians: Gaussians) -> GaussianModel:
    model = model_class(gaussians)
    model.training_setup(None)
    change_settings(model)
    return model


def change_settings(model: GaussianModel) -> None:
    for name, value in SETTINGS.items():
        setattr(model.tracker, name, value)


def test_selections_counts_and_resets_are_those_of_densifier_cadam(model_class):
    lines = [*(f"densifier.{name}={value}" for name, value in SETTINGS.items()), "steps=100000"]
    schedule = ["interval=10", "start=0", "end=100", "reset_interval=20", "reset_from=1", "reset_until=100"]
    limits = ["tau_scale=0.13", "min_opacity=0.3", "max_scale=null", "reset_value=0.31"]
    cfg = composed("prompt=a cube", *lines, *(f"refine.{line}" for line in [*schedule, *limits]))
    densifier, refine = component(cfg.densifier), component(cfg.refine)
    model = start(model_class, make_gaussians(40))
    state, seen = densifier.init_state(40, CPU), []
    totals = torch.zeros(4)
    for iteration in range(1, 32):
        train(model, range(iteration, iteration + 1), seen)
        _, gradient, before = seen[-1]
        state = densifier.observe(state, signal(gradient))
        if iteration % 10 == 0:
            plan = densifier.plan(state, before, iteration, refine, DRAWS)
            state = state.carry(plan.edit)
            unreliable = densifier.unreliable(state)
            is_low = model._opacity[:, 0].sigmoid() <= 0.0101
            assert len(model._xyz) == plan.edit.rows_after
            assert torch.equal(is_low, unreliable if iteration == 20 else torch.zeros_like(unreliable))
            totals += torch.tensor([plan.cloned, plan.split, plan.pruned, int(is_low.sum())])
        for name, rows in state.to_dict().items():
            assert torch.equal(getattr(model.tracker.state, name), rows)
    assert (totals > 0).all(), totals


def test_a_captured_model_continues_to_the_bit(model_class):
    whole, saved, restored = (start(model_class, make_gaussians(20)) for _ in range(3))
    train(whole, range(1, 25))
    train(saved, range(1, 15))
    restored.restore(saved.capture(), None)
    change_settings(restored)
    train(restored, range(15, 25))
    assert len(saved._xyz) != len(whole._xyz)
    assert torch.equal(restored.tracker.state.m, whole.tracker.state.m)
    for attribute in GROUPS.values():
        assert torch.equal(getattr(restored, attribute), getattr(whole, attribute))
