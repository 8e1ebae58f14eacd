"""Laws of GaussianOptimizer: it is Adam, it follows row edits, and it resumes bit for bit."""

import math

import pytest
import torch

from cadam3d import optimizer as optimizer_module
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.schedule import Linear
from cadam3d.optimizer import MOMENTS, PARTS, AdamSettings, GaussianOptimizer, parts_of

RATES = {
    "means_lr": 0.01,
    "sh_dc_lr": 0.02,
    "sh_rest_lr": 0.001,
    "opacity_lr": 0.05,
    "scale_lr": 0.005,
    "quat_lr": 0.003,
}


def settings(**changes) -> AdamSettings:
    constants = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15, "clip_norm": None, "clip_unit": 1.0}
    return AdamSettings(**{**RATES, **constants, **changes})


def gaussians(n: int, seed: int = 0, k: int = 4) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,), "sh": (n, k, 3)}
    return Gaussians(**{name: torch.randn(shapes[name], generator=draw) for name in FIELDS})


def push(optimizer: GaussianOptimizer, seed: int) -> None:
    """Set random gradients on every tensor, as a backward pass would."""
    noise = gaussians(len(optimizer.gaussians), seed=seed, k=optimizer.gaussians.sh.shape[1])
    for name, tensor in optimizer.gaussians.tensors().items():
        tensor.grad = getattr(noise, name)


def transposed(tensor: torch.Tensor) -> torch.Tensor:
    """Return the same numbers with another order in memory."""
    return tensor.transpose(0, -1).contiguous().transpose(0, -1)


def train(optimizer: GaussianOptimizer, steps: range) -> None:
    for step in steps:
        push(optimizer, seed=100 + step)
        optimizer.step(step)


def edit_of(n: int, keep: list[int], parents: list[int]) -> RowEdit:
    return RowEdit(
        keep=torch.tensor(keep), children=gaussians(len(parents), seed=9), parents=torch.tensor(parents)
    )


def as_named(moments: dict) -> dict[str, torch.Tensor]:
    return {f"{kind}/{name}": moments[kind][name].clone() for kind in MOMENTS for name in PARTS}


def test_every_tensor_moves_as_under_the_adam_of_torch():
    start = gaussians(7)
    ours = settings().start(start)
    parts = parts_of(start.map(torch.clone))
    groups = [{"params": [part], "lr": RATES[f"{name}_lr"]} for name, part in parts.items()]
    theirs = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    for step in range(20):
        push(ours, seed=step)
        for part, gradient in zip(parts.values(), parts_of(gaussians(7, seed=step)).values(), strict=True):
            part.grad = gradient
        ours.step(step)
        theirs.step()
    for name, part in parts_of(ours.gaussians.detach()).items():
        torch.testing.assert_close(part, parts[name], rtol=0, atol=1e-6)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("k", [1, 16])
def test_one_kernel_for_each_tensor_moves_as_the_separate_operations(k, device, monkeypatch):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    both = []
    for fused in ((), (device,)):
        monkeypatch.setattr(optimizer_module, "FUSED", fused)
        start = gaussians(200, k=k).to(torch.device(device))
        optimizer = settings(clip_norm=3.0).start(start)
        for step in range(20):
            noise = gaussians(200, seed=step, k=k).to(start.device)
            for name, tensor in optimizer.gaussians.tensors().items():
                # Also gradients that are not contiguous, and a missing one.
                tensor.grad = None if (name, step) == ("quats", 5) else transposed(getattr(noise, name))
            optimizer.step(step)
        both.append(optimizer)
    for name in FIELDS:
        one, other = (getattr(each.gaussians.detach(), name) for each in both)
        torch.testing.assert_close(one, other, rtol=0, atol=2e-6)
    for name, moment in as_named(both[0].state_dict()).items():
        torch.testing.assert_close(as_named(both[1].state_dict())[name], moment, rtol=1e-5, atol=1e-9)


