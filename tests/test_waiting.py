"""Laws of the host in a step: it waits for the device once, and repeats what did not fit into memory.

The stand-in for a CUDA device is torch's "meta" device. Its tensors have no values, so everything that needs
one on the host raises an exception: ``item()``, ``bool()``, ``tolist()``, ``cpu()``, ``nonzero()``, and masks
as indices.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from composed import composed
from latents import KEYS
from test_trainer import SMALL, Recorder, go, make, same
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from cadam3d.build import build_trainer, component
from cadam3d.core.cameras import turntable
from cadam3d.core.device import read_numbers, upload_together
from cadam3d.core.rendering import RenderOutput
from cadam3d.densifier.baseline import Baseline
from cadam3d.exposure import NoExposure
from cadam3d.prior.mvdream import CHECKED
from cadam3d.prior.prompting import Compass, Discrete, Interpolated, PerpNeg
from cadam3d.prior.sdxl import StableDiffusionXL
from cadam3d.prior.texts import Texts
from cadam3d.rasterizer.base import Rasterizer, absgrad_probe

CPU, META = torch.device("cpu"), torch.device("meta")


@dataclass(frozen=True, kw_only=True)
class Blobs(Rasterizer):
    """Renders something that depends on every tensor, with operations that every device has."""

    def render(self, gaussians, cameras, background, absgrad=False):
        views, size = len(cameras), (cameras.height, cameras.width)
        means2d = gaussians.means[None, :, :2].expand(views, -1, -1) * cameras.intrinsics[:, :1, :1]
        if means2d.requires_grad:
            means2d.retain_grad()
        probe = absgrad_probe(means2d.detach(), absgrad)
        others = [tensor.mean() for tensor in gaussians.tensors().values()]
        level = torch.stack(others).mean() + means2d.mean(dim=(1, 2)) + (0 if probe is None else probe.sum())
        alpha = level.sigmoid()[:, None, None].expand(views, *size)
        rgb = alpha[..., None] + (1 - alpha)[..., None] * background[:, None, None]
        return RenderOutput(
            rgb=rgb, alpha=alpha, depth=alpha, means2d=means2d, radii=means2d[..., 0].detach(), absgrad=probe
        )


# Functions that copy numbers of the host to the device of their result, below the level of dispatch.
COPIES = (torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor)


class Transfers(TorchDispatchMode):
    """Records the copies from the CPU to another device: whether each is asynchronous."""

    def __init__(self) -> None:
        super().__init__()
        self.are_asynchronous: list[bool] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.ops.aten._to_copy.default and args[0].device != kwargs.get("device", args[0].device):
            assert args[0].device.type == "cpu", "a copy from the device is a wait"
            self.are_asynchronous.append(kwargs.get("non_blocking", False))
        elif func is torch.ops.aten.copy_.default and args[0].device != args[1].device:
            self.are_asynchronous.append(kwargs.get("non_blocking", False))
        elif func in (torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default):
            places = {index.device for index in args[1] if index is not None}
            self.are_asynchronous += [False] * (places - {args[0].device} != set())
        return func(*args, **kwargs)


class Copies(TorchFunctionMode):
    """Adds the copies of Python's numbers to those of ``transfers``. Each of them waits."""

    def __init__(self, transfers: Transfers) -> None:
        super().__init__()
        self.transfers = transfers

    def __torch_function__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if func in COPIES and result.device != CPU and not isinstance(args[-1], Tensor):
            self.transfers.are_asynchronous.append(False)
        if func in (Tensor.__getitem__, Tensor.__setitem__) and args[0].device != CPU:
            places = args[1] if isinstance(args[1], tuple) else args[1:2]
            self.transfers.are_asynchronous += [False] * any(isinstance(place, list) for place in places)
        return result


@contextmanager
def watched() -> Iterator[list[bool]]:
    """Yield the list of copies to the device, each with whether it is asynchronous."""
    with Transfers() as transfers, Copies(transfers):
        yield transfers.are_asynchronous


