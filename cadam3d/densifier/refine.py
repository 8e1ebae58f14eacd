"""HOW Gaussians are added and removed, and when; shared by all densifiers (paper sec. 3.1 and 4.4)."""

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.checks import BelowOne, Count, Declared, Positive, Share, Whole, whole, within
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians, concatenate
from cadam3d.core.schedule import FAR_STEP


@dataclass(frozen=True)
class RefinePlan:
    """One refinement, decided but not applied: rows after = before + cloned + (children - 1) split - pruned.

    In a plan of :meth:`Refine.plan`, the number of selected Gaussians is ``cloned + split``. A densifier with
    its own "how" may give one parent many copies.
    """

    is_selected: Bool[Tensor, "n"]  # rows before the edit that get children
    edit: RowEdit | None = None  # None if no row changes
    # Children that are added beside their parent: one for each selected parent that is not split.
    cloned: int = 0
    split: int = 0  # parents replaced by their children
    pruned: int = 0  # removed survivors and newborns

    @property
    def selected(self) -> int:
        """Return the number of Gaussians that get children."""
        return int(self.is_selected.sum())

    def without(self, rows: Bool[Tensor, "n"] | None) -> "RefinePlan":
        """Return the plan without ``rows`` of the Gaussians before it, and without children of these rows."""
        if rows is None or self.edit is None:
            return self
        edit = RowEdit(
            keep=self.edit.keep[~rows[self.edit.keep]],
            children=self.edit.children.index(~rows[self.edit.parents]),
            parents=self.edit.parents[~rows[self.edit.parents]],
        )
        return replace(self, edit=edit, pruned=self.pruned + self.edit.rows_after - edit.rows_after)


