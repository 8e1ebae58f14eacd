"""Distillation: what SDS, ISM and VFDS share; they differ in the guesses they subtract (paper sec. 3.2)."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require, require_choice, require_range
from cadam3d.core.schedule import FAR_STEP, Schedule, as_schedule, require_scheduled
from cadam3d.guidance.base import Guidance, GuidanceOutput
from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import NoisePath, per_view

# w(t) by name. On a DDPM path a = sqrt(abar), b = sqrt(1 - abar); on a flow path a = 1 - sigma, b = sigma.
WEIGHTINGS: dict[str, Callable[[NoisePath, Tensor], Tensor]] = {
    "unit": lambda path, t: torch.ones_like(t),
    "sigma": lambda path, t: path.b(t),
    "one_minus_abar": lambda path, t: path.b(t) ** 2,
    "sqrt_abar_one_minus_abar": lambda path, t: path.a(t) * path.b(t) ** 2,
    "gamma": lambda path, t: path.gamma(t),
}
# What the sum over all elements is divided by, given the shape (v, c, h, w) of what the prior denoises.
DIVISORS: dict[str, Callable[[torch.Size], int]] = {
    "mean": lambda shape: shape.numel(),
    "sum_per_view": lambda shape: shape[0],
    "sum": lambda shape: 1,
}


@dataclass(frozen=True)
class Comparison:
    """Two guesses, subtracted."""

    difference: Float[Tensor, "v c h w"]  # descending along it moves the render towards `clean`
    clean: Float[Tensor, "v c h w"]  # the pseudo-target: the prior's guess of the clean image


@dataclass(frozen=True, kw_only=True)
class Distillation(Guidance):
    """Turn the difference of two guesses into a loss (paper eq. 4).

    Per element of the encoded render x0,

        G = weight * w(t) * difference,    clamped to +-clip,    loss = ||x0 - stopgrad(x0 - G)||^2 / (2 D),

    so that d loss / d x0 = G / D exactly, and the value of the loss is half the squared norm of the guidance:
    a size to follow, not a distance to the prompt. Descent subtracts G: it moves x0 towards the clean guess.
    No network is differentiated. Elements of G that are not finite become 0 and are counted in the log.

    D depends on ``reduction``. ``mean``: all elements, v * c * h * w, the scale of a photometric mean squared
    error, for which 3DGS's densification threshold of 2e-4 was made. ``sum_per_view``: v (GaussianDreamer).
    ``sum``: 1 (LucidDreamer, FlowDreamer).

    Log: ``t`` (mean), ``guidance_rms`` (of G, clamped, before D), ``residual_rms`` (of x0 minus the clean
    guess), ``guidance_nonfinite`` (elements replaced by 0).
    """

    scale: float  # classifier-free guidance, conventional: negative + scale * (positive - negative)
    weight: float  # of the objective; the repositories call it lambda_guidance
    weighting: str  # w(t), one of WEIGHTINGS
    t_min: float | Schedule  # in [0, t_max)
    t_max: float | Schedule  # in (t_min, 1]
    shared_t: bool  # one t for all views of a step, or one each
    reduction: str  # one of DIVISORS
    clip: float | Schedule | None  # largest |G| per element; None = off

    def __post_init__(self) -> None:
        require_range("guidance.scale", self.scale, low=0, example=7.5)
        require_range("guidance.weight", self.weight, above=0, example=1.0)
        require_choice("guidance.weighting", self.weighting, list(WEIGHTINGS))
        require_choice("guidance.shared_t", self.shared_t, (True, False))
        require_choice("guidance.reduction", self.reduction, list(DIVISORS))
        require_scheduled("guidance.t_min", self.t_min, example=0.02)
        require_scheduled("guidance.t_max", self.t_max, example=0.98)
        if self.clip is not None:
            require_scheduled("guidance.clip", self.clip, above=0, example="null")
        for step in (0, FAR_STEP):  # the steps between are checked as they come
            self._window(step)

    @abstractmethod
    def compare(
        self,
        clean: Float[Tensor, "v c h w"],
        t: Float[Tensor, "v"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> Comparison:
        """The objective itself; called without gradient, ``clean`` being the encoded render."""

    def __call__(
        self,
        rgb: Float[Tensor, "v h w 3"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> GuidanceOutput:
        """Judge the render ``rgb`` (in [0, 1], with gradient); all draws come from the CPU ``generator``.

        Raises ``UserError`` if a schedule leaves its range at ``step``.
        """
        clean = prior.encode(rgb)
        with torch.no_grad():
            t = self._draw_t(clean, step, generator)
            found = self.compare(clean.detach(), t, condition, prior, step, generator)
            weights = self.weight * WEIGHTINGS[self.weighting](prior.noise_path, t)
            raw = per_view(weights) * found.difference
            is_finite = raw.isfinite()
            gradient = torch.where(is_finite, raw, 0).to(clean.dtype)
            if (bound := self._bound(step)) is not None:
                gradient = gradient.clamp(-bound, bound)
        return GuidanceOutput(
            loss=surrogate(clean, gradient, DIVISORS[self.reduction](clean.shape)),
            log={
                "t": float(t.mean()),
                "guidance_rms": _rms(gradient),
                "residual_rms": _rms(clean.detach() - found.clean),
                "guidance_nonfinite": float((~is_finite).sum()),
            },
        )

    def _draw_t(
        self, clean: Float[Tensor, "v c h w"], step: int, generator: torch.Generator
    ) -> Float[Tensor, "v"]:
        """Uniform in [t_min, t_max), on the device of ``clean`` and never in half precision."""
        low, high = self._window(step)
        views = clean.shape[0]
        uniform = torch.rand(1 if self.shared_t else views, generator=generator, dtype=torch.float32)
        dtype = torch.promote_types(clean.dtype, torch.float32)
        return torch.lerp(
            torch.full((views,), low, dtype=dtype, device=clean.device),
            torch.full((views,), high, dtype=dtype, device=clean.device),
            uniform.to(clean.device, dtype).expand(views),
        )

    def _window(self, step: int) -> tuple[float, float]:
        low, high = as_schedule(self.t_min)(step), as_schedule(self.t_max)(step)
        require(
            0 <= low < high <= 1,
            "guidance.t_max",
            wanted="0 <= t_min < t_max <= 1 at every step",
            got=f"t_min {low:g} and t_max {high:g}",
            example="guidance.t_min=0.02 guidance.t_max=0.98",
        )
        return low, high

    def _bound(self, step: int) -> float | None:
        if self.clip is None:
            return None
        bound = as_schedule(self.clip)(step)
        require_range("guidance.clip", bound, above=0, example="null")
        return bound


def surrogate(
    clean: Float[Tensor, "v c h w"], gradient: Float[Tensor, "v c h w"], divisor: int
) -> Float[Tensor, ""]:
    """||x0 - stopgrad(x0 - G)||^2 / (2 * divisor), whose gradient with respect to x0 is G / divisor.

    The inner bracket is opened: x0 - stopgrad(x0) is exactly 0; x0 - (x0 - G) would round a small G away.
    """
    return 0.5 * (clean - clean.detach() + gradient).square().sum() / divisor


def standard_normal(like: Float[Tensor, "v c h w"], generator: torch.Generator) -> Float[Tensor, "v c h w"]:
    """Noise in the shape, dtype and device of ``like``; the same numbers on any device, in any dtype."""
    noise = torch.randn(like.shape, generator=generator, dtype=torch.float32, device=generator.device)
    return noise.to(like)


def _rms(values: Tensor) -> float:
    """Root mean square over the finite elements; 0 if there are none."""
    finite = values[values.isfinite()]
    return float(finite.square().mean().sqrt()) if finite.numel() else 0.0
