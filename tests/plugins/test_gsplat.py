"""CAdamStrategy in trainers of gsplat: the same selections as ``densifier=cadam``, whatever the trainer does.

Most of gsplat's operations on rows are pure torch, so everything but its rasterization runs on the CPU. The
trainers here call a strategy in the order of gsplat's ``examples/simple_trainer.py``.
"""

import inspect
import io
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from composed import composed
from evidence import CPU, DRAWS, noise, signal
from splats import backgrounds, make_cameras, make_gaussians
from torch.nn import Parameter, ParameterDict

pytest.importorskip("gsplat", reason="pip install -e .[dev]")

from gsplat import DefaultStrategy, MCMCStrategy
from gsplat.strategy import default

from cadam3d.build import component
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.plugins import gsplat as plugin
from cadam3d.plugins.gsplat import CAdamStrategy
from cadam3d.rasterizer.reference import ReferenceRasterizer

EXACT = {"rtol": 0, "atol": 0}
# Rates of the optimizers, which are high, because the runs are short.
RATES = {"means": 0.01, "scales": 0.02, "quats": 0.01, "opacities": 0.05, "colors": 0.02}
# A schedule with four refinements and two resets.
SHORT = {
    "refine_start_iter": 3,
    "refine_stop_iter": 21,
    "refine_every": 4,
    "reset_every": 8,
    "grow_scale3d": 0.13,
    "prune_scale3d": 0.45,
}
YOUNG = {"min_age": 2, "reset_min_age": 2, "tau_Q": 0.7, "tau_SNR": 0.4}


def params_of(gaussians: Gaussians) -> ParameterDict:
    """Return Gaussians as gsplat's trainer holds them."""
    tensors = {
        "means": gaussians.means,
        "scales": gaussians.log_scales,
        "quats": gaussians.quats,
        "opacities": gaussians.opacity_logits,
        "colors": gaussians.sh,
    }
    return ParameterDict({name: Parameter(tensor.clone()) for name, tensor in tensors.items()})


def gaussians_of(params: ParameterDict) -> Gaussians:
    names = ("means", "scales", "quats", "opacities", "colors")
    return Gaussians(*(params[name] for name in names))


class Trainer:
    """The loop of gsplat's simple_trainer, with our rasterizer. Only the strategy is from outside."""

    def __init__(self, strategy, n=24, views=2):
        self.strategy = strategy
        self.params = params_of(make_gaussians(n, seed=1))
        self.optimizers = {
            name: torch.optim.Adam([self.params[name]], lr=rate) for name, rate in RATES.items()
        }
        strategy.check_sanity(self.params, self.optimizers)
        if isinstance(strategy, DefaultStrategy):
            self.state = strategy.initialize_state(scene_scale=1.0)
        else:
            self.state = strategy.initialize_state()
        self.views = views
        self.cameras = make_cameras(views, 8, 8)
        with torch.no_grad():
            self.target, _ = self.render(make_gaussians(15, seed=2, opacity=2.0))

    def render(self, gaussians: Gaussians) -> tuple[torch.Tensor, dict[str, Any]]:
        output = ReferenceRasterizer().render(gaussians, self.cameras, backgrounds(self.views))
        info = {
            "means2d": output.means2d,
            "radii": output.radii.ceil().int()[..., None].expand(-1, -1, 2),
            "width": 8,
            "height": 8,
            "n_cameras": self.views,
            "gaussian_ids": None,
        }
        return output.rgb, info

    def step(self, step: int) -> None:
        shared = {"params": self.params, "optimizers": self.optimizers, "state": self.state, "step": step}
        images, info = self.render(gaussians_of(self.params))
        self.strategy.step_pre_backward(**shared, info=info)
        (images - self.target).abs().mean().backward()
        self.after_backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if isinstance(self.strategy, DefaultStrategy):
            self.strategy.step_post_backward(**shared, info=info, packed=False)
        else:
            self.strategy.step_post_backward(**shared, info=info, lr=RATES["means"])

    def after_backward(self) -> None:
        """Do nothing, unless a test replaces it."""

    def __len__(self) -> int:
        return len(self.params["means"])