def step_without_values(monkeypatch, lines: Sequence[str]) -> tuple[int, list[bool]]:
    """Do one step on a device without values. Return how often numbers were read, and the copies."""
    has_prior = any(line.startswith("prior=") for line in lines)
    cfg = composed(*(line for line in SMALL if not (has_prior and line.startswith("prior="))), *lines)
    if has_prior:
        # Embedded texts have values. This keeps them for the prior below.
        build_trainer(cfg, CPU).prior.embed(cfg.prompt, cfg.negative_prompt)
    trainer = replace(build_trainer(cfg, META), rasterizer=Blobs())
    state = trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, CPU)
    gaussians = state.gaussians.to(META)
    state.optimizer = trainer.optimizer.start(gaussians)
    state.densifier = trainer.densifier.init_state(len(gaussians), META)
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    trainer.prior.load()
    # The first predictions of MVDream check the noise levels.
    vars(trainer.prior)["checked"] = CHECKED
    readings = []

    def read(numbers, device):
        assert all(number.device == META for number in numbers if isinstance(number, Tensor))
        readings.append(len(numbers))
        # It has not overflowed, nothing is dimmed, and all gradients are finite.
        return [0.0, *[1.0] * (len(numbers) - 1)]

    monkeypatch.setattr("cadam3d.core.rendering.read_numbers", read)
    with watched() as copies:
        trainer.step(state, embedding)
    assert (state.step, state.skipped, state.dimmed) == (1, 0, 0)
    return len(readings), copies


@pytest.mark.parametrize(
    "lines",
    [
        [
            "guidance=sds",
            "densifier=baseline",
            "regularizer=[mean_scale,mean_opacity,outside_ball,alpha_entropy,sparsity,squared_variation]",
        ],
        ["guidance=csd", "densifier=absgrad", "regularizer=[disparity_variation,total_variation]"],
        [
            *("guidance=sdi", "guidance.inversion_stride=0.5", "densifier=random"),
            *("augmentation=lucid", "background=lucid", "camera=progressive"),
        ],
        ["guidance=ucm", "densifier=mcmc", "exposure=beg", "exposure.begin=0"],
        ["guidance=gcs", "densifier=cadam_open", "densifier.invisible=skip", "regularizer=[sparsity]"],
        ["guidance=ism_luciddreamer", "camera=multiview", "views=4", "background=black_or_white"],
        [
            *("guidance=sdi_threestudio", "guidance.inversion_stride=0.5"),
            *("optimizer.clip_norm=0.1", "initializer.sh_degree=3"),
        ],
    ],
    ids=" ".join,
)
def test_a_step_waits_for_the_device_once(lines, monkeypatch):
    readings, copies = step_without_values(monkeypatch, lines)
    assert readings == 1
    assert copies
    assert all(copies), "a copy to the device waits for it"


@pytest.mark.parametrize(
    "work", [Tensor.item, bool, Tensor.tolist, Tensor.cpu, Tensor.nonzero, lambda t: t[t > 0]]
)
def test_the_stand_in_refuses_to_be_waited_for(work):
    # Torch raises the first for operations that have no version without values, and the second for the rest.
    with pytest.raises((NotImplementedError, RuntimeError)):
        work(torch.ones(1, device=META))


@pytest.mark.parametrize(
    "copy",
    [
        lambda there: torch.tensor([1, 2], device=META),
        lambda there: torch.as_tensor([1, 2], device=META),
        lambda there: torch.as_tensor(torch.ones(2), device=META),
        lambda there: there.new_tensor([1, 2]),
        lambda there: torch.ones(2).to(there),
        lambda there: there.copy_(torch.ones(2)),
        lambda there: there[[0, 1]],
        lambda there: there[torch.tensor([0, 1])],
    ],
)
def test_copies_that_wait_are_seen(copy):
    there = torch.ones(2, device=META)
    with watched() as copies:
        copy(there)
    assert copies == [False]


