"""HOW Gaussians grow and vanish, and at which steps: shared by every densifier (paper sec. 3.1 and 4.4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.checks import require, require_range, require_whole
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians, concatenate


@dataclass(frozen=True)
class RefinePlan:
    """One refinement, decided, not applied: rows after = before + cloned + (children - 1) split - pruned.

    Of :meth:`Refine.plan`, whose ``selected = cloned + split``; a densifier with its own "how" may give one
    parent many copies.
    """

    edit: RowEdit
    is_selected: Bool[Tensor, "n"]  # of those before the edit, who was chosen to have children
    cloned: int  # newborns besides whom they are copies of; each selected parent has one, if it is not split
    split: int  # parents that are replaced by their children
    pruned: int  # survivors and newborns removed

    @property
    def selected(self) -> int:
        """How many were chosen."""
        return int(self.is_selected.sum())


@dataclass(frozen=True, kw_only=True)
class Refine:
    """Clone, split, prune and opacity reset: when, and how. Steps count from 1, lengths in world units."""

    start: int  # refinements happen at multiples of `interval` strictly between `start` and `end`
    end: int
    interval: int  # the paper's K
    tau_scale: float  # longest standard deviation above which a selected Gaussian splits, else it is cloned
    split_children: int
    split_shrink: float  # children's standard deviations are the parent's divided by this
    min_opacity: float  # fainter Gaussians are pruned at every refinement
    max_scale: float | None  # Gaussians with a longer standard deviation are pruned; null = never
    prune_from: int  # `max_scale`, and the densifier's own pruning, only after this step
    reset_interval: int | None  # opacity resets at its multiples in [reset_from, reset_until); null = never
    reset_from: int
    reset_until: int
    reset_value: float  # opacity that a reset lowers to
    prune_grace: int  # steps after a reset in which no Gaussian is pruned for its opacity
    max_gaussians: int | None  # growth beyond this ends the run; null = no limit

    def __post_init__(self) -> None:
        require_whole("refine.start", self.start, low=0, example=100)
        require_whole("refine.end", self.end, low=0, example=450)
        require_whole("refine.interval", self.interval, low=1, example=50)
        require_range("refine.tau_scale", self.tau_scale, above=0, example=0.02)
        require_whole("refine.split_children", self.split_children, low=2, high=16, example=2)
        require_range("refine.split_shrink", self.split_shrink, low=1, example=1.6)
        require_range("refine.min_opacity", self.min_opacity, low=0, below=1, example=0.005)
        if self.max_scale is not None:
            require_range("refine.max_scale", self.max_scale, above=0, example=0.35)
        require_whole("refine.prune_from", self.prune_from, low=0, example=300)
        if self.max_gaussians is not None:
            require_whole("refine.max_gaussians", self.max_gaussians, low=1, example=500_000)
        self._check_reset()

    def _check_reset(self) -> None:
        require_whole("refine.reset_from", self.reset_from, low=0, example=300)
        require_whole("refine.reset_until", self.reset_until, low=0, example=450)
        require_range("refine.reset_value", self.reset_value, above=0, below=1, example=0.01)
        require_whole("refine.prune_grace", self.prune_grace, low=0, example=100)
        if self.reset_interval is None:
            return
        require_whole("refine.reset_interval", self.reset_interval, low=1, example=150)
        require(
            self.min_opacity < self.reset_value or self.prune_grace > 0,
            "refine.min_opacity",
            expected=f"a number below refine.reset_value={self.reset_value:g}, or a grace period: "
            "a reset would delete at the next refinement",
            got=self.min_opacity,
            example="refine.prune_grace=100",
        )
        require(
            self.prune_grace < self.reset_interval,
            "refine.prune_grace",
            expected=f"less than refine.reset_interval={self.reset_interval}, or opacity never prunes again",
            got=self.prune_grace,
            example=f"refine.prune_grace={self.reset_interval // 2}",
        )

    def refines_at(self, step: int) -> bool:
        """Whether the ``step``-th step (1 is the first) ends with a refinement.

        300/900/100 (GaussianDreamer) means 400, 500, ..., 800; 100/3000/100 (LucidDreamer) 200, ..., 2900.
        """
        return self.start < step < self.end and step % self.interval == 0

    def resets_at(self, step: int) -> bool:
        """Whether the ``step``-th step (1 is the first) ends with an opacity reset, after any refinement."""
        if self.reset_interval is None:
            return False
        return self.reset_from <= step < self.reset_until and step % self.reset_interval == 0

    def plan(
        self,
        gaussians: Gaussians,
        selected: Bool[Tensor, "n"],
        step: int,
        generator: torch.Generator,
        unwanted: Bool[Tensor, "n"] | None = None,
    ) -> RefinePlan:
        """Decide one refinement; nothing is changed but ``generator`` (on the CPU; one draw per split child).

        Clones and splits come from the one mask ``selected`` of the population before the edit, so they are
        disjoint. Pruning then judges the grown population, newborns included; ``unwanted`` (none if ``None``)
        names rows of the population before the edit that are pruned too, at the times of ``max_scale``.
        """
        gaussians = gaussians.detach()
        is_split = selected & (gaussians.scales.amax(dim=-1) > self.tau_scale)
        clones, splits = (selected & ~is_split).nonzero()[:, 0], is_split.nonzero()[:, 0]
        children = concatenate([gaussians.index(clones), self._split(gaussians.index(splits), generator)])
        parents = torch.cat([clones, splits.repeat_interleave(self.split_children)])

        keeps, child_keeps = self.keeps(gaussians, step), self.keeps(children, step)
        if unwanted is not None and step > self.prune_from:
            keeps &= ~unwanted
        edit = RowEdit(
            keep=(keeps & ~is_split).nonzero()[:, 0],
            children=children.index(child_keeps),
            parents=parents[child_keeps],
        )
        grown = len(gaussians) - len(splits) + len(children)
        return RefinePlan(
            edit=edit,
            is_selected=selected,
            cloned=len(clones),
            split=len(splits),
            pruned=grown - edit.rows_after,
        )

    def keeps(self, gaussians: Gaussians, step: int) -> Bool[Tensor, "n"]:
        """Who is not pruned. The comparisons ask for health, so a row with NaN is pruned too."""
        keeps = gaussians.means.isfinite().all(dim=-1)
        if not self._spares_faint_at(step):
            keeps &= gaussians.opacities >= self.min_opacity
        if self.max_scale is not None and step > self.prune_from:
            keeps &= gaussians.scales.amax(dim=-1) <= self.max_scale
        return keeps

    def exceeds(self, plan: RefinePlan) -> bool:
        """Whether ``plan`` would leave more than ``max_gaussians``.

        Such a plan must not be applied: the run ends there, with the outcome ``max_gaussians`` and the
        Gaussians it had. Trimming the growth instead would hide that a densifier runs away.
        """
        return self.max_gaussians is not None and plan.edit.rows_after > self.max_gaussians

    def _split(self, parents: Gaussians, generator: torch.Generator) -> Gaussians:
        """``split_children`` smaller Gaussians per parent, at positions drawn from the parent itself."""
        each = parents.map(lambda tensor: tensor.repeat_interleave(self.split_children, dim=0))
        normal = torch.randn(each.means.shape, generator=generator, dtype=each.means.dtype).to(each.device)
        return Gaussians(
            means=each.means + (each.rotations @ (each.scales * normal)[..., None])[..., 0],
            log_scales=(each.scales / self.split_shrink).log(),
            quats=each.quats,
            opacity_logits=each.opacity_logits,
            sh=each.sh,
        )

    def _spares_faint_at(self, step: int) -> bool:
        """Whether a reset lies at most ``prune_grace`` steps back."""
        return any(self.resets_at(earlier) for earlier in range(max(step - self.prune_grace, 1), step))
