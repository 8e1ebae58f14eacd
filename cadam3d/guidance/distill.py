"""Distillation: the part shared by all objectives that subtract two predictions (paper sec. 3.2)."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.checks import AtLeastZero, Positive, one_of
from cadam3d.core.device import upload, upload_together
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.guidance.base import GuidanceOutput
from cadam3d.guidance.window import WindowedGuidance
from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import NoisePath, Prediction, per_view

# w(t) by name. On a DDPM path a = sqrt(abar), b = sqrt(1 - abar); on a flow path a = 1 - sigma, b = sigma.
WEIGHTINGS: dict[str, Callable[[NoisePath, Tensor], Tensor]] = {
    "unit": lambda path, t: torch.ones_like(t),
    "sigma": lambda path, t: path.b(t),
    "one_minus_abar": lambda path, t: path.b(t) ** 2,
    "sqrt_abar_one_minus_abar": lambda path, t: path.a(t) * path.b(t) ** 2,
    "gamma": lambda path, t: path.gamma(t),
}
# Divisor of the sum over all elements, given the shape (v, c, h, w) of the encoded renders.
DIVISORS: dict[str, Callable[[torch.Size], int]] = {
    "mean": lambda shape: shape.numel(),
    "sum_per_view": lambda shape: shape[0],
    "sum": lambda shape: 1,
}
STRENGTH = Chart(
    title="Strength of the guidance",
    caption="Root mean square of the gradient that the objective applies to the encoded renders, before it "
    "is divided by the number of elements. It varies with the noise level that each step draws.",
    curves=(Curve(key="guidance_rms"),),
    log_y=True,
)
RESIDUAL = Chart(
    title="Distance to the prior's clean prediction",
    caption="Root mean square difference between the encoded renders and the clean images that the prior "
    "predicts for them; small if the prior would change little.",
    curves=(Curve(key="residual_rms"),),
)


@dataclass(frozen=True)
class Case:
    """The input of an objective: encoded renders, their noise levels, and the prior."""

    clean: Float[Tensor, "v c h w"]  # the encoded renders, without gradient
    t: Float[Tensor, "v"]
    condition: Condition
    prior: DiffusionPrior
    step: int
    generator: torch.Generator
    # ``t`` on the CPU, where it was drawn; None if ``t`` is there itself.
    drawn: Float[Tensor, "v"] | None = None

    @property
    def host_t(self) -> Float[Tensor, "v"]:
        """Return the noise levels on the CPU, because they may decide how many predictions a step makes."""
        return self.t if self.drawn is None else self.drawn

    def on_device(self, *levels: Float[Tensor, "v"]) -> list[Float[Tensor, "v"]]:
        """Return levels that were computed from :attr:`host_t` on the device of the renders, in one copy."""
        return upload_together(levels, self.clean.device)

    def draw_noise(self) -> Float[Tensor, "v c h w"]:
        """Draw new noise for every view."""
        return standard_normal(self.clean, self.generator)

    def guess(self, noise: Float[Tensor, "v c h w"], scale: float) -> Prediction:
        """Mix the renders with ``noise`` at their levels and return the prior's prediction."""
        noisy = self.prior.noise_path.mix(self.clean, noise, self.t)
        return self.prior.predict(noisy, self.t, self.condition, scale)


@dataclass(frozen=True)
class Comparison:
    """The difference of two predictions, and the clean image that one of them leads to."""

    difference: Float[Tensor, "v c h w"]  # a descent step along it moves the render towards `clean`
    clean: Float[Tensor, "v c h w"]  # the pseudo-target: the prior's prediction of the clean image


