"""NoisePath: noisy = a(t) * clean + b(t) * noise, for diffusion and flow models alike.

``t`` runs from 0 (clean) to 1 (noise) on every path. A prediction has three equivalent forms, clean, noise
and velocity (paper eq. 5), and a path computes the other two from any of them. Adding noise, a DDIM step and
DDIM inversion are the same call: ``mix(prediction.clean, prediction.noise, t)``.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import Count, Declared, Positive, within
from cadam3d.core.device import upload

# Bisections until an interval of length 1 reaches the resolution of double precision.
HALVINGS = 53


# One number per view.
PerView = Float[Tensor, "v"]
# One image per view, in the space that a model denoises in.
Latents = Float[Tensor, "v c h w"]


@dataclass(frozen=True)
class Prediction:
    """A model's prediction for a noisy image, in its three equivalent forms."""

    clean: Latents  # E[clean | noisy]
    noise: Latents
    velocity: Latents  # see NoisePath.velocity


class NoisePath(Declared, ABC):
    """A family of mixtures of a clean image with standard normal noise."""

    @abstractmethod
    def a(self, t: PerView) -> PerView:
        """Return the share of the clean image, which is 1 at t = 0."""

    @abstractmethod
    def b(self, t: PerView) -> PerView:
        """Return the share of the noise, which is 0 at t = 0."""

    @abstractmethod
    def velocity(self, clean: Latents, noise: Latents, t: PerView) -> Latents:
        """Return the velocity of a pair, the training target of networks that predict it on this path."""

    @abstractmethod
    def from_velocity(self, noisy: Latents, velocity: Latents, t: PerView) -> Prediction:
        """Complete a prediction of the velocity; exact at both ends of the path."""

    @abstractmethod
    def timestep(self, t: PerView) -> PerView:
        """Return the input that a network of this path was trained on for ``t``, not rounded."""

    def from_clean(self, noisy: Latents, clean: Latents, t: PerView) -> Prediction:
        """Complete a prediction of the clean image. If b is 0, the noise is undetermined and is set to 0."""
        noise = (noisy - per_view(self.a(t)) * clean) * per_view(_reciprocal_or_zero(self.b(t)))
        return Prediction(clean=clean, noise=noise, velocity=self.velocity(clean, noise, t))

    def from_noise(self, noisy: Latents, noise: Latents, t: PerView) -> Prediction:
        """Complete a prediction of the noise. If a is 0, the image is undetermined and is set to 0."""
        clean = (noisy - per_view(self.b(t)) * noise) * per_view(_reciprocal_or_zero(self.a(t)))
        return Prediction(clean=clean, noise=noise, velocity=self.velocity(clean, noise, t))

    def gamma(self, t: PerView) -> PerView:
        """Return the noise-to-signal ratio b / a (paper sec. 3.2), which is infinite if a is 0."""
        return self.b(t) / self.a(t)

    def t_at(self, b: PerView) -> PerView:
        """Return the ``t`` at which the share of noise is ``b``, by bisection, since b increases with t.

        The result is exactly 0 or 1 at the ends of the path, and for values of ``b`` beyond them.
        """
        low, high = torch.zeros_like(b, dtype=torch.float64), torch.ones_like(b, dtype=torch.float64)
        wanted, most = b.double(), self.b(high)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            is_below = self.b(middle) < wanted
            low, high = torch.where(is_below, middle, low), torch.where(is_below, high, middle)
        t = torch.where(wanted < most, high, 1.0)
        return torch.where(wanted > 0, t, 0.0).to(b.dtype)

    def mix(self, clean: Latents, noise: Latents, t: PerView) -> Latents:
        """Return the point of the path at ``t``: a(t) * clean + b(t) * noise."""
        return per_view(self.a(t)) * clean + per_view(self.b(t)) * noise


def per_view(values: PerView) -> Float[Tensor, "v 1 1 1"]:
    """Reshape one number per view so that it can multiply images."""
    return torch.reshape(values, (-1, 1, 1, 1))


