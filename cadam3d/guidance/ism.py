"""ISM: noise the render along the prior's own trajectory instead of at random; compare neighbours on it."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require_range
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled
from cadam3d.guidance.distill import Comparison, Distillation, standard_normal
from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import per_view

UNGUIDED = 1.0  # both halves of an unprompted condition are empty; at 1 a prior needs only one of them
TIE = 1e-4  # of a stride: 0.6 / 0.2 is three steps, whatever the rounding says


@dataclass(frozen=True, kw_only=True)
class ISM(Distillation):
    """Interval score matching (Liang et al. 2024, LucidDreamer).

    DDIM inversion without a prompt takes x0 to x_s, s = max(t - delta, 0), and one step more to x_t. Then

        G = weight * w(t) * (eps_hat(x_t, t, prompt) - eps(x_s, s, no prompt))

    with eps_hat under classifier-free guidance in the conventional form. The published w(t) is
    gamma(t) = b / a: 0.13 at t = 0.02 and 13 at 0.98 on the DDPM path, and infinite on a flow path at t = 1.

    The prior is asked ceil(s / inversion_stride) + 1 times without guidance and once with it; without
    ``shared_t`` the longest inversion of the batch sets the number. ``initial_noise`` noises the render
    before it is inverted, which LucidDreamer's code does and its paper does not.
    """

    delta: float | Schedule  # length of the interval, in t units; in (0, 1]
    inversion_stride: float  # largest DDIM step on the way to s, in t units; in (0, 1]
    initial_noise: float  # t of the freshly noised image to invert; in [0, 1); 0 = none, as in the paper

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("guidance.inversion_stride", self.inversion_stride, above=0, high=1, example=0.2)
        require_range("guidance.initial_noise", self.initial_noise, low=0, below=1, example=0.0)
        require_scheduled("guidance.delta", self.delta, above=0, high=1, example=0.05)

    def compare(
        self,
        clean: Float[Tensor, "v c h w"],
        t: Float[Tensor, "v"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> Comparison:
        """Guided noise at t minus unprompted noise at s, both on one trajectory."""
        unprompted = condition.unprompted()
        s = (t - self._interval(step)).clamp_min(0)
        start = s.clamp_max(self.initial_noise)
        at_start = clean
        if self.initial_noise > 0:
            at_start = prior.noise_path.mix(clean, standard_normal(clean, generator), start)
        at_s = ddim(at_start, start, s, unprompted, prior, self.inversion_stride)
        before = prior.predict(at_s, s, unprompted, UNGUIDED)
        at_t = prior.noise_path.mix(before.clean, before.noise, t)
        after = prior.predict(at_t, t, condition, self.scale)
        return Comparison(difference=after.noise - before.noise, clean=after.clean)

    def _interval(self, step: int) -> float:
        delta = as_schedule(self.delta)(step)
        require_range("guidance.delta", delta, above=0, high=1, example=0.05)
        return delta


def ddim(
    noisy: Float[Tensor, "v c h w"],
    start: Float[Tensor, "v"],
    end: Float[Tensor, "v"],
    condition: Condition,
    prior: DiffusionPrior,
    stride: float,
) -> Float[Tensor, "v c h w"]:
    """Follow the prior's deterministic trajectory (DDIM, eta = 0) from ``start`` to ``end``, unguided.

    Upwards in t this is inversion, downwards it is sampling. Steps are ``stride`` long, in t units, and the
    last is shorter; a view that has arrived waits for the others. ``noisy`` lies at ``start``, the answer
    at ``end``.
    """
    length = (end - start).abs()
    steps = math.ceil(float(length.max()) / stride - TIE)
    now = start
    for k in range(1, steps + 1):
        guess = prior.predict(noisy, now, condition, UNGUIDED)
        then, now = now, end
        if k < steps:
            now = start + (end - start).sign() * length.clamp_max(k * stride)
        has_arrived = per_view(now) == per_view(then)
        noisy = torch.where(has_arrived, noisy, prior.noise_path.mix(guess.clean, guess.noise, now))
    return noisy