@dataclass(frozen=True, kw_only=True)
class Distillation(WindowedGuidance):
    """Turns the difference of two predictions into a loss (paper eq. 4).

    Per element of the encoded render x0,

        G = weight * w(t) * difference,    clamped to +-clip,    loss = ||x0 - stopgrad(x0 - G)||^2 / (2 D),

    so that d loss / d x0 = G / D exactly. The value of the loss is half the squared norm of the guidance
    (divided by D); it is not a distance to the prompt. Gradient descent subtracts G, which moves x0 towards
    the predicted clean image. No network is differentiated. Elements of G that are not finite become 0 and
    are counted in the log.

    The authors' repositories call ``weight`` lambda_guidance. D depends on ``reduction``:

    - ``mean``: v * c * h * w, the number of elements. This is the scale of a photometric mean squared error,
      for which 3DGS chose its densification threshold of 2e-4.
    - ``sum_per_view``: v (GaussianDreamer).
    - ``sum``: 1 (LucidDreamer, FlowDreamer).

    The log holds ``t`` (mean over views), ``guidance_rms`` (of G, clamped, before D), ``residual_rms`` (of x0
    minus the predicted clean image) and ``guidance_nonfinite`` (elements replaced by 0).
    """

    weight: Positive
    weighting: Annotated[str, one_of(WEIGHTINGS)]  # w(t)
    reduction: Annotated[str, one_of(DIVISORS)]
    clip: Positive | Schedule | None

    @abstractmethod
    def compare(self, case: Case) -> Comparison:
        """Return the two predictions, subtracted; this defines the objective. Called without gradient."""

    def __call__(
        self,
        rgb: Float[Tensor, "v h w 3"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> GuidanceOutput:
        """Return the loss of the render ``rgb``, which is in [0, 1] and has a gradient.

        All random numbers come from the CPU ``generator``. Raises ``UserError`` if t_min and t_max
        leave their range at ``step``.
        """
        clean = prior.encode(rgb)
        with torch.no_grad():
            drawn = self.draw_t(clean, step, generator)
            t = upload(drawn, clean.device)
            found = self.compare(Case(clean.detach(), t, condition, prior, step, generator, drawn))
            weights = self.weight * WEIGHTINGS[self.weighting](prior.noise_path, t)
            gradient, nonfinite = finite(per_view(weights) * found.difference)
            if self.clip is not None:
                bound = as_schedule(self.clip)(step)
                gradient = gradient.clamp(-bound, bound)
        return GuidanceOutput(
            loss=surrogate(clean, gradient, DIVISORS[self.reduction](clean.shape)),
            log={
                "t": t.mean(),
                "guidance_rms": rms(gradient),
                "residual_rms": rms(clean.detach() - found.clean),
                "guidance_nonfinite": nonfinite,
            },
        )

    def charts(self) -> tuple[Chart, ...]:
        """Declare charts of ``guidance_rms`` and ``residual_rms``."""
        return (STRENGTH, RESIDUAL)


@dataclass(frozen=True, kw_only=True)
class GuidedDistillation(Distillation):
    """A distillation that predicts the clean image under classifier-free guidance.

    Guidance has the conventional form, negative + scale * (positive - negative).
    """

    scale: AtLeastZero


def surrogate(
    clean: Float[Tensor, "v c h w"], gradient: Float[Tensor, "v c h w"], divisor: int
) -> Float[Tensor, ""]:
    """Return ||x0 - stopgrad(x0 - G)||^2 / (2 * divisor), which has the gradient G / divisor.

    The difference is computed as (x0 - stopgrad(x0)) + G: the first part is exactly 0, whereas x0 - (x0 - G)
    would round a small G away. The sum is never in half precision, where it would overflow.
    """
    wide = clean.to(torch.promote_types(clean.dtype, torch.float32))
    return 0.5 * (wide - wide.detach() + gradient).square().sum() / divisor


def standard_normal(like: Float[Tensor, "v c h w"], generator: torch.Generator) -> Float[Tensor, "v c h w"]:
    """Draw noise with the shape, dtype and device of ``like``; the draws do not depend on device or dtype."""
    noise = torch.randn(like.shape, generator=generator, dtype=torch.float32, device=generator.device)
    return upload(noise.to(like.dtype), like.device)


def offset_normal(
    like: Float[Tensor, "v c h w"], generator: torch.Generator, offset: float
) -> Float[Tensor, "v c h w"]:
    """Draw noise as :func:`standard_normal` does, plus ``offset`` * N(0, 1) per channel for all views."""
    noise = standard_normal(like, generator)
    return noise if offset == 0 else noise + offset * standard_normal(like[:1, :, :1, :1], generator)


def finite(gradient: Tensor) -> tuple[Tensor, Int[Tensor, ""]]:
    """Replace elements of ``gradient`` that are not finite by 0; return the result and their number."""
    replaced = gradient.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    # The difference is 0, infinite or NaN. This is faster than to compare or to test each element.
    return replaced, (gradient - replaced).count_nonzero()


def rms(values: Tensor) -> Float[Tensor, ""]:
    """Return the root mean square of the finite elements, or 0 if there are none."""
    replaced, nonfinite = finite(values)
    return (replaced.square().sum() / (values.numel() - nonfinite).clamp_min(1)).sqrt()
