"""NoisePath: noisy = a(t) * clean + b(t) * noise, for diffusion and flow models alike.

``t`` runs from 0 (clean) to 1 (noise) on every path. One prediction has three equivalent forms, clean, noise and
velocity (paper eq. 5); a path turns any of them into the other two. Noising, a DDIM step and DDIM inversion are one
call: ``mix(prediction.clean, prediction.noise, t)``.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Prediction:
    """One guess of a model about a noisy image, in its three equivalent forms."""

    clean: Float[Tensor, "v c h w"]  # E[clean | noisy]
    noise: Float[Tensor, "v c h w"]
    velocity: Float[Tensor, "v c h w"]  # see NoisePath.velocity


class NoisePath(ABC):
    """A family of mixtures of a clean image with standard normal noise."""

    @abstractmethod
    def a(self, t: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
        """Share of the clean image, 1 at t = 0."""

    @abstractmethod
    def b(self, t: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
        """Share of the noise, 0 at t = 0."""

    @abstractmethod
    def velocity(
        self, clean: Float[Tensor, "v c h w"], noise: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Float[Tensor, "v c h w"]:
        """The velocity form of a pair: what a velocity-predicting network of this path is trained on."""

    @abstractmethod
    def from_clean(
        self, noisy: Float[Tensor, "v c h w"], clean: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Prediction:
        """Complete a guess of the clean image."""

    @abstractmethod
    def from_noise(
        self, noisy: Float[Tensor, "v c h w"], noise: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Prediction:
        """Complete a guess of the noise."""

    @abstractmethod
    def from_velocity(
        self, noisy: Float[Tensor, "v c h w"], velocity: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Prediction:
        """Complete a guess of the velocity."""

    def gamma(self, t: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
        """Noise-to-signal ratio b / a (paper sec. 3.2); infinite where a is 0."""
        return self.b(t) / self.a(t)

    def mix(
        self, clean: Float[Tensor, "v c h w"], noise: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Float[Tensor, "v c h w"]:
        """The point of the path at ``t``: a(t) * clean + b(t) * noise."""
        return per_view(self.a(t)) * clean + per_view(self.b(t)) * noise


def per_view(values: Float[Tensor, "v"]) -> Float[Tensor, "v 1 1 1"]:
    """Reshape one number per view so that it multiplies images."""
    return torch.reshape(values, (-1, 1, 1, 1))
