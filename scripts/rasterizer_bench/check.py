"""Check that a backend may be timed: it must agree with the reference and give the same bits every time."""

from collections.abc import Iterator

import torch
from rasterizer_bench.scenes import Scene, make_scene, make_shell
from torch import Tensor

from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cuda_sort import sort, sort_bytes
from cadam3d.rasterizer.driver import Launch, Launcher
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import GSPLAT, OWN, self_test

# Backends that promise the same bits on every run.
PROMISE_BITS = ("cpu", "cuda")
RUNS = 5
# The small scenes. Their size in pixels is not a multiple of a tile.
SPLATS, SIZE, VIEWS = 150, 45, 2
# Splats and pixels of the scene for repeated runs.
REPEATED = {"cpu": (500, 64), "cuda": (100_000, 256)}

# Relative to the largest number of each tensor. A pixel with a larger deviation is on a step of the image
# formation model (see selftest.py), where float32 may decide either way. Such pixels are left out of the
# loss, and there must be few of them.
MOST_IMAGE, MOST_GRADIENT, MOST_OUTLIERS = 1e-4, 2e-3, 0.03


def check(name: str, rasterizer: Rasterizer, device: torch.device) -> list[str]:
    """Return one sentence for each problem of the backend."""
    is_gsplat = name == "gsplat"
    agreement = self_test(rasterizer, device, GSPLAT if is_gsplat else OWN)
    troubles = [] if agreement.holds else [f"self-test: {agreement}"]
    # gsplat caps alpha at another value, so the only other scene for it has no alpha near the cap.
    if is_gsplat:
        return troubles + differences(rasterizer, small_scene(make_shell(SPLATS, 3, device)))
    for kind, gaussians in difficult_scenes(device):
        troubles += [
            f"{kind}: {difference}" for difference in differences(rasterizer, small_scene(gaussians))
        ]
    if name in PROMISE_BITS:
        count, size = REPEATED[device.type]
        troubles += changes(rasterizer, make_scene(make_shell(count, 1, device), size, VIEWS))
    return troubles


def small_scene(gaussians: Gaussians) -> Scene:
    return make_scene(gaussians, SIZE, VIEWS)


def difficult_scenes(device: torch.device) -> Iterator[tuple[str, Gaussians]]:
    """Yield scenes that show mistakes which do not show in an ordinary scene."""

    def shell(means: float = 1.0, log_scale: Tensor | float = 0.0, opacity: float = 0.0) -> Gaussians:
        plain = make_shell(SPLATS, 3, torch.device("cpu")).detach()
        changed = {
            "means": plain.means * means,
            "log_scales": plain.log_scales + log_scale,
            "opacity_logits": plain.opacity_logits + opacity,
        }
        return Gaussians(**plain.tensors() | changed)

    equal = shell().index(torch.arange(SPLATS // 3).repeat(3))
    for kind, gaussians in {
        "needles": shell(log_scale=torch.tensor([2.0, -4.0, -4.0])),
        "flat discs": shell(log_scale=torch.tensor([0.5, 0.5, -9.0])),
        "opaque": shell(opacity=9.0),
        "faint": shell(opacity=-4.0),
        "each fills the screen": shell(log_scale=2.5, opacity=-2.0),
        "smaller than a pixel": shell(log_scale=-4.0, opacity=2.0),
        "around the camera": shell(means=6.0, log_scale=1.0),
        "equal depths": equal,
    }.items():
        yield kind, gaussians.to(device).map(lambda tensor: tensor.requires_grad_())


def differences(rasterizer: Rasterizer, scene: Scene) -> list[str]:
    """Return how the images and the gradients of the parameters differ from the reference in float64."""
    exact = scene.to(torch.device("cpu"), torch.float64)
    want, got = exact.render(ReferenceRasterizer()), scene.render(rasterizer)
    if not all(image.isfinite().all() for image in got):
        return ["an image is not finite"]
    is_off = torch.stack(
        [_deviation(ours.detach().cpu(), theirs.detach()) for ours, theirs in zip(got, want, strict=True)]
    ).amax(dim=0)
    is_off = is_off > MOST_IMAGE
    share = is_off.double().mean().item()
    if share > MOST_OUTLIERS:
        return [f"{share:.1%} of the pixels are wrong"]
    exact.without(is_off).backward(want)
    scene.without(is_off).backward(got)
    troubles = []
    for name, theirs in exact.gaussians.tensors().items():
        ours = scene.gaussians.tensors()[name].grad
        if ours is None or not ours.isfinite().all():
            troubles.append(f"the gradient of {name} is missing or not finite")
            continue
        error = ((ours.cpu() - theirs.grad).abs().max() / theirs.grad.abs().max().clamp_min(1e-20)).item()
        if error > MOST_GRADIENT:
            troubles.append(f"the gradient of {name} is wrong by {error:.1e} of its largest number")
    return troubles


def _deviation(got: Tensor, want: Tensor) -> Tensor:
    """Return the deviation of each pixel, relative to the largest number of the image [v h w]."""
    error = (got - want).abs() / want.abs().max().clamp_min(1e-20)
    return error.amax(dim=-1) if error.ndim == 4 else error


def changes(rasterizer: Rasterizer, scene: Scene) -> list[str]:
    """Return the results that are not the same to the last bit in every run, and in every way to render."""
    first: dict[str, Tensor] = {}
    changed: set[str] = set()
    for _ in range(RUNS):
        scene.zero_grad()
        images = scene.render(rasterizer)
        scene.backward(images)
        numbers = dict(zip(("rgb", "alpha", "depth"), images, strict=True)) | gradients_of(scene)
        scene.zero_grad()
        scene.step(rasterizer)
        ahead = gradients_of(scene)
        first = first or numbers
        changed |= {name for name, tensor in numbers.items() if not torch.equal(tensor, first[name])}
        changed |= {name for name, tensor in ahead.items() if not torch.equal(tensor, first[name])}
    return [f"{name} is not the same in {RUNS} runs" for name in sorted(changed)]


def gradients_of(scene: Scene) -> dict[str, Tensor]:
    """Return the gradients of the parameters, which are not ``None``."""
    return {f"the gradient of {name}": tensor.grad for name, tensor in scene.gaussians.tensors().items()}


def check_long_sort(launcher: Launcher, device: torch.device, keys: int) -> list[str]:
    """Return a problem if the kernels sort ``keys`` random keys differently than torch does."""
    unsorted = make_keys(keys, cuda.DEPTH_BITS - 1, device)
    want, want_order = unsorted.sort(stable=True)
    with launcher.on(device) as launch:
        got, order = sort_keys(launch, unsorted, cuda.DEPTH_BITS)
    is_right = torch.equal(got, want) and torch.equal(order, want_order.int())
    return [] if is_right else [f"{keys} keys are sorted wrongly"]


def make_keys(count: int, bits: int, device: torch.device) -> Tensor:
    """Return random numbers below ``2**bits``, of at most 31 bits."""
    generator = torch.Generator(device).manual_seed(0)
    return torch.randint(0, 2**bits - 1, (count,), dtype=torch.int32, device=device, generator=generator)


def sort_keys(launch: Launch, keys: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Return the keys in the order of their lowest ``bits`` bits, and their old positions."""
    count, order = len(keys), torch.empty_like(keys)
    blocks = [keys.clone(), *(keys.new_empty(n, dtype=torch.uint8) for n in sort_bytes(count, bits))]
    first, *temporary = (block.data_ptr() for block in blocks)
    found = sort(launch, first, order.data_ptr(), count, bits, temporary)
    block = next(block for block in blocks if block.data_ptr() == found)
    return block.view(torch.int32)[:count], order
