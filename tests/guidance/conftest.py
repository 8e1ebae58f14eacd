"""An exact prior for the tests of objectives: the images of a prompt are Gaussian around one image."""

from dataclasses import dataclass, field, replace

import pytest
import torch

from cadam3d.guidance.csd import CSD
from cadam3d.guidance.gcs import GCS
from cadam3d.guidance.ism import ISM
from cadam3d.guidance.sdi import SDI
from cadam3d.guidance.sds import SDS
from cadam3d.guidance.ucm import UCM
from cadam3d.guidance.vfds import VFDS
from cadam3d.prior.base import Condition, DiffusionPrior, PromptEmbedding
from cadam3d.prior.path import DDPM, RectifiedFlow, per_view

SHARED = {"weight": 1.0, "t_min": 0.02, "t_max": 0.98, "shared_t": False, "reduction": "sum"}
# Distillations that predict under classifier-free guidance.
GUIDED = {
    "sds": (SDS, {}),
    "ism": (ISM, {"delta": 0.05, "inversion_stride": 0.2, "initial_noise": 0.0, "noise_offset": 0.0}),
    "vfds": (VFDS, {}),
    "sdi": (
        SDI,
        {
            "inversion_scale": -2.0,
            "inversion_grid": "even",
            "inversion_stride": 0.25,
            "overshoot": 0.03,
            "eta": 0.3,
        },
    ),
    "ucm": (UCM, {"inversion_steps": 3, "inversion_grid": "t", "fresh_noise": 0.0}),
}
# Weighted differences of two predictions.
DISTILLATIONS = GUIDED | {"csd": (CSD, {"empty_share": 0.0})}
OBJECTIVES = DISTILLATIONS | {
    "gcs": (
        GCS,
        {
            "w_cc": 1.0,
            "w_gc": 0.5,
            "w_cp": 0.5,
            "delta": 0.05,
            "fixed_noise": False,
            "noise_offset": 0.0,
        },
    )
}
PATHS = {"ddpm": DDPM(), "flow": RectifiedFlow(), "flow-3": RectifiedFlow(shift=3.0)}


@dataclass(frozen=True)
class Means(Condition):
    """The mean image of each prompt, one per view."""

    positive: torch.Tensor
    negative: torch.Tensor
    empty: torch.Tensor
    empty_spread: float | None = None  # of images without a prompt; None = the prior's own
    spread: float | None = None  # of the images of this condition; None = the prior's own
    negative_spread: float | None = None  # of those of its negative prompt; None = as of its prompt

    def unprompted(self):
        return Means(self.empty, self.empty, self.empty, self.empty_spread, self.empty_spread)


@dataclass(frozen=True)
class MeansEmbedding(PromptEmbedding):
    means: Means

    def at(self, cameras, background):
        return self.means


@dataclass(frozen=True)
class Call:
    """The arguments of one prediction."""

    t: torch.Tensor
    scale: float
    condition: Means
    gradient: bool


@dataclass(frozen=True)
class GaussianPrior(DiffusionPrior):
    """A prior x0 ~ N(mean, spread**2) with a closed-form posterior mean; ``form`` is the predicted form."""

    noise_path: object
    spread: float = 0.5
    form: str = "clean"
    calls: list = field(default_factory=list)

    def embed(self, prompt, negative):
        means = [torch.full((1, 3, 4, 5), float(len(text))) for text in (prompt, negative, "")]
        return MeansEmbedding(Means(*means))

    def encode(self, rgb):
        return rgb.permute(0, 3, 1, 2)

    def decode(self, latents, height, width):
        """Decode without a clamp, so that images may have any range."""
        return latents.permute(0, 2, 3, 1)

    def predict(self, noisy, t, condition, scale):
        self.calls.append(Call(t, scale, condition, torch.is_grad_enabled()))
        with torch.no_grad():
            a, b = per_view(self.noise_path.a(t)), per_view(self.noise_path.b(t))
            spread = self.spread if condition.spread is None else condition.spread
            wide = spread if condition.negative_spread is None else condition.negative_spread
            positive = posterior_means(noisy, a, b, condition.positive, spread)
            negative = posterior_means(noisy, a, b, condition.negative, wide)
            clean, noise = (n + scale * (p - n) for p, n in zip(positive, negative, strict=True))
            if self.form == "clean":
                return self.noise_path.from_clean(noisy, clean, t)
            if self.form == "noise":
                return self.noise_path.from_noise(noisy, noise, t)
            return self.noise_path.from_velocity(noisy, self.noise_path.velocity(clean, noise, t), t)


def posterior_means(noisy, a, b, mean, spread):
    """Return the posterior means of the clean image and of the noise for images around ``mean``."""
    variance = a**2 * spread**2 + b**2
    off = (noisy - a * mean) / torch.where(variance > 0, variance, 1)
    return mean + a * spread**2 * off, b * off


def random_images(count, seed, views=3):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, views, 3, 4, 5, generator=generator, dtype=torch.float64)


@pytest.fixture
def gaussian():
    """The class of the prior."""
    return GaussianPrior


@pytest.fixture
def means():
    """Three views of three prompts: positive, negative, empty."""
    return Means(*random_images(3, seed=5))


@pytest.fixture
def one_image():
    """Means such that every prompt has the same image."""
    (image,) = random_images(1, seed=6)
    return Means(image, image, image)


@pytest.fixture
def one_among_many(one_image):
    """Means such that the prompt determines the image and the empty prompt allows nearly any image."""
    return replace(one_image, empty_spread=1e4)


@pytest.fixture
def rgb():
    """A render, with gradient."""
    (image,) = random_images(1, seed=7)
    return image.permute(0, 2, 3, 1).clone().requires_grad_()


@pytest.fixture
def make():
    """A function that builds an objective by name, with every key set; keywords override keys."""

    def build(name, **keys):
        kind, extra = OBJECTIVES[name]
        scale = {} if name == "csd" else {"scale": 2.0}
        compared = {"weighting": "unit", "clip": None} if name in DISTILLATIONS else {}
        return kind(**SHARED | scale | compared | extra | keys)

    return build


@pytest.fixture
def run():
    """A function that returns G / D, by autograd and in the layout of latents, and the output."""

    def evaluate(guidance, rgb, condition, prior, *, step=0, seed=0):
        leaf = rgb.detach().clone().requires_grad_()
        output = guidance(leaf, condition, prior, step, torch.Generator().manual_seed(seed))
        (gradient,) = torch.autograd.grad(output.loss, leaf)
        return gradient.permute(0, 3, 1, 2), output

    return evaluate


@pytest.fixture(params=PATHS.values(), ids=PATHS.keys())
def path(request):
    return request.param


@pytest.fixture
def prior(path):
    """The prior on every path."""
    return GaussianPrior(path)


@pytest.fixture(params=OBJECTIVES.keys())
def objective(request):
    """Any objective."""
    return request.param


@pytest.fixture(params=DISTILLATIONS.keys())
def distillation(request):
    """An objective that is a weighted difference of two predictions."""
    return request.param


@pytest.fixture(params=GUIDED.keys())
def guided(request):
    """A distillation that predicts under classifier-free guidance."""
    return request.param