@dataclass
class Toy:
    """A trainer without rendering: each step the gradient of the means is given."""

    strategy: CAdamStrategy
    n: int = 10
    kind: Any = torch.optim.SGD
    opacity_shape: tuple[int, ...] = ()
    params: ParameterDict = field(init=False)
    optimizers: dict[str, torch.optim.Optimizer] = field(init=False)
    state: dict[str, Any] = field(init=False)

    def __post_init__(self):
        gaussians = make_gaussians(self.n)
        self.params = params_of(gaussians)
        self.params["opacities"] = Parameter(gaussians.opacity_logits.view(-1, *self.opacity_shape))
        self.optimizers = {name: self.kind([tensor], lr=0.0) for name, tensor in self.params.items()}
        self.state = self.strategy.initialize_state()

    @property
    def shared(self) -> dict[str, Any]:
        return {"params": self.params, "optimizers": self.optimizers, "state": self.state, "info": {}}

    def loss(self, gradient: torch.Tensor) -> torch.Tensor:
        rest = sum(self.params[name].square().sum() for name in ("scales", "quats", "opacities", "colors"))
        return (self.params["means"] * gradient).sum() + rest

    def optimize(self) -> None:
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad()

    def step(self, step: int, gradient: torch.Tensor) -> None:
        self.strategy.step_pre_backward(**self.shared, step=step)
        self.loss(gradient).backward()
        self.optimize()
        self.strategy.step_post_backward(**self.shared, step=step)


def assert_observed(state: dict[str, Any], gradients: torch.Tensor, **tolerance) -> None:
    """Check that the moments are those of ``densifier=cadam`` after ``gradients`` [steps n 3]."""
    densifier = CAdamStrategy().cadam()
    expected = densifier.init_state(gradients.shape[1], CPU)
    for gradient in gradients:
        expected = densifier.observe(expected, signal(gradient))
    for name, rows in expected.to_dict().items():
        torch.testing.assert_close(state[name], rows, **(tolerance or EXACT))


# The same decisions as densifier=cadam.


class Recorder:
    """Records the masks that are given to gsplat's operations, and calls these."""

    def __init__(self, monkeypatch):
        self.masks = {}
        # gsplat itself prunes.
        for name, module in (("duplicate", plugin), ("split", plugin), ("remove", default)):
            monkeypatch.setattr(module, name, self.recording(name, getattr(module, name)))

    def recording(self, name, operation):
        def call(*, mask, **kwargs):
            self.masks[name] = mask
            operation(mask=mask, **kwargs)

        return call

    def selected(self, n: int) -> torch.Tensor:
        empty = torch.zeros(n, dtype=torch.bool)
        return self.masks.get("duplicate", empty) | self.masks.get("split", empty)[:n]


def ours(strategy: CAdamStrategy):
    """Return ``densifier=cadam`` and ``refine`` from our YAML files, with the settings of a strategy."""
    lines = {
        "steps": 10**6,
        "densifier": "cadam",
        "densifier.min_age": strategy.min_age,
        "densifier.reset_min_age": strategy.reset_min_age,
        "densifier.tau_Q": strategy.tau_Q,
        "densifier.tau_SNR": strategy.tau_SNR,
        "refine.start": strategy.refine_start_iter,
        "refine.end": strategy.refine_stop_iter,
        "refine.interval": strategy.refine_every,
        "refine.tau_scale": strategy.grow_scale3d,
        "refine.min_opacity": strategy.prune_opa,
        "refine.max_scale": strategy.prune_scale3d,
        "refine.prune_from": strategy.reset_every,
        "refine.reset_interval": strategy.reset_every,
        "refine.reset_from": 1,
        "refine.reset_until": strategy.refine_stop_iter,
        "refine.reset_value": 2 * strategy.prune_opa,
    }
    cfg = composed("prompt=a cube", *(f"{key}={value}" for key, value in lines.items()))
    return component(cfg.densifier), component(cfg.refine)


