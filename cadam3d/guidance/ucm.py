"""UCM: uses the noise that the prior itself couples with the render, instead of random noise."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import Share, one_of, whole
from cadam3d.guidance.distill import Case, Comparison, GuidedDistillation
from cadam3d.guidance.trajectory import ROW, ddim
from cadam3d.prior.path import NoisePath, per_view


def listed(shares: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return as many levels of FlowDreamer's "original" schedule as there are ``shares``.

    They begin with 0 and end with 1. In between are the entries 1, 2, ... times (1000 // steps - 1) of a list
    of a thousand levels, in which entry i, counted from 0, is at t = (i + 1) / 1000.
    """
    steps = len(shares) - 1
    entries = torch.arange(1, steps, dtype=shares.dtype) * (round(1 / ROW) // steps - 1)
    return torch.cat([shares[:1], (entries + 1) * ROW, shares[-1:]])


# Levels of the inversion, by name: a function from even shares of the way, 0 to 1, to levels in t.
GRIDS: dict[str, Callable[[NoisePath, Tensor], Tensor]] = {
    "sigma": lambda path, shares: path.t_at(shares * path.b(torch.ones_like(shares))),
    "t": lambda path, shares: shares,
    "rows": lambda path, shares: listed(shares),
}


@dataclass(frozen=True, kw_only=True)
class UCM(GuidedDistillation):
    """Unique coupling matching by push-backward (FlowDreamer).

    The prior's own trajectory without a prompt, ``inversion_steps`` Euler steps from t = 0 to t = 1, carries
    the render x0 to x_1. The noise eps* that, mixed with x0, gives x_1 is coupled with x0, and

        G = weight * w(t) * (v_hat(x_t, t, prompt) - v(x0, eps*)),    x_t = a x0 + b eps*,

    with the coupling treated as a constant. On a rectified flow eps* = x_1; on a DDPM path some of x0 is left
    at t = 1, and eps* = (x_1 - a(1) x0) / b(1). Given t and the render, nothing is random unless
    ``fresh_noise`` adds new noise, as FlowDreamer does in combination with Perp-Neg:

        eps* <- (1 - r) eps* + r eps',    r = fresh_noise * b(t),    eps' ~ N(0, I).

    A step makes ``inversion_steps`` predictions without guidance, the first at t = 0, and one with guidance.
    """

    inversion_steps: Annotated[int, whole(low=1, high=1000)]
    inversion_grid: Annotated[str, one_of(GRIDS)]
    fresh_noise: Share

    def compare(self, case: Case) -> Comparison:
        """Subtract the velocity of the coupled pair from the guided velocity."""
        noise = self.couple(case)
        guess = case.guess(noise, self.scale)
        velocity = case.prior.noise_path.velocity(case.clean, noise, case.t)
        return Comparison(difference=guess.velocity - velocity, clean=guess.clean)

    def couple(self, case: Case) -> Float[Tensor, "v c h w"]:
        """Return the noise eps* of every render."""
        path, ends = case.prior.noise_path, torch.ones_like(case.t)
        shares = torch.linspace(0, 1, self.inversion_steps + 1, dtype=torch.float64)
        grid = GRIDS[self.inversion_grid](path, shares).tolist()
        levels = [torch.full_like(case.t, level) for level in grid]
        pushed = ddim(case.clean, levels, case.condition.unprompted(), case.prior)
        noise = path.from_clean(pushed, case.clean, ends).noise
        if self.fresh_noise == 0:
            return noise
        share = per_view(self.fresh_noise * path.b(case.t))
        return (1 - share) * noise + share * case.draw_noise()
