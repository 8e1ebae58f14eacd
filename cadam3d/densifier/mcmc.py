"""3DGS-MCMC: Gaussians as samples of a Markov chain; the dead move to where there is life, and all tremble.

Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo".
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import softplus

from cadam3d.core.checks import require_range, require_whole
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import Densifier, GradientSignal, Headcount
from cadam3d.densifier.refine import Refine, RefinePlan

# The noise fades with opacity as sigmoid(SHARPNESS * (FAINT - opacity)): half of it is left at FAINT.
SHARPNESS, FAINT = 100.0, 0.005
LOGIT_MAX = (
    14.0  # a sigmoid of 1 - 1e-6; beyond it the sum of equation 9 would cancel more digits than matter
)
ABOVE = 1e-5  # of a logit: who is born at the smallest opacity must not be below it in float32


@dataclass(frozen=True, kw_only=True)
class MCMC(Densifier[Headcount]):
    """Relocation instead of pruning, growth by a fixed share up to a cap, and Langevin noise on the means.

    Dead is whom ``refine`` would prune. Its other keys of "how" (``tau_scale``, ``split_*``) are not used:
    copies share the place of whom they copy until gradients and noise part them. Gradients decide nothing.
    The method wants two regularizers beside it, ``regularizer=[mean_opacity,mean_scale]``.
    """

    cap: int  # no growth beyond so many Gaussians; unlike refine.max_gaussians no end of the run
    growth: float  # share of the Gaussians by which a refinement grows them
    noise_lr: float  # times the learning rate of the means: scale of the noise, in 1 / world units

    def __post_init__(self) -> None:
        require_whole("densifier.cap", self.cap, low=1, example=20_000)
        require_range("densifier.growth", self.growth, low=0, high=1, example=0.05)
        require_range("densifier.noise_lr", self.noise_lr, low=0, example=8000)

    def init_state(self, n: int, device: torch.device) -> Headcount:
        """Nothing to remember."""
        return Headcount.of(n, device)

    def observe(self, state: Headcount, signal: GradientSignal) -> Headcount:
        """The same state: gradients change nothing here."""
        return state

    def select(self, state: Headcount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Nobody is cloned or split; :meth:`plan` has its own way to grow."""
        return state.nobody

    def unreliable(self, state: Headcount) -> Bool[Tensor, "n"]:
        """Nobody's opacity is reset."""
        return state.nobody

    def plan(
        self, state: Headcount, gaussians: Gaussians, step: int, refine: Refine, generator: torch.Generator
    ) -> RefinePlan:
        """Replace the dead by copies of the living, then grow; both drawn in proportion to opacity.

        Whoever is copied becomes newborn as its copies are: its opacity and scales change with theirs, and
        its old moments belong to what it was. The dead vanish without heirs where nobody lives.
        """
        gaussians = gaussians.detach()
        n, living = len(gaussians), refine.keeps(gaussians, step).nonzero()[:, 0]
        dead, crowd = n - len(living), _Crowd.of(gaussians, living)
        if len(living) > 0:
            grown = max(min(self.cap, int((1 + self.growth) * n)), n)
            for births in (dead, grown - n):
                crowd = crowd.multiply(births, refine.min_opacity, generator)
        parents = crowd.rows[crowd.is_new]
        copies = gaussians.index(parents)
        shrink = crowd.log_shrink[crowd.is_new, None]
        children = replace(
            copies,
            opacity_logits=crowd.logits[crowd.is_new].to(copies.opacity_logits),
            log_scales=(copies.log_scales + shrink).to(copies.log_scales),
        )
        edit = RowEdit(keep=crowd.rows[~crowd.is_new], children=children, parents=parents)
        return RefinePlan(
            edit=edit,
            is_selected=state.nobody.index_fill(0, parents, True),
            cloned=edit.rows_after - len(living),
            split=0,
            pruned=dead,
        )

    def perturb(self, gaussians: Gaussians, lr: float, generator: torch.Generator) -> Float[Tensor, "n 3"]:
        """Langevin noise: isotropic, stretched by the covariance of each Gaussian; the opaque get none."""
        means = gaussians.means
        normal = torch.randn(means.shape, generator=generator, dtype=means.dtype).to(means.device)
        along_axes = gaussians.scales.square() * normal  # isotropic along these axes as along any
        strength = self.noise_lr * lr * (SHARPNESS * (FAINT - gaussians.opacities)).sigmoid()
        return strength[:, None] * (gaussians.rotations @ along_axes[..., None])[..., 0]


