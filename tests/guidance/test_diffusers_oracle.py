"""The objectives, computed a second time with the schedulers of diffusers and a small function as network.

Times are those of the thousand rows of the schedulers: row k of a DDPM table is t = (k + 1) / 1000.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from cadam3d.guidance.gcs import GCS, Levels
from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import DDPM, RectifiedFlow

pytestmark = pytest.mark.oracle
diffusers = pytest.importorskip("diffusers")

# This network reads a prompt as one number.
PROMPT, NEGATIVE, EMPTY = 1.0, -0.5, 0.25
SCALE = 7.5


def network(noisy, timestep, word):
    """A function that is not linear and differs between pixels, between times and between words."""
    phase = torch.as_tensor(timestep, dtype=noisy.dtype).reshape(-1, 1, 1, 1) / 700 + word
    return torch.tanh(0.6 * noisy.roll(1, -1) + 0.3 * word * noisy.flip(1) + phase.sin()) + 0.2 * noisy


def guided(noisy, timestep, scale=SCALE):
    negative = network(noisy, timestep, NEGATIVE)
    return negative + scale * (network(noisy, timestep, PROMPT) - negative)


@dataclass(frozen=True)
class Words(Condition):
    positive: float = PROMPT
    negative: float = NEGATIVE

    def unprompted(self):
        return Words(EMPTY, EMPTY)


@dataclass(frozen=True)
class NetworkPrior(DiffusionPrior):
    noise_path: object

    def embed(self, prompt, negative):
        pytest.fail("objectives receive a condition and must not embed prompts")

    def encode(self, rgb):
        return rgb.permute(0, 3, 1, 2)

    def decode(self, latents, height, width):
        return (latents.permute(0, 2, 3, 1) + 1) / 2

    def predict(self, noisy, t, condition, scale):
        timestep = self.noise_path.timestep(t)
        negative = network(noisy, timestep, condition.negative)
        output = negative + scale * (network(noisy, timestep, condition.positive) - negative)
        is_flow = self.noise_path == RectifiedFlow(shift=3.0)
        complete = self.noise_path.from_velocity if is_flow else self.noise_path.from_noise
        return complete(noisy, output, t)


@pytest.fixture
def table():
    """The noise table of Stable Diffusion in diffusers, and the scheduler of its inversion."""
    keys = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear", "clip_sample": False}
    return lambda stride: (
        with_stride(diffusers.DDIMScheduler(**keys), stride),
        with_stride(diffusers.DDIMInverseScheduler(**keys, set_alpha_to_one=True), stride),
    )


def with_stride(scheduler, rows):
    scheduler.set_timesteps(1000 // rows)
    return scheduler


def up(inverse, noise, row, sample):
    """Take one step of DDIM inversion that ends at ``row``."""
    return inverse.step(noise, row, sample).prev_sample


def down(ddim, noise, row, sample):
    """Take one step of DDIM that starts at ``row``."""
    return ddim.step(noise, row, sample).prev_sample


def gamma(scheduler, row):
    abar = scheduler.alphas_cumprod[row]
    return ((1 - abar) / abar).sqrt()


@pytest.fixture
def still(make, run, rgb):
    """Return G of an objective at one fixed t, and its noise, drawn after ``skipped`` draws of levels."""

    def evaluate(guidance, path, skipped=1):
        generator = torch.Generator().manual_seed(0)
        for _ in range(skipped):
            torch.rand(3, generator=generator)
        noise = torch.randn(3, 3, 4, 5, generator=generator).double()
        gradient, _ = run(guidance, rgb, Words(), NetworkPrior(path))
        return gradient, noise

    return evaluate


@pytest.fixture
def clean(rgb):
    return rgb.detach().permute(0, 3, 1, 2)


def at(t):
    return {"scale": SCALE, "t_min": t, "t_max": t}


def close(got, expected):
    """Compare with the tolerance of schedulers, which keep their tables in single precision."""
    torch.testing.assert_close(got, expected.to(got), rtol=2e-4, atol=2e-5)


def rows(row):
    return torch.full((3,), row)


def test_sds(make, still, clean, table):
    gradient, noise = still(make("sds", **at(0.4), weighting="one_minus_abar"), DDPM())
    ddim, _ = table(100)
    noisy = ddim.add_noise(clean, noise, rows(399))
    close(gradient, (1 - ddim.alphas_cumprod[399]) * (guided(noisy, rows(399)) - noise))


def test_csd(make, still, clean, table):
    gradient, noise = still(make("csd", t_min=0.4, t_max=0.4), DDPM())
    noisy = table(100)[0].add_noise(clean, noise, rows(399))
    close(gradient, network(noisy, rows(399), PROMPT) - network(noisy, rows(399), NEGATIVE))


def test_ism(make, still, clean, table):
    """Invert to row 599 in strides of 200 rows, with one more stride to row 799."""
    guidance = make("ism", **at(0.8), delta=0.2, inversion_stride=0.2, weighting="gamma", weight=0.1)
    gradient, _ = still(guidance, DDPM())
    ddim, inverse = table(200)
    # The prediction for the clean image is made at row 0.
    noisy, row = clean, 0
    for then in (199, 399, 599):
        noisy, row = up(inverse, network(noisy, rows(row), EMPTY), then, noisy), then
    before = network(noisy, rows(599), EMPTY)
    noisy = up(inverse, before, 799, noisy)
    close(gradient, 0.1 * gamma(ddim, 799) * (guided(noisy, rows(799)) - before))


def test_sdi(make, still, clean, table):
    """Invert under the negated scale, and compare with the image that the scheduler predicts."""
    keys = {"inversion_scale": -SCALE, "inversion_stride": 0.1, "overshoot": 0.0, "eta": 0.0}
    gradient, _ = still(make("sdi", **at(0.3), **keys, weighting="gamma"), DDPM())
    ddim, inverse = table(100)
    noisy, row = clean, 0
    for then in (99, 199, 299):
        noisy, row = up(inverse, guided(noisy, rows(row), -SCALE), then, noisy), then
    guess = ddim.step(guided(noisy, rows(299)), 299, noisy).pred_original_sample
    expected = clean - guess
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))


@pytest.mark.parametrize("weights", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0.5, 0.5)])
def test_gcs(weights, make, still, clean, table, monkeypatch):
    """e, s, t = rows 299, 399, 499; D = B = 3."""
    levels = Levels(*(torch.full((3,), t, dtype=torch.float64) for t in (0.3, 0.4, 0.5)))
    monkeypatch.setattr(GCS, "draw_levels", lambda self, clean, step, generator: levels)
    keys = dict(zip(("w_cc", "w_gc", "w_cp"), weights, strict=True))
    guidance = make("gcs", scale=SCALE, weight=0.1, reduction="sum_per_view", **keys)
    gradient, noise = still(guidance, DDPM(), skipped=0)

    (short, inverse), (long, _) = table(100), table(200)
    e, s, t = 299, 399, 499
    leaf = clean.clone().requires_grad_()

    def asked(x, row, word=EMPTY):
        return network(x.detach(), rows(row), word)

    x_e = short.add_noise(leaf, noise, rows(e))
    x_s = up(inverse, asked(x_e, e), s, x_e)
    x_t = up(inverse, asked(x_s, s), t, x_s)
    by_prompt = guided(x_t.detach(), rows(t))
    y_s, y_e = down(short, by_prompt, t, x_t).detach(), down(long, by_prompt, t, x_t).detach()
    cc = down(long, asked(x_t, t), t, x_t) - down(short, asked(y_s, s), s, y_s).detach()
    now = short.step(asked(x_e, e), e, x_e).pred_original_sample
    wanted = short.step(guided(y_e, rows(e)), e, y_e).pred_original_sample
    # This prior decodes a difference to half of it.
    cp = leaf - (leaf + (wanted - now) / 2).detach()
    loss = sum(w * part.square().sum() for w, part in zip(weights, (cc, now - wanted, cp), strict=True))
    (expected,) = torch.autograd.grad(0.1 * loss / 3, leaf)
    close(gradient, expected)


@pytest.fixture
def flow():
    return diffusers.FlowMatchEulerDiscreteScheduler(shift=3.0)


def test_vfds(make, still, clean, flow):
    """u = 0.4 is the 600th of the 1000 descending levels; the scheduler applies the shift to it."""
    gradient, noise = still(make("vfds", **at(0.4)), RectifiedFlow(shift=3.0))
    timestep = flow.timesteps[600].expand(3)
    noisy = flow.scale_noise(clean, timestep, noise)
    close(gradient, guided(noisy, timestep) - (noise - clean))


@pytest.mark.parametrize(
    ("grid", "sigmas"),
    [
        ("sigma", [0, 1 / 3, 2 / 3]),
        ("t", [0, 0.5, 0.75, 0.9]),
        # Entries 249, 498 and 747 of the thousand levels, in ascending order.
        ("rows", [0, *(3 * row / (1000 + 2 * row) for row in (250, 499, 748))]),
    ],
)
def test_ucm(grid, sigmas, make, still, clean, flow):
    """The scheduler takes its Euler steps upwards, from the image to the noise."""
    keys = {"inversion_grid": grid, "inversion_steps": len(sigmas), "weight": 0.1}
    gradient, _ = still(make("ucm", **at(0.4), **keys), RectifiedFlow(shift=3.0))
    upwards = diffusers.FlowMatchEulerDiscreteScheduler(shift=1.0, invert_sigmas=True)
    upwards.set_timesteps(sigmas=list(1 - np.array(sigmas)))
    noise = clean
    for timestep in upwards.timesteps:
        noise = upwards.step(network(noise, timestep.expand(3), EMPTY), timestep, noise).prev_sample
    timestep = flow.timesteps[600].expand(3)
    noisy = flow.scale_noise(clean, timestep, noise)
    close(gradient, 0.1 * (guided(noisy, timestep) - (noise - clean)))


def test_the_network_depends_on_all_its_arguments(clean):
    """If the network ignored an argument, the other tests of this file would not notice errors in it."""
    base = network(clean, rows(10), PROMPT)
    others = [network(*args) for args in ((clean, rows(200), PROMPT), (clean, rows(10), EMPTY))]
    assert all((other - base).abs().mean() > 0.05 for other in others)
