"""ISM: adds noise along the prior's own trajectory instead of at random, and compares two points of it."""

from dataclasses import dataclass
from typing import Annotated

import torch

from cadam3d.core.checks import AtLeastZero, BelowOne, within
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.guidance.distill import Case, Comparison, GuidedDistillation, offset_normal
from cadam3d.guidance.trajectory import UNGUIDED, ddim, strides


@dataclass(frozen=True, kw_only=True)
class ISM(GuidedDistillation):
    """Interval score matching (Liang et al. 2024, LucidDreamer).

    DDIM inversion without a prompt takes the render from t0 to x_s, s = max(t - delta, t0), and one more
    step takes it to x_t. Then

        G = weight * w(t) * (eps_hat(x_t, t, prompt) - eps(x_s, s, no prompt))

    with eps_hat under classifier-free guidance in the conventional form. The published w(t) is
    gamma(t) = b / a: 0.13 at t = 0.02 and 13 at 0.98 on the DDPM path, and infinite on a flow path at t = 1.

    In the paper the inversion starts at t0 = 0 from the render x0 itself. LucidDreamer's code starts at
    t0 = ``initial_noise`` = 0.002 from a x0 + b n, where n is N(0, I) plus ``noise_offset`` * N(0, 1) per
    channel. For t <= t0 + delta the inversion stays there, and for t < ``initial_noise`` t0 = s = t.

    A step makes ceil((s - t0) / inversion_stride) + 1 predictions without guidance and one with it; without
    ``shared_t`` the longest inversion of the batch sets the number.
    """

    delta: Annotated[float | Schedule, within(above=0, high=1)]  # in t
    inversion_stride: Annotated[float, within(above=0, high=1)]  # in t
    initial_noise: BelowOne  # in t
    noise_offset: AtLeastZero

    def compare(self, case: Case) -> Comparison:
        """Subtract the noise at s without a prompt from the guided noise at t, on one trajectory."""
        prior, path, unprompted = case.prior, case.prior.noise_path, case.condition.unprompted()
        start = case.host_t.clamp_max(self.initial_noise)
        s = torch.maximum(case.host_t - as_schedule(self.delta)(case.step), start)
        levels = strides(start, s, self.inversion_stride)
        start, s, *levels = case.on_device(start, s, *levels)
        at_start = case.clean
        if self.initial_noise > 0:
            noise = offset_normal(case.clean, case.generator, self.noise_offset)
            at_start = path.mix(case.clean, noise, start)
        at_s = ddim(at_start, levels, unprompted, prior)
        before = prior.predict(at_s, s, unprompted, UNGUIDED)
        at_t = path.mix(before.clean, before.noise, case.t)
        after = prior.predict(at_t, case.t, case.condition, self.scale)
        return Comparison(difference=after.noise - before.noise, clean=after.clean)