def test_selections_counts_and_resets_are_those_of_densifier_cadam_on_the_same_gradients(monkeypatch):
    torch.manual_seed(0)  # gsplat's split draws from torch's own generator
    strategy = CAdamStrategy(**SHORT, **YOUNG, prune_opa=0.04)
    trainer = Trainer(strategy)
    densifier, refine = ours(strategy)
    state = densifier.init_state(len(trainer), CPU)
    seen = {}
    trainer.after_backward = lambda: seen.update(means=trainer.params["means"].grad.clone())
    totals = {"selected": 0, "cloned": 0, "split": 0, "pruned": 0, "reset": 0}
    # The strategy decides after the optimizer has moved the Gaussians, so ours must see them there.
    decide = strategy.step_post_backward

    def decide_beside(**kwargs):
        nonlocal state
        step, params = kwargs["step"], kwargs["params"]
        state = densifier.observe(state, signal(seen["means"]))
        plan = None
        if refine.refines_at(step):
            before = gaussians_of(params).map(lambda tensor: tensor.detach().clone())
            plan = densifier.plan(state, before, step, refine, DRAWS)
            state = state.carry(plan.edit)
            totals.update({name: totals[name] + getattr(plan, name) for name in totals if name != "reset"})
        recorder = Recorder(monkeypatch)
        opacities = {}

        def spy(logits, *args):
            opacities["before"] = logits.detach().clone()
            return reset(logits, *args)

        monkeypatch.setattr(plugin, "reset_opacities", spy)
        decide(**kwargs)
        assert bool(recorder.masks) == (plan is not None)
        assert bool(opacities) == refine.resets_at(step)
        if plan is not None:
            assert torch.equal(recorder.selected(len(plan.is_selected)), plan.is_selected)
            assert len(params["means"]) == plan.edit.rows_after
        if opacities:
            # Our optimizer resets copies of the same Gaussians.
            copies = component(composed("prompt=a cube").optimizer).start(gaussians_of(params).detach())
            copies.gaussians.opacity_logits.data.copy_(opacities["before"])
            unreliable = densifier.unreliable(state)
            totals["reset"] += copies.reset_opacity(unreliable, refine.reset_value)
            torch.testing.assert_close(
                params["opacities"].detach(), copies.gaussians.opacity_logits.detach(), **EXACT
            )
            moments = kwargs["optimizers"]["opacities"].state[params["opacities"]]
            assert not moments["exp_avg"][unreliable].any()
            assert moments["exp_avg"][~unreliable].any()
        for name, rows in state.to_dict().items():
            torch.testing.assert_close(trainer.state[name], rows, **EXACT)

    reset = plugin.reset_opacities
    monkeypatch.setattr(strategy, "step_post_backward", decide_beside)
    for step in range(strategy.refine_stop_iter):
        trainer.step(step)
    assert all(totals.values()), totals
    assert len(trainer) > 24


class Calls(MCMCStrategy):
    """Records the calls that a trainer makes."""

    def step_pre_backward(self, *args, **kwargs):
        self.pre = (args, kwargs)

    def step_post_backward(self, *args, **kwargs):
        self.post = (args, kwargs)


def test_the_calls_for_mcmc_strategy_fit_too():
    """The kernels of MCMCStrategy need a GPU, so its calls are recorded and then compared."""
    calls = Calls()
    Trainer(calls).step(0)
    inspect.signature(MCMCStrategy.step_post_backward).bind(calls, *calls.post[0], **calls.post[1])
    strategy = CAdamStrategy()
    for method, (args, kwargs) in (("step_pre_backward", calls.pre), ("step_post_backward", calls.post)):
        inspect.signature(getattr(strategy, method)).bind(*args, **kwargs)
        getattr(strategy, method)(*args, **{**kwargs, "state": strategy.initialize_state()})


# What is observed.


@pytest.mark.parametrize("to_none", [True, False])
def test_every_step_of_the_optimizer_is_observed_once_before_gradients_are_cleared(to_none):
    gradients = noise(6, 10)
    toy = Toy(CAdamStrategy())
    for step, gradient in enumerate(gradients):
        toy.strategy.step_pre_backward(**toy.shared, step=step)
        toy.loss(gradient).backward()
        toy.optimizers["means"].step()
        toy.optimizers["means"].zero_grad(set_to_none=to_none)
        toy.strategy.step_post_backward(**toy.shared, step=step)
    assert_observed(toy.state, gradients)