def test_a_missing_gradient_is_the_gradient_zero():
    with_none, with_zero = settings().start(gaussians(4)), settings().start(gaussians(4))
    train(with_none, range(3))
    train(with_zero, range(3))
    with_zero.gaussians.means.grad = torch.zeros(4, 3)
    with_none.step(3)
    with_zero.step(3)
    assert torch.equal(with_none.gaussians.means, with_zero.gaussians.means)
    assert torch.equal(with_none.state_dict()["exp_avg"]["means"], with_zero.state_dict()["exp_avg"]["means"])


def test_rates_follow_their_schedule():
    optimizer = settings(means_lr=Linear(start=1.0, end=0.0, steps=10)).start(gaussians(3))
    moved = []
    for step in (0, 5, 10):
        optimizer.gaussians.means.grad = torch.ones(3, 3)
        before = optimizer.gaussians.means.detach().clone()
        optimizer.step(step)
        moved.append(float((before - optimizer.gaussians.means.detach()).mean()))
    assert moved == pytest.approx([1.0, 0.5, 0.0], abs=1e-5)


def norms(optimizer: GaussianOptimizer) -> dict[str, float]:
    """Return the norm of the gradient that Adam saw at its first step, by part."""
    moments = optimizer.state_dict()["exp_avg"]
    return {name: float(moments[name].norm()) / (1 - 0.9) for name in PARTS}


def test_a_long_gradient_is_shortened_to_the_bound_and_keeps_its_direction():
    clipped, plain = settings(clip_norm=2.0).start(gaussians(20)), settings().start(gaussians(20))
    for optimizer in (clipped, plain):
        push(optimizer, seed=0)
        optimizer.gaussians.opacity_logits.grad *= 0.01  # shorter than the bound
        optimizer.step(0)
    assert norms(plain)["opacity"] < 0.1
    assert norms(clipped)["opacity"] == norms(plain)["opacity"]
    for name in set(PARTS) - {"opacity"}:
        assert norms(plain)[name] > 2.5
        assert norms(clipped)[name] == pytest.approx(2.0, rel=1e-5)
        now, before = (each.state_dict()["exp_avg"][name] for each in (clipped, plain))
        torch.testing.assert_close(now / now.norm(), before / before.norm())


def test_the_bound_follows_its_schedule_as_published():
    bound = settings(clip_norm=Linear(start=2.0, end=8.0, steps=1000))
    bounds = [bound.largest_norm("quat", step) for step in (0, 500, 1000, 4000)]
    assert bounds == pytest.approx([2.0, 5.0, 8.0, 8.0])
    optimizer = bound.start(gaussians(200))
    push(optimizer, seed=0)
    optimizer.step(500)
    assert norms(optimizer)["means"] == pytest.approx(5.0, rel=1e-5)