@dataclass(frozen=True)
class _Crowd:
    """A population in the making: whom each member copies, and how it will differ from that one."""

    rows: Int[Tensor, "m"]  # of the population before; ascending among those who are not new
    logits: Float[Tensor, "m"]  # of opacity, in double precision
    log_shrink: Float[Tensor, "m"]  # added to log-scales
    is_new: Bool[Tensor, "m"]  # a copy, or who was copied

    @classmethod
    def of(cls, gaussians: Gaussians, rows: Int[Tensor, "m"]) -> "_Crowd":
        """Those in ``rows``, unchanged."""
        logits = gaussians.opacity_logits[rows].double()
        return cls(rows, logits, torch.zeros_like(logits), torch.zeros_like(rows, dtype=torch.bool))

    def multiply(self, births: int, min_opacity: float, generator: torch.Generator) -> "_Crowd":
        """The crowd with so many copies more, drawn with replacement in proportion to opacity.

        None of them, and none of who was copied, is fainter than ``min_opacity``: it would die at once.
        """
        floor = math.log(min_opacity / (1 - min_opacity)) + ABOVE if min_opacity > 0 else -math.inf
        chosen = draw(self.logits.sigmoid(), births, generator)
        copies = chosen.bincount(minlength=len(self.rows))
        logits, log_shrink = share(self.logits, copies + 1)
        is_copied = copies > 0
        everybody = torch.cat([torch.arange(len(self.rows), device=chosen.device), chosen])
        return _Crowd(
            rows=self.rows[everybody],
            logits=torch.where(is_copied, logits.clamp_min(floor), self.logits)[everybody],
            log_shrink=(self.log_shrink + torch.where(is_copied, log_shrink, 0.0))[everybody],
            is_new=(self.is_new | is_copied)[everybody],
        )


def draw(weights: Float[Tensor, "m"], count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """So many indices, with replacement, in proportion to ``weights``; for any number of them.

    ``torch.multinomial`` refuses more than 2^24 weights.
    """
    upto = weights.cumsum(dim=0)
    points = torch.rand(count, generator=generator, dtype=torch.float64).to(weights) * upto[-1]
    return torch.searchsorted(upto, points, right=True).clamp_max(len(weights) - 1)


def share(
    logits: Float[Tensor, "m"], among: Int[Tensor, "m"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Opacity logits, and what to add to log-scales, if ``among`` coincident Gaussians stand for one.

    Equation 9 of 3DGS-MCMC. The opacity ``o`` at the centre stays what it was if each has
    ``o' = 1 - (1 - o)^(1/N)``. The scales follow from an equal integral along a line through the centre: that
    of ``1 - (1 - o' g)^N`` for a Gaussian profile ``g`` of width s' is s' times

        sum over k < N of  C(N, k + 1) (-1)^k o'^(k + 1) / sqrt(k + 1)

    (the double sum of the paper, its inner binomials added up), up to a factor that it shares with ``o s``.
    The sum alternates, but loses no more digits than 1 - o has zeros.
    """
    clear = softplus(logits.clamp_max(LOGIT_MAX)) / among  # -log(1 - o')
    opacity = -torch.expm1(-clear)
    term = among * opacity
    total = term.clone()
    for k in range(1, int(among.max())):
        term = -term * opacity * (among - k).clamp_min(0) / (k + 1)
        total += term / math.sqrt(k + 1)
    old = logits.clamp_max(LOGIT_MAX).sigmoid()
    return torch.expm1(clear).log(), (old / total).log()
