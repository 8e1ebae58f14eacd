"""A Gaussian mixture over images and its denoiser in closed form.

With p(x) = sum_m w_m N(x; mu_m, diag(sigma_m^2)), noisy = a x + b eps and s_m^2 = a^2 sigma_m^2 + b^2, all
per pixel,

    r_m      = softmax_m(log w_m + log N(noisy; a mu_m, s_m^2))                  responsibility of mode m
    E[x]     = sum_m r_m (mu_m + a sigma_m^2 / s_m^2 (noisy - a mu_m))           given noisy
    E[eps]   = sum_m r_m  b / s_m^2 (noisy - a mu_m)                             given noisy

by Bayes' rule for a linear Gaussian observation. Hence noisy = a E[x] + b E[eps] holds exactly, and E[eps] is
-b times the score of the noisy density (Tweedie's formula).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.prior.path import Latents, PerView, per_view

# If a pixel is certain (sigma = 0) and has no noise (b = 0), the posterior is 0 / 0. This variance is too
# small to be visible and gives the limit b -> 0, the nearest mode.
VARIANCE_FLOOR = 1e-12


@dataclass(frozen=True)
class Mixture:
    """One distribution of images per view, in the space that the model denoises in."""

    means: Float[Tensor, "v m c h w"]
    log_weights: Float[Tensor, "m"]
    variance: Float[Tensor, "v k c h w"]  # per pixel; k is m, or 1 if the modes share it

    def denoise(self, noisy: Latents, a: PerView, b: PerView) -> tuple[Latents, Latents]:
        """Return the posterior means of the clean image and of the noise; finite for all a, b in [0, 1]."""
        a, b = per_view(a)[:, None], per_view(b)[:, None]
        total = (a * a * self.variance + b * b).clamp_min(VARIANCE_FLOOR)
        means = self.means
        if means.shape[1] > 1:
            shares = self.log_joint(noisy, a, total).softmax(dim=1).to(noisy.dtype)
            if total.shape[1] > 1:
                away = (noisy[:, None] - a * means) / total
                clean = torch.einsum("vm,vmchw->vchw", shares, means + a * self.variance * away)
                return clean, torch.einsum("vm,vmchw->vchw", shares, b * away)
            means = torch.einsum("vm,vmchw->vchw", shares, means)[:, None]
        away = (noisy[:, None] - a * means) / total
        return (means + a * self.variance * away)[:, 0], (b * away)[:, 0]

    def log_joint(self, noisy: Tensor, a: Tensor, total: Tensor) -> Float[Tensor, "v m"]:
        """Return the log of weight times density for each mode (float64), up to a constant of the image.

        ``a`` has the shape "v 1 1 1 1", and ``total`` is the variance of ``noisy``, "v k c h w".
        """
        away = noisy[:, None] - a * self.means
        distance = (away * away / total).sum(dim=(2, 3, 4), dtype=torch.float64)
        if total.shape[1] > 1:
            distance = distance + total.log().sum(dim=(2, 3, 4), dtype=torch.float64)
        return self.log_weights.double() - 0.5 * distance