def test_only_the_gradient_of_positions_depends_on_the_unit_of_length():
    optimizer = settings(clip_norm=2.0, clip_unit=4.0).start(gaussians(200))
    push(optimizer, seed=0)
    optimizer.step(0)
    bounds = {name: 0.5 if name == "means" else 2.0 for name in PARTS}
    assert norms(optimizer) == pytest.approx(bounds, rel=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", FIELDS)
def test_one_bad_gradient_is_noticed(name, bad):
    optimizer = settings().start(gaussians(4))
    push(optimizer, seed=0)
    assert all(extreme.isfinite() for extreme in optimizer.extreme_gradients())
    getattr(optimizer.gaussians, name).grad.view(-1)[-1] = bad
    assert not all(extreme.isfinite() for extreme in optimizer.extreme_gradients())


def test_survivors_keep_values_and_moments_and_newborns_start_at_zero():
    optimizer = settings().start(gaussians(6))
    train(optimizer, range(5))
    values, moments = optimizer.gaussians.detach(), as_named(optimizer.state_dict())
    edit = edit_of(6, keep=[0, 2, 5], parents=[2, 4])
    optimizer.apply(edit)
    assert len(optimizer.gaussians) == 5
    for name, tensor in optimizer.gaussians.tensors().items():
        assert torch.equal(tensor[:3], getattr(values, name)[[0, 2, 5]])
        assert torch.equal(tensor[3:], getattr(edit.children, name))
    for name, rows in as_named(optimizer.state_dict()).items():
        assert torch.equal(rows[:3], moments[name][[0, 2, 5]]), name
        assert not rows[3:].any(), name


def test_a_displacement_moves_the_means_and_changes_no_moment():
    optimizer = settings().start(gaussians(5))
    train(optimizer, range(3))
    before, moments = optimizer.gaussians.map(torch.clone).detach(), as_named(optimizer.state_dict())
    offsets = gaussians(5, seed=7).means
    optimizer.displace(offsets)
    assert torch.equal(optimizer.gaussians.means, before.means + offsets)
    assert all(torch.equal(rows, moments[name]) for name, rows in as_named(optimizer.state_dict()).items())
    assert optimizer.gaussians.means.requires_grad
    twin = settings().start(gaussians(5))
    train(twin, range(4))
    # Adam continues from the displaced means.
    train(optimizer, range(3, 4))
    torch.testing.assert_close(optimizer.gaussians.means, twin.gaussians.means + offsets)


def test_a_reset_never_raises_an_opacity():
    optimizer = settings().start(gaussians(50))
    optimizer.gaussians.opacity_logits.data.uniform_(-8, 3, generator=torch.Generator().manual_seed(0))
    before = optimizer.gaussians.opacities.detach().clone()
    lowered = optimizer.reset_opacity(torch.ones(50, dtype=torch.bool), 0.01)
    after = optimizer.gaussians.opacities.detach()
    torch.testing.assert_close(after, before.clamp_max(0.01), rtol=1e-5, atol=0)
    assert lowered == int((before > 0.01).sum())
    assert 0 < lowered < 50


def test_a_reset_changes_exactly_the_marked_rows_and_only_their_opacity():
    optimizer = settings().start(gaussians(10))
    train(optimizer, range(5))
    values = optimizer.gaussians.detach().map(torch.clone)
    moments = as_named(optimizer.state_dict())
    rows = torch.tensor([True, False] * 5)
    optimizer.reset_opacity(rows, 0.01)
    assert torch.equal(optimizer.gaussians.opacity_logits[~rows], values.opacity_logits[~rows])
    for name in set(FIELDS) - {"opacity_logits"}:
        assert torch.equal(getattr(optimizer.gaussians, name), getattr(values, name))
    for name, now in as_named(optimizer.state_dict()).items():
        expected = moments[name]
        if name.endswith("/opacity"):
            assert not now[rows].any()
            expected = expected.masked_fill(rows, 0.0)
        assert torch.equal(now, expected), name


def test_dimming_multiplies_every_colour_coefficient_and_zeroes_their_moments_only():
    optimizer = settings().start(gaussians(10))
    train(optimizer, range(5))
    leaf = optimizer.gaussians.sh
    values, moments = optimizer.gaussians.detach().map(torch.clone), as_named(optimizer.state_dict())
    optimizer.scale_colors(0.8)
    assert optimizer.gaussians.sh is leaf
    torch.testing.assert_close(leaf.detach(), 0.8 * values.sh)
    for name in set(FIELDS) - {"sh"}:
        assert torch.equal(getattr(optimizer.gaussians, name), getattr(values, name))
    for name, now in as_named(optimizer.state_dict()).items():
        is_color = name.endswith(("/sh_dc", "/sh_rest"))
        assert torch.equal(now, torch.zeros_like(now) if is_color else moments[name]), name
        assert moments[name].any()


def test_resuming_from_disk_is_bit_exact(tmp_path):
    whole = settings().start(gaussians(6))
    train(whole, range(10))
    half = settings().start(gaussians(6))
    train(half, range(4))
    payload = {"gaussians": half.gaussians.detach().tensors(), "optimizer": half.state_dict()}
    torch.save(payload, tmp_path / "half.pt")
    payload = torch.load(tmp_path / "half.pt", weights_only=True)
    resumed = settings().start(Gaussians(**payload["gaussians"]))
    resumed.load_state_dict(payload["optimizer"])
    train(resumed, range(4, 10))
    for name in FIELDS:
        assert torch.equal(getattr(whole.gaussians, name), getattr(resumed.gaussians, name))
    for name, moment in as_named(whole.state_dict()).items():
        assert torch.equal(moment, as_named(resumed.state_dict())[name])