@pytest.mark.parametrize("calls_strategy_each_time", [True, False])
def test_gradients_of_several_backward_passes_are_observed_as_one(calls_strategy_each_time):
    gradients = noise(4, 10), noise(4, 10, seed=1)
    toy = Toy(CAdamStrategy())
    for step in range(4):
        for part, gradient in enumerate(gradients):
            if calls_strategy_each_time or part == 0:
                toy.strategy.step_pre_backward(**toy.shared, step=step)
            toy.loss(gradient[step]).backward()
            if calls_strategy_each_time and part == 0:
                toy.strategy.step_post_backward(**toy.shared, step=step)
        toy.optimize()
        toy.strategy.step_post_backward(**toy.shared, step=step)
    assert_observed(toy.state, gradients[0] + gradients[1])


def fused_adam(tensors, lr):
    return torch.optim.Adam(tensors, lr=lr, fused=True)


@pytest.mark.parametrize("kind", [torch.optim.Adam, fused_adam])
def test_the_scale_of_a_mixed_precision_loss_is_removed_and_skipped_steps_are_not_observed(kind):
    gradients = noise(6, 10)
    toy = Toy(CAdamStrategy(), kind=kind)
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**14, growth_interval=2)
    for step, gradient in enumerate(gradients):
        toy.strategy.step_pre_backward(**toy.shared, step=step)
        overflows = step == 3
        scaler.scale(toy.loss(gradient * (1e38 if overflows else 1.0))).backward()
        for optimizer in toy.optimizers.values():
            scaler.step(optimizer)
            optimizer.zero_grad()
        scaler.update()
        toy.strategy.step_post_backward(**toy.shared, step=step)
    assert scaler.get_scale() != 2.0**14
    assert_observed(toy.state, gradients[[0, 1, 2, 4, 5]], rtol=1e-6, atol=0)


def test_sparse_gradients_are_observed_like_dense_ones():
    gradients = noise(5, 10) * (torch.arange(10) % 3 > 0)[:, None]
    toy = Toy(CAdamStrategy())
    toy.optimizers["means"] = torch.optim.SparseAdam([toy.params["means"]], lr=0.1)
    for step, gradient in enumerate(gradients):
        toy.strategy.step_pre_backward(**toy.shared, step=step)
        toy.loss(gradient).backward()
        means = toy.params["means"]
        seen = gradient.any(dim=-1).nonzero()[:, 0]
        # As gsplat's trainer does it with sparse_grad=True, here for two cameras that see the same Gaussians.
        both = torch.cat([means.grad[seen] / 2, means.grad[seen] / 2])
        indices = torch.cat([seen, seen])[None]
        means.grad = torch.sparse_coo_tensor(indices, both, means.shape, check_invariants=True)
        toy.optimize()
        toy.strategy.step_post_backward(**toy.shared, step=step, packed=True)
    assert_observed(toy.state, gradients)


def test_a_step_of_the_optimizer_that_fails_does_not_end_the_observation(monkeypatch):
    gradients = noise(3, 10)
    toy = Toy(CAdamStrategy())
    monkeypatch.setitem(toy.optimizers["means"].param_groups[0], "lr", None)
    with pytest.raises(TypeError):
        toy.step(0, gradients[0])
    monkeypatch.undo()
    for optimizer in toy.optimizers.values():
        optimizer.zero_grad()
    for step in (1, 2):
        toy.step(step, gradients[step])
    assert_observed(toy.state, gradients)


# Rows and states.


def run(toy: Toy, first: int, last: int) -> None:
    """Do the steps ``[first, last)`` with gradients that depend on the step and the number of Gaussians."""
    for step in range(first, last):
        torch.manual_seed(step)
        toy.step(step, noise(1, len(toy.params["means"]), seed=step)[0])


def test_a_run_that_is_saved_and_loaded_continues_to_the_bit(recwarn):
    whole, saved, loaded = (Toy(CAdamStrategy(**SHORT, **YOUNG), kind=torch.optim.Adam) for _ in range(3))
    run(whole, 0, 18)
    run(saved, 0, 10)
    file = io.BytesIO()
    optimizers = {name: optimizer.state_dict() for name, optimizer in saved.optimizers.items()}
    torch.save({"params": saved.params.state_dict(), "optimizers": optimizers, "state": saved.state}, file)
    file.seek(0)
    payload = torch.load(file, weights_only=True)
    loaded.params = ParameterDict({name: Parameter(rows) for name, rows in payload["params"].items()})
    for name, optimizer in payload["optimizers"].items():
        loaded.optimizers[name] = torch.optim.Adam([loaded.params[name]])
        loaded.optimizers[name].load_state_dict(optimizer)
    loaded.state = payload["state"]
    run(loaded, 10, 18)
    assert not recwarn
    assert len(loaded.params["means"]) == len(whole.params["means"]) != len(saved.params["means"])
    for name in ("m", "v", "age"):
        torch.testing.assert_close(loaded.state[name], whole.state[name], **EXACT)
    for name, rows in whole.params.items():
        torch.testing.assert_close(loaded.params[name], rows, **EXACT)


