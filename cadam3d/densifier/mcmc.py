"""3DGS-MCMC: Gaussians as samples of a Markov chain; dead ones are moved to live ones, and noise moves all.

Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo".
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import softplus

from cadam3d.core.checks import AtLeastZero, Count, Share
from cadam3d.core.device import upload
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import GradientFree, RowCount
from cadam3d.densifier.refine import Refine, RefinePlan

# The noise fades with opacity as sigmoid(SHARPNESS * (FAINT - opacity)): half of it is left at FAINT.
SHARPNESS, FAINT = 100.0, 0.005
# A sigmoid of 1 - 1e-6. Beyond it the alternating sum of equation 9 would lose too many digits.
LOGIT_MAX = 14.0
# Margin in logits, so that a Gaussian born at the smallest opacity is not below it after rounding to float32.
ABOVE = 1e-5


@dataclass(frozen=True, kw_only=True)
class MCMC(GradientFree):
    """Relocation instead of pruning, growth by a fixed share up to a cap, and Langevin noise on the means.

    A Gaussian is dead if ``refine`` would prune it. The other keys of ``refine`` about "how" (``tau_scale``,
    ``split_*``) are not used: a copy starts at the position of its original, until gradients and noise
    separate them. Gradients decide nothing. The method needs two regularizers,
    ``regularizer=[mean_opacity,mean_scale]``. Unlike ``refine.max_gaussians``, the cap does not end the run.
    """

    cap: Count  # Gaussians
    growth: Share  # per refinement
    noise_lr: AtLeastZero  # 1 / world units

    def select(self, state: RowCount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the empty mask: :meth:`plan` grows in its own way, without clones and splits."""
        return state.no_rows

    def plan(
        self, state: RowCount, gaussians: Gaussians, step: int, refine: Refine, generator: torch.Generator
    ) -> RefinePlan:
        """Replace dead Gaussians by copies of live ones, then grow; both drawn in proportion to opacity.

        A Gaussian that is copied becomes newborn like its copies, because its opacity and scales change with
        theirs and its old moments no longer describe it. If none is alive, the dead ones are removed without
        replacement.
        """
        gaussians = gaussians.detach()
        n, alive = len(gaussians), refine.keeps(gaussians, step).nonzero()[:, 0]
        dead, population = n - len(alive), _Population.of(gaussians, alive)
        if len(alive) > 0:
            grown = max(min(self.cap, int((1 + self.growth) * n)), n)
            for births in (dead, grown - n):
                population = population.multiply(births, refine.min_opacity, generator)
        parents = population.rows[population.is_new]
        copies = gaussians.index(parents)
        shrink = population.log_shrink[population.is_new, None]
        children = replace(
            copies,
            opacity_logits=population.logits[population.is_new].to(copies.opacity_logits),
            log_scales=(copies.log_scales + shrink).to(copies.log_scales),
        )
        edit = RowEdit(keep=population.rows[~population.is_new], children=children, parents=parents)
        return RefinePlan(
            edit=edit,
            is_selected=state.no_rows.index_fill(0, parents, True),
            cloned=edit.rows_after - len(alive),
            split=0,
            pruned=dead,
        )

    def perturb(self, gaussians: Gaussians, lr: float, generator: torch.Generator) -> Float[Tensor, "n 3"]:
        """Return Langevin noise, stretched by each covariance and almost zero for opaque Gaussians."""
        means = gaussians.means
        normal = upload(torch.randn(means.shape, generator=generator, dtype=means.dtype), means.device)
        # Isotropic noise has the same distribution along the axes of each Gaussian, so it needs no rotation
        # first.
        along_axes = gaussians.scales.square() * normal
        strength = self.noise_lr * lr * (SHARPNESS * (FAINT - gaussians.opacities)).sigmoid()
        return strength[:, None] * (gaussians.rotations @ along_axes[..., None])[..., 0]


@dataclass(frozen=True)
class _Population:
    """A population under construction: which row each member copies, and how it differs from that row."""

    # Row numbers before the edit, ascending among members that are not new.
    rows: Int[Tensor, "m"]
    logits: Float[Tensor, "m"]  # of opacity, in double precision
    log_shrink: Float[Tensor, "m"]  # added to log-scales
    is_new: Bool[Tensor, "m"]  # copies, and the Gaussians that were copied

    @classmethod
    def of(cls, gaussians: Gaussians, rows: Int[Tensor, "m"]) -> "_Population":
        """Return the Gaussians in ``rows``, unchanged."""
        logits = gaussians.opacity_logits[rows].double()
        return cls(rows, logits, torch.zeros_like(logits), torch.zeros_like(rows, dtype=torch.bool))

    def multiply(self, births: int, min_opacity: float, generator: torch.Generator) -> "_Population":
        """Return the population with ``births`` more copies, drawn with replacement in proportion to opacity.

        Copies and copied Gaussians have at least the opacity ``min_opacity``; otherwise the next refinement
        would remove them.
        """
        floor = math.log(min_opacity / (1 - min_opacity)) + ABOVE if min_opacity > 0 else -math.inf
        chosen = draw(self.logits.sigmoid(), births, generator)
        copies = chosen.bincount(minlength=len(self.rows))
        logits, log_shrink = share(self.logits, copies + 1)
        is_copied = copies > 0
        members = torch.cat([torch.arange(len(self.rows), device=chosen.device), chosen])
        return _Population(
            rows=self.rows[members],
            logits=torch.where(is_copied, logits.clamp_min(floor), self.logits)[members],
            log_shrink=(self.log_shrink + torch.where(is_copied, log_shrink, 0.0))[members],
            is_new=(self.is_new | is_copied)[members],
        )


def draw(weights: Float[Tensor, "m"], count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Draw ``count`` indices with replacement, in proportion to any number of ``weights``.

    ``torch.multinomial`` refuses more than 2^24 weights.
    """
    upto = weights.cumsum(dim=0)
    points = torch.rand(count, generator=generator, dtype=torch.float64).to(weights) * upto[-1]
    return torch.searchsorted(upto, points, right=True).clamp_max(len(weights) - 1)


def share(
    logits: Float[Tensor, "m"], among: Int[Tensor, "m"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Return opacity logits, and what to add to log-scales, if ``among`` coincident Gaussians replace one.

    Equation 9 of 3DGS-MCMC. The opacity ``o`` at the centre stays the same if each has
    ``o' = 1 - (1 - o)^(1/N)``. The scales follow from an equal integral along a line through the centre: that
    of ``1 - (1 - o' g)^N`` for a Gaussian profile ``g`` of width s' is s' times

        sum over k < N of  C(N, k + 1) (-1)^k o'^(k + 1) / sqrt(k + 1)

    up to a factor that it shares with ``o s``. This is the double sum of the paper with its inner binomials
    added up. The signs of its terms alternate, but it loses no more digits than 1 - o has leading zeros.
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