def test_what_the_device_makes_itself_is_no_copy():
    there = torch.ones(2, device=META)
    with watched() as copies:
        torch.full((2,), 0.5, device=META).add_(3)
        there[:1] = 7
        torch.where(there > 0, 1, 2)
        torch.arange(2, device=META)
        torch.tensor([1.0, 2.0])
    assert copies == []


@pytest.mark.parametrize(
    "prompting",
    [
        Discrete(front_deg=45.0, back_deg=45.0, overhead_deg=60.0),
        Compass(below_deg=-10.0, above_deg=35.0),
        Interpolated(),
        PerpNeg(curve="lucid", overhead_deg=None),
        PerpNeg(curve="threestudio", overhead_deg=60.0),
    ],
    ids=repr,
)
def test_the_texts_of_a_view_are_chosen_without_a_wait(prompting):
    cameras = turntable(4, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=8).to(META)
    with watched() as copies:
        prompting.mix(cameras)
    assert copies == []


def test_the_network_of_sdxl_is_called_without_a_wait():
    prior, seen = StableDiffusionXL(path=None, cache_dir=None, **KEYS), {}

    def network(noisy, *_, added_cond_kwargs, **__):
        seen.update(added_cond_kwargs)
        return SimpleNamespace(sample=noisy)

    vars(prior)["network"] = network
    noisy, texts = torch.zeros(2, 4, 8, 8, device=META), Texts(torch.zeros(2, 77, 8, device=META), None)
    cameras = turntable(2, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=64)
    with watched() as copies:
        prior.denoise(noisy, noisy[:, 0, 0, 0], texts, cameras)
    assert copies == []
    assert seen["time_ids"].shape == (2, 6)


def test_a_step_with_networks_waits_for_the_device_once(monkeypatch, tmp_path):
    pytest.importorskip("diffusers")
    lines = ["prior=shapes_mvdream", f"prior.cache_dir={tmp_path}", "camera.size=32"]
    readings, copies = step_without_values(monkeypatch, lines)
    assert readings == 1
    assert all(copies), "a copy to the device waits for it"


# -------------------------------------------------------------------------- overflow


SPARSITY = "regularizer=[sparsity]"


@dataclass(frozen=True, kw_only=True)
class Ahead(Blobs):
    """Has reserved too little memory at some steps, as a CUDA rasterizer may."""

    overflows: frozenset[int]  # numbers of calls, from 0
    calls: list[bool]  # whether each call of render_ahead has overflowed

    def render_ahead(self, gaussians, cameras, background, absgrad=False):
        output = self.render(gaussians, cameras, background, absgrad)
        self.calls.append(len(self.calls) in self.overflows)
        if not self.calls[-1]:
            return replace(output, overflowed=torch.zeros((), dtype=torch.bool))
        return replace(
            output,
            rgb=output.rgb * 0 + background[:, None, None],
            alpha=output.alpha * 0,
            depth=output.depth * 0,
            radii=output.radii * 0,
            overflowed=torch.ones((), dtype=torch.bool),
        )


@pytest.mark.parametrize(
    "lines",
    [
        [
            *("densifier=absgrad", "densifier.tau_pos=1e-9", "regularizer=[mean_scale,sparsity]"),
            *("augmentation=lucid", "camera=progressive", "camera.size=16", "background=lucid"),
        ],
        [
            *("densifier=mcmc", "regularizer=[mean_opacity]"),
            *("exposure=beg", "exposure.begin=0", "exposure.threshold=0.01"),
        ],
        ["guidance=ism", "guidance.shared_t=false", "guidance.inversion_stride=0.5"],
    ],
    ids=" ".join,
)
def test_steps_that_overflow_leave_no_trace(lines, tmp_path):
    payloads, reports = [], []
    for overflows in (frozenset(), frozenset({0, 1, 4, 7})):
        trainer, state = make(lines)
        rasterizer, recorder = Ahead(overflows=overflows, calls=[]), Recorder()
        go(replace(trainer, rasterizer=rasterizer, callbacks=[recorder]), state, tmp_path)
        assert rasterizer.calls == [number in overflows for number in range(8)]
        payloads.append(state.to_payload())
        reports.append(recorder.steps)
    assert same(*payloads)
    assert reports[0] == reports[1]


