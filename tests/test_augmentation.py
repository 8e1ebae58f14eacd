"""Laws of the augmentations: the tensors that they change, and the random numbers that they draw."""

import pytest
import torch
from splats import make_gaussians

from cadam3d.augmentation import LucidAugmentation
from cadam3d.core.rendering import RenderOutput


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def lucid(scale_noise: float = 0.0, disparity: float = 0.0, flip: float = 0.0) -> LucidAugmentation:
    return LucidAugmentation(scale_noise=scale_noise, disparity=disparity, flip=flip)


def output(size: int = 6) -> RenderOutput:
    noise = torch.rand(3, size, size, 5, generator=draw())
    return RenderOutput(
        rgb=noise[..., :3],
        alpha=0.9 + 0.1 * noise[..., 3],
        depth=2 + noise[..., 4],
        means2d=torch.zeros(3, 0, 2),
        radii=torch.zeros(3, 0),
    )


@pytest.mark.parametrize("noise", [0.1118, 0.02])
def test_scales_are_multiplied_by_a_factor_around_one(noise):
    gaussians = make_gaussians(20_000)
    factor = lucid(noise).perturb(gaussians, draw()).scales / gaussians.scales
    assert float(factor.mean()) == pytest.approx(1, abs=0.01 * noise)
    assert float(factor.std()) == pytest.approx(noise, rel=0.02)
    apart = torch.corrcoef(factor.T) - torch.eye(3)  # the three axes are drawn apart
    assert apart.abs().max() < 0.03


def test_only_scales_change_and_means_are_the_same_tensor():
    gaussians = make_gaussians(10)
    perturbed = lucid(0.1).perturb(gaussians, draw())
    for name in ("means", "quats", "opacity_logits", "sh"):
        assert perturbed.tensors()[name] is gaussians.tensors()[name]
    assert not torch.equal(perturbed.log_scales, gaussians.log_scales)


def test_a_flip_mirrors_every_view_left_to_right():
    seen = output()
    shown = lucid(flip=1.0).show(seen, draw())
    assert torch.equal(shown, seen.rgb[:, :, torch.arange(5, -1, -1)])


def test_disparity_is_shown_in_grey_for_all_views():
    seen = output()
    shown = lucid(disparity=1.0).show(seen, draw())
    assert torch.equal(shown, seen.disparity()[..., None].repeat(1, 1, 1, 3))


def test_disparity_and_flips_are_independent_with_their_probabilities():
    seen, generator, augmentation = output(), draw(), lucid(disparity=0.2, flip=0.5)
    grey, mirrored = [], []
    mirror = seen.rgb.flip(dims=(2,)), seen.disparity().flip(dims=(2,))
    for _ in range(4000):
        shown = augmentation.show(seen, generator)
        grey.append(torch.equal(shown[..., 0], shown[..., 1]))
        mirrored.append(torch.equal(shown, mirror[0]) or torch.equal(shown[..., 0], mirror[1]))
    assert sum(grey) / 4000 == pytest.approx(0.2, abs=0.02)
    assert sum(mirrored) / 4000 == pytest.approx(0.5, abs=0.03)
    both = sum(a and b for a, b in zip(grey, mirrored, strict=True)) / 4000
    assert both == pytest.approx(0.1, abs=0.02)


def test_gradients_flow_through_the_shown_images():
    for augmentation in (lucid(flip=1.0), lucid(disparity=1.0, flip=1.0)):
        seen = output()
        for image in (seen.rgb, seen.alpha, seen.depth):
            image.requires_grad_()
        shown = augmentation.show(seen, draw())
        (shown * torch.arange(6.0)[:, None]).sum().backward()
        moved = [image.grad is not None and bool(image.grad.any()) for image in (seen.rgb, seen.depth)]
        assert moved == ([True, False] if augmentation.disparity == 0 else [False, True])
    assert seen.depth.grad.isfinite().all()


def test_later_draws_do_not_depend_on_the_number_of_gaussians_or_on_earlier_outcomes():
    """Runs with the same seed must train on the same images, however many Gaussians each has."""
    states = []
    for n, augmentation in ((5, lucid(0.1)), (50, lucid(0.1)), (5, lucid(0.1, 1.0, 1.0))):
        generator = draw()
        augmentation.perturb(make_gaussians(n), generator)
        augmentation.show(output(), generator)
        states.append(generator.get_state())
    assert torch.equal(states[0], states[1])
    assert torch.equal(states[0], states[2])