# The schedule, and the rules that come from gsplat.


def growing(**settings) -> CAdamStrategy:
    """Return a strategy that clones half of the Gaussians at every refinement."""
    always = {"refine_start_iter": 0, "refine_every": 1, "min_age": 0, "tau_Q": 0.5, "tau_SNR": None}
    return CAdamStrategy(**{**always, "reset": "none", "grow_scale3d": 1e9, "prune_scale3d": 1e9, **settings})


def counts(strategy: CAdamStrategy, steps: int = 8) -> list[int]:
    toy = Toy(strategy)
    found = []
    for step in range(steps):
        toy.step(step, noise(1, len(toy.params["means"]), seed=step)[0])
        found.append(len(toy.params["means"]))
    return found


def test_refinements_follow_gsplats_schedule():
    assert counts(growing()) == [10, 15, 22, 33, 49, 73, 109, 163]
    assert counts(growing(refine_every=3)) == [10, 10, 10, 15, 15, 15, 22, 22]
    assert counts(growing(refine_start_iter=4)) == [10, 10, 10, 10, 10, 15, 22, 33]
    assert counts(growing(refine_stop_iter=3)) == [10, 15, 22, 22, 22, 22, 22, 22]
    assert counts(growing(reset_every=4, pause_refine_after_reset=2)) == [10, 10, 15, 22, 22, 22, 33, 49]


def test_growth_stops_at_cap_max_and_the_largest_drifts_grow_last():
    assert counts(growing(cap_max=40)) == [10, 15, 22, 33, 40, 40, 40, 40]
    assert counts(growing(cap_max=5)) == [10] * 8
    toy = Toy(growing(cap_max=12))
    toy.step(0, torch.eye(3).repeat(4, 1)[:10])
    toy.step(1, torch.arange(10.0)[:, None].expand(-1, 3))
    assert torch.equal(toy.params["means"][10:], toy.params["means"][[8, 9]])


def test_faint_gaussians_are_pruned_at_refinements_and_large_ones_after_the_first_reset():
    toy = Toy(growing(tau_Q=0.9, tau_SNR=1e9, reset="none", reset_every=2, prune_scale3d=1.0))
    with torch.no_grad():
        toy.params["opacities"][[1, 2]] = -9.0
        toy.params["scales"][4] = 1.0
    lengths = []
    for step in range(4):
        toy.step(step, torch.ones(len(toy.params["means"]), 3))
        lengths.append(len(toy.params["means"]))
    assert lengths == [10, 8, 8, 7]


@pytest.mark.parametrize("packed", [False, True])
def test_size_on_screen_splits_and_prunes_as_in_gsplat(packed):
    """A Gaussian is split from 0.3 of the image on and pruned from 0.6 on, at steps 2 and 4."""
    limits = {"grow_scale2d": 0.3, "prune_scale2d": 0.6, "refine_scale2d_stop_iter": 5}
    strategy = growing(tau_SNR=1e9, refine_every=2, reset_every=1, **limits)
    toy = Toy(strategy, n=3)
    # Radii in x and y, of two views, of images of 100 x 50 pixels.
    radii = torch.tensor([[[5, 40], [0, 0], [9, 9]], [[0, 0], [5, 5], [70, 20]]])
    info = {"radii": radii, "width": 100, "height": 50}
    if packed:
        views, ids = radii[..., 0].nonzero(as_tuple=True)
        info = {**info, "radii": radii[views, ids], "gaussian_ids": ids.int()}
    for step in range(5):
        shared = {**toy.shared, "info": info if step == 1 else {**info, "radii": info["radii"] * 0}}
        strategy.step_pre_backward(**shared, step=step)
        toy.loss(torch.ones(len(toy.params["means"]), 3)).backward()
        toy.optimize()
        strategy.step_post_backward(**shared, step=step, packed=packed)
    # The first is split. So is the third, but its children are pruned, because they inherit its size on
    # screen. At step 4, sizes from before step 2 no longer count.
    assert sorted(toy.state["age"].tolist()) == [2, 2, 5]