def test_numbers_of_any_kind_are_read_exactly():
    tensors = [
        torch.tensor(0.1),
        torch.tensor(True),
        torch.tensor(3),
        torch.tensor(1 / 3, dtype=torch.float64),
    ]
    found = read_numbers([2.5, *tensors, torch.tensor(0.1, requires_grad=True), False], CPU)
    assert found == [2.5, float(tensors[0]), 1.0, 3.0, 1 / 3, float(tensors[0]), 0.0]
    assert read_numbers([], CPU) == []
    assert read_numbers([torch.ones(1), torch.ones(1, 1), torch.ones(())], CPU) == [1.0, 1.0, 1.0]


def test_tensors_that_are_sent_together_keep_their_numbers_and_gradients(monkeypatch):
    """Pretend that another device is the CPU."""
    tensors = [torch.rand(2, 3).T, torch.rand(4, requires_grad=True), torch.rand(())]
    with monkeypatch.context() as patch:
        patch.setattr(Tensor, "to", lambda tensor, *_, **__: tensor.clone())
        sent = upload_together(tensors, META)
    assert all(torch.equal(before, after) for before, after in zip(tensors, sent, strict=True))
    sent[1].sum().backward()
    assert torch.equal(tensors[1].grad, torch.ones(4))


def test_tensors_that_are_sent_together_keep_their_dtypes_and_may_be_there_already():
    tensors = [torch.rand(2, 3), torch.arange(4), torch.empty(5, device=META), torch.rand(2).double()]
    sent = upload_together(tensors, META)
    assert sent[2] is tensors[2]
    assert [(each.dtype, each.shape) for each in sent] == [(tensor.dtype, tensor.shape) for tensor in tensors]
    assert all(each.device == META for each in sent)


# -------------------------------------------------------------------------- components of users


@dataclass(frozen=True, kw_only=True)
class InPlace(Baseline):
    """A densifier that changes the gradients that it has read, against its interface."""

    def observe(self, state, signal):
        signal.means.zero_()
        signal.means2d.zero_()
        return super().observe(state, signal)


@pytest.mark.parametrize("penalties", [[], ["regularizer=[mean_opacity]"]])
def test_a_densifier_cannot_change_what_the_optimizer_sees(penalties, tmp_path):
    means = []
    for kind in (Baseline, InPlace):
        trainer, state = make(["densifier=baseline", "refine.start=50", *penalties])
        go(replace(trainer, densifier=kind(**vars(trainer.densifier)), steps=2), state, tmp_path)
        means.append(state.gaussians.means.detach())
    assert torch.equal(*means)


def test_numbers_of_components_may_be_floats_or_have_a_dimension(tmp_path):
    """Components of others return floats, or sums that keep a dimension."""

    class Dims(NoExposure):
        def dimming(self, output, background, step):
            return torch.full((1,), 0.5)

    class Logs(type(make()[0].guidance)):
        def __call__(self, *args):
            output = super().__call__(*args)
            return replace(output, log={**output.log, "mine": 2})

    trainer, state = make()
    recorder = Recorder()
    trainer = replace(
        trainer,
        guidance=Logs(**vars(trainer.guidance)),
        exposure=Dims(),
        regularizers={"size": lambda gaussians, output, step: gaussians.log_scales.exp().mean()[None]},
        callbacks=[recorder],
        steps=2,
    )
    go(trainer, state, tmp_path)
    assert state.dimmed == 2
    report = recorder.steps[0]
    assert report.log["mine"] == 2
    assert all(type(value) is float for value in (report.loss, *report.log.values()))