@dataclass(frozen=True, kw_only=True)
class DDPM(NoisePath):
    """The variance-preserving path of Stable Diffusion: a**2 + b**2 = 1, velocity = a * noise - b * clean.

    Betas are linear in their square root ("scaled linear", Rombach et al. 2022). Step k >= 1 of the published
    table is at t = k / ``train_steps`` with a**2 = prod(1 - beta_i, i <= k). At t = 0 the image is exactly
    clean, and between the steps log(a**2) is linear. At t = 1 some signal remains (a = 0.068), as in the
    training of these models. The defaults are constants of the models, not settings.
    """

    train_steps: Count = 1000
    beta_start: Annotated[float, within(above=0, below=1)] = 0.00085
    beta_end: Annotated[float, within(above=0, below=1)] = 0.012

    def __post_init__(self) -> None:
        super().__post_init__()
        self.expect(self.beta_end >= self.beta_start, "beta_end", f"at least beta_start={self.beta_start:g}")

    def a(self, t: PerView) -> PerView:
        """Return sqrt(alpha_bar), which is 1 at t = 0."""
        return torch.exp(0.5 * self._log_alpha_bar(t))

    def b(self, t: PerView) -> PerView:
        """Return sqrt(1 - alpha_bar), which is 0 at t = 0."""
        # expm1 is accurate for small b.
        return torch.expm1(self._log_alpha_bar(t)).abs().sqrt()

    def velocity(self, clean: Latents, noise: Latents, t: PerView) -> Latents:
        """Return a * noise - b * clean (v-prediction; Salimans and Ho 2022)."""
        return per_view(self.a(t)) * noise - per_view(self.b(t)) * clean

    def from_velocity(self, noisy: Latents, velocity: Latents, t: PerView) -> Prediction:
        """Return clean = a * noisy - b * velocity and noise = b * noisy + a * velocity."""
        a, b = per_view(self.a(t)), per_view(self.b(t))
        return Prediction(clean=a * noisy - b * velocity, noise=b * noisy + a * velocity, velocity=velocity)

    def timestep(self, t: PerView) -> PerView:
        """Return the row of the table, counted from 0: k - 1 at t = k / ``train_steps``, and at least 0."""
        return (t * self.train_steps - 1).clamp_min(0)

    def _log_alpha_bar(self, t: PerView) -> PerView:
        table = _log_alpha_bars(self.train_steps, self.beta_start, self.beta_end, t.dtype, t.device)
        position = t.clamp(0, 1) * self.train_steps
        below = position.floor().clamp_max(self.train_steps - 1).long()
        return torch.lerp(table[below], table[below + 1], position - below)


@dataclass(frozen=True, kw_only=True)
class RectifiedFlow(NoisePath):
    """The straight path: noisy = (1 - sigma) * clean + sigma * noise, velocity = noise - clean.

    ``shift`` moves t towards noise: sigma = shift * t / (1 + (shift - 1) * t), as in Stable Diffusion 3 with
    shift 3 (Esser et al. 2024, sec. 5.3.2). A shift of 1 does not change t.
    """

    shift: Positive = 1.0

    def a(self, t: PerView) -> PerView:
        """Return 1 - sigma."""
        # Not computed as 1 - b, so that it is exactly 0 at t = 1 and accurate close to it.
        return (1 - t) / (self.shift * t + (1 - t))

    def b(self, t: PerView) -> PerView:
        """Return sigma."""
        return self.shift * t / (self.shift * t + (1 - t))

    def velocity(self, clean: Latents, noise: Latents, t: PerView) -> Latents:
        """Return noise - clean, which does not depend on ``t``."""
        return noise - clean

    def from_velocity(self, noisy: Latents, velocity: Latents, t: PerView) -> Prediction:
        """Return clean = noisy - sigma * velocity and noise = noisy + (1 - sigma) * velocity."""
        a, b = per_view(self.a(t)), per_view(self.b(t))
        return Prediction(clean=noisy - b * velocity, noise=noisy + a * velocity, velocity=velocity)

    def timestep(self, t: PerView) -> PerView:
        """Return 1000 * sigma, in [0, 1000]."""
        return 1000 * self.b(t)


@dataclass(frozen=True, kw_only=True)
class Rows(NoisePath):
    """Another path at the rows of a table only: every ``t`` counts as the nearest multiple of 1 / ``rows``.

    Networks are trained at these levels. The shares of image and noise are rounded together with the input of
    the network, so the two always belong to the same level.
    """

    path: NoisePath
    rows: int

    def a(self, t: PerView) -> PerView:
        """Return the share of the clean image at the nearest row."""
        return self.path.a(self._at_row(t))

    def b(self, t: PerView) -> PerView:
        """Return the share of the noise at the nearest row."""
        return self.path.b(self._at_row(t))

    def velocity(self, clean: Latents, noise: Latents, t: PerView) -> Latents:
        """Return the velocity of a pair at the nearest row."""
        return self.path.velocity(clean, noise, self._at_row(t))

    def from_velocity(self, noisy: Latents, velocity: Latents, t: PerView) -> Prediction:
        """Complete a prediction of the velocity at the nearest row."""
        return self.path.from_velocity(noisy, velocity, self._at_row(t))

    def timestep(self, t: PerView) -> PerView:
        """Return the input of the network at the nearest row, which is a whole number on a DDPM path."""
        # In double precision, so that the whole number is exact after rounding to float32.
        return self.path.timestep(self._at_row(t.double())).to(t.dtype)

    def t_at(self, b: PerView) -> PerView:
        """Return the ``t`` at which the path between the rows has the share of noise ``b``."""
        return self.path.t_at(b)

    def _at_row(self, t: PerView) -> PerView:
        return (t * self.rows).round() / self.rows


@lru_cache(maxsize=32)
def _log_alpha_bars(
    train_steps: int, beta_start: float, beta_end: float, dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "k"]:
    """Return log(alpha_bar) at k = 0 ... train_steps."""
    betas = np.linspace(beta_start**0.5, beta_end**0.5, train_steps) ** 2
    table = np.concatenate([[0.0], np.cumsum(np.log1p(-betas))])
    # A tensor that is made in torch's inference mode could not be used for training later.
    with torch.inference_mode(False):
        return upload(torch.as_tensor(table).to(dtype), device)


def _reciprocal_or_zero(values: PerView) -> PerView:
    return torch.where(values > 0, 1 / values, 0)