@dataclass(frozen=True, kw_only=True)
class Refine(Declared):
    """When and how Gaussians are cloned, split, pruned and reset.

    Steps count from 1, and lengths are in world units.
    """

    steps: Annotated[int, whole(low=1, high=FAR_STEP)]  # of the run
    start: Whole  # step
    end: Whole  # step
    interval: Count  # steps, the paper's K
    tau_scale: Positive
    split_children: Annotated[int, whole(low=2, high=16)]
    split_shrink: Annotated[float, within(low=1)]
    min_opacity: BelowOne
    max_scale: Positive | None
    min_contribution: Share | None
    last_max_scale: Positive | None
    last_min_alpha: Share | None
    prune_from: Whole  # step
    reset_interval: Count | None  # steps
    reset_from: Whole  # step
    reset_until: Whole  # step
    reset_value: Annotated[float, within(above=0, below=1)]  # opacity
    recovery: Count  # steps
    prune_grace: Whole  # steps
    max_gaussians: Count | None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reset_interval is None:
            return
        is_kept = self.min_opacity < self.reset_value or self.prune_grace > 0
        expected = f"a number below reset_value={self.reset_value:g}, or prune_grace > 0"
        self.expect(is_kept, "min_opacity", expected, self.reset_value / 2)
        is_short = self.prune_grace < self.reset_interval
        self.expect(is_short, "prune_grace", f"less than reset_interval={self.reset_interval}", 0)

    @property
    def refinements(self) -> range:
        """Return the steps of all refinements: multiples of ``interval`` strictly between start and end.

        300/900/100 (GaussianDreamer) means 400, 500, ..., 800; 100/3000/100 (LucidDreamer) 200, ..., 2900.
        """
        return _multiples(self.interval, self.start + 1, min(self.steps, self.end - 1))

    @property
    def resets(self) -> range:
        """Return the steps of all opacity resets, each of which leaves ``recovery`` steps until the end.

        A Gaussian is almost invisible after a reset. Adam moves its logit by about one learning rate per
        step, so the way from 0.01 back to 0.5 takes 92 steps at the usual rate of 0.05 (``reset_value``,
        ``optimizer.opacity_lr``). A reset in the last steps of a run would therefore spoil the result.
        """
        if self.reset_interval is None:
            return range(0)
        last = min(self.steps - self.recovery, self.reset_until - 1)
        return _multiples(self.reset_interval, max(1, self.reset_from), last)

    def refines_at(self, step: int) -> bool:
        """Return whether step number ``step`` (from 1) ends with a refinement."""
        return step in self.refinements

    def prunes_at(self, step: int) -> bool:
        """Return whether step number ``step`` (from 1) ends with the last pruning of the run."""
        return step == self.steps and (self.last_max_scale is not None or self.prunes_ghosts)

    @property
    def prunes_ghosts(self) -> bool:
        """Return whether the last pruning removes ghosts, unless the last step refines.

        In fewer steps than ``recovery``, no Gaussian becomes solid, so all of them would look like ghosts.
        """
        return self.last_min_alpha is not None and self.steps >= self.recovery

    def resets_at(self, step: int) -> bool:
        """Return whether step number ``step`` (from 1) ends with an opacity reset, after any refinement."""
        return step in self.resets

    def plan(
        self,
        gaussians: Gaussians,
        selected: Bool[Tensor, "n"],
        step: int,
        generator: torch.Generator,
        unwanted: Bool[Tensor, "n"] | None = None,
    ) -> RefinePlan:
        """Decide one refinement; only ``generator`` is changed (on the CPU; one draw per split child).

        Clones and splits come from the one mask ``selected`` of the population before the edit, so they are
        disjoint. Pruning then judges the grown population, newborns included. ``unwanted`` marks rows before
        the edit that are pruned too, after the same step as by ``max_scale``; ``None`` marks no row.
        """
        gaussians = gaussians.detach()
        is_split = selected & self.splits(gaussians)
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

    def splits(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians that split if they are selected; the others are cloned."""
        return gaussians.scales.amax(dim=-1) > self.tau_scale

    def keeps(self, gaussians: Gaussians, step: int) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians that are not pruned.

        Every comparison is true for healthy rows only, so a row with NaN is pruned too.
        """
        keeps = gaussians.means.isfinite().all(dim=-1)
        since_last_reset = range(max(step - self.prune_grace, 1), step)
        if not any(self.resets_at(earlier) for earlier in since_last_reset):
            keeps &= gaussians.opacities >= self.min_opacity
        if self.max_scale is not None and step > self.prune_from:
            keeps &= gaussians.scales.amax(dim=-1) <= self.max_scale
        if self.last_max_scale is not None and self.prunes_at(step):
            keeps &= gaussians.scales.amax(dim=-1) <= self.last_max_scale
        return keeps

    def exceeds(self, plan: RefinePlan) -> bool:
        """Return whether ``plan`` would leave more than ``max_gaussians``.

        Such a plan must not be applied: the run ends there, with the outcome ``max_gaussians`` and the
        Gaussians it had. Limiting the growth instead would hide that a densifier grows without bound.
        """
        if self.max_gaussians is None or plan.edit is None:
            return False
        return plan.edit.rows_after > self.max_gaussians

    def _split(self, parents: Gaussians, generator: torch.Generator) -> Gaussians:
        """Return ``split_children`` smaller Gaussians per parent, at positions drawn from the parent."""
        each = parents.map(lambda tensor: tensor.repeat_interleave(self.split_children, dim=0))
        normal = torch.randn(each.means.shape, generator=generator, dtype=each.means.dtype).to(each.device)
        return Gaussians(
            means=each.means + (each.rotations @ (each.scales * normal)[..., None])[..., 0],
            log_scales=(each.scales / self.split_shrink).log(),
            quats=each.quats,
            opacity_logits=each.opacity_logits,
            sh=each.sh,
        )


def _multiples(interval: int, first: int, last: int) -> range:
    """Return the multiples of ``interval`` in ``[first, last]``, without 0."""
    return range(max(1, -(-first // interval)) * interval, last + 1, interval)
