"""Laws of the gradient through an autoencoder in 16 bits: it is that of float32, however small it is."""

from dataclasses import replace

import pytest
import torch
from latents import KEYS, normal

from cadam3d.guidance.distill import DIVISORS
from cadam3d.prior.latent import lift_gradient
from cadam3d.prior.path import DDPM
from cadam3d.prior.stable_diffusion import StableDiffusion

REDUCTIONS, ENDS, VIEWS = list(DIVISORS), (0.02, 0.98), 2
# The latents of four views of 512 x 512 pixels, whose number is the largest divisor.
LARGE = torch.Size((4, 4, 64, 64))
# An image for each view, reduction and end.
IMAGES = torch.rand(
    len(ENDS) * len(REDUCTIONS) * VIEWS, 32, 32, 3, generator=torch.Generator().manual_seed(0)
)


@pytest.fixture(scope="module")
def passes(pipelines):
    """Latents and the images that they come from, for each precision: in one batch, and in parts of five."""
    folder, cases = str(pipelines("stable_diffusion")), {}
    for dtype in ("float32", "float16", "bfloat16"):
        whole = StableDiffusion(path=folder, cache_dir=None, **KEYS | {"size": None, "dtype": dtype})
        parts = replace(whole, micro_batch=5)
        vars(parts)["vae"] = whole.vae
        for name, prior in ((dtype, whole), (f"{dtype} in parts", parts)):
            images = IMAGES.clone().requires_grad_()
            cases[name] = (prior.encode(images), images)
    return cases


def test_the_gradient_in_sixteen_bits_is_that_of_float32(objective, make, means, gaussian, passes):
    """All precisions get the same gradient on latents, so only the pass through the encoder differs."""
    latents = passes["float32"][0].detach()
    names = ("positive", "negative", "empty")
    texts = {name: normal(*latents[:VIEWS].shape, seed=seed) for seed, name in enumerate(names)}
    other = {"gcs": {"w_cp": 0.0}, "ism": {"delta": 0.01}}.get(objective, {})

    def on_latents(clean, reduction, t):
        class Encoded(gaussian):
            def encode(self, rgb):
                return leaf

        guidance = make(objective, reduction=reduction, t_min=t, t_max=t, **other)
        leaf, generator = clean.clone().requires_grad_(), torch.Generator().manual_seed(0)
        rgb = clean.new_zeros(VIEWS, 8, 8, 3)
        guidance(rgb, replace(means, **texts), Encoded(DDPM()), 0, generator).loss.backward()
        return leaf.grad * DIVISORS[reduction](clean.shape) / DIVISORS[reduction](LARGE)

    kinds = [(reduction, t) for reduction in REDUCTIONS for t in ENDS]
    wanted = torch.cat([on_latents(x, *kind) for x, kind in zip(latents.split(VIEWS), kinds, strict=True)])
    gradients = {
        name: torch.autograd.grad(*both, wanted, retain_graph=True)[0].flatten(1)
        for name, both in passes.items()
    }
    exact = gradients["float32"]
    for name, found in gradients.items():
        assert (torch.cosine_similarity(found, exact) > 0.999).all(), name
        # bfloat16 has eight bits, so the norm of a single view is further off than its direction.
        tolerance = 0.04 if name.startswith("bfloat16") else 0.01
        torch.testing.assert_close(found.norm(dim=1), exact.norm(dim=1), rtol=tolerance, atol=0)


@pytest.mark.parametrize("size", [1e-25, 1e-7, 1.0, 1e6, 1e30])
def test_a_gradient_of_any_size_passes_float16(size):
    """Each view has its own size, and a view without a gradient keeps that."""
    sizes = size * torch.tensor([1.0, 1e-5, 0.0])[:, None]
    inputs = torch.ones(3, 50, requires_grad=True)
    doubled = inputs * 1
    outputs = (2 * doubled.half()).float()
    lift_gradient(doubled, outputs)
    wanted = sizes * normal(3, 50)
    outputs.backward(wanted)
    torch.testing.assert_close(inputs.grad, 2 * wanted, rtol=1e-3, atol=1e-4 * size * 1e-5)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_gradient_that_is_not_finite_stays_so(bad):
    inputs = torch.ones(1, 2, requires_grad=True)
    doubled = inputs * 1
    outputs = doubled.half().float()
    lift_gradient(doubled, outputs)
    outputs.backward(torch.tensor([[1.0, bad]]))
    assert not inputs.grad[0, 1].isfinite()