def test_only_unreliable_opacities_are_reset_and_every_shape_of_opacities_works():
    for shape in ((), (1,)):
        strategy = CAdamStrategy(reset_every=4, reset_min_age=0, prune_opa=0.01, tau_SNR=0.5)
        toy = Toy(strategy, opacity_shape=shape)
        before = toy.params["opacities"].detach().clone()
        steady = torch.tensor([1.0, -1.0])
        for step in range(5):
            gradient = torch.ones(10, 3)
            gradient[5:] *= steady[step % 2]  # changes its sign, so it has no drift
            toy.step(step, gradient)
        after = toy.params["opacities"].detach()
        assert torch.equal(after[:5], before[:5])
        assert (after[5:].sigmoid() <= 0.02 + 1e-6).all()


# Mistakes.


def test_the_settings_of_default_strategy_keep_their_names_and_defaults():
    theirs = inspect.signature(DefaultStrategy).parameters
    own = inspect.signature(CAdamStrategy).parameters
    assert {name: own[name].default for name in theirs} == {name: theirs[name].default for name in theirs}
    assert CAdamStrategy().cadam() == replace(CAdamStrategy(refine_every=50).cadam(), reset_min_age=100)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tau_Q": 1.0}, r"^tau_Q: "),
        ({"refine_every": 0}, r"^refine_every: "),
        ({"reset_every": 0}, "^reset_every: "),
        ({"prune_opa": 0.5}, "^prune_opa: "),
    ],
)
def test_a_wrong_setting_is_named(settings, message):
    with pytest.raises(UserError, match=message):
        CAdamStrategy(**settings)


def test_a_trainer_that_resumes_without_the_state_is_warned(recwarn):
    run(Toy(CAdamStrategy(**SHORT, **YOUNG)), 1, 6)
    assert not recwarn
    with pytest.warns(UserWarning, match="starts at step 6 without its saved state"):
        run(Toy(CAdamStrategy(**SHORT, **YOUNG)), 6, 8)


def test_a_trainer_that_steps_other_optimizers_is_stopped_at_the_first_refinement():
    toy = Toy(CAdamStrategy(refine_start_iter=2, refine_every=3))
    copy = torch.optim.SGD([toy.params["means"]], lr=0.0)
    for step in range(4):
        toy.strategy.step_pre_backward(**toy.shared, step=step)
        toy.loss(torch.ones(10, 3)).backward()
        copy.step()
        if step < 3:
            toy.strategy.step_post_backward(**toy.shared, step=step)
    with pytest.raises(UserError, match=r"optimizers: .* in 3 training steps"):
        toy.strategy.step_post_backward(**toy.shared, step=3)


@pytest.mark.gpu
def test_gsplats_rasterization_trains_with_the_strategy():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    from gsplat import rasterization

    torch.manual_seed(0)
    strategy = CAdamStrategy(**SHORT, **YOUNG)
    cameras, device = make_cameras(2, 64, 64), torch.device("cuda")

    def render(params, packed):
        return rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=params["scales"].exp(),
            opacities=params["opacities"].sigmoid(),
            colors=params["colors"],
            viewmats=cameras.world_to_camera.to(device),
            Ks=cameras.intrinsics.to(device),
            width=64,
            height=64,
            sh_degree=0,
            packed=packed,
        )

    for packed in (False, True):
        target, _, _ = render(params_of(make_gaussians(300, seed=2, opacity=2.0)).to(device), packed)
        params = params_of(make_gaussians(400, seed=1)).to(device)
        optimizers = {name: torch.optim.Adam([params[name]], lr=rate) for name, rate in RATES.items()}
        state = strategy.initialize_state()
        for step in range(36):
            images, _, info = render(params, packed)
            strategy.step_pre_backward(params, optimizers, state, step, info)
            (images - target.detach()).abs().mean().backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        assert len(params["means"]) > 400
        assert state["m"].device.type == "cuda"
        assert state["m"].abs().max() > 0
