"""The control of every saving: the baseline, simplified in mid-run to a given number of Gaussians."""

from dataclasses import dataclass
from typing import Annotated

import torch

from cadam3d.core.checks import Count, Whole, one_of
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.simplify import METHODS, simplification
from cadam3d.densifier.baseline import Baseline, BaselineState
from cadam3d.densifier.refine import Refine, RefinePlan

WITHOUT_RENDERS = tuple(method for method in METHODS if method != "contribution")


@dataclass(frozen=True, kw_only=True)
class BaselineSimplified(Baseline):
    """Grow as the baseline before step ``at``; refinements from then on prune, simplify, and grow nothing.

    The first of them simplifies to ``count`` Gaussians, which the rest of the run trains. A merged Gaussian
    is newborn, so its Adam moments are zero.
    """

    count: Count  # Gaussians
    at: Whole  # step
    simplify: Annotated[str, one_of(WITHOUT_RENDERS)]

    def plan(
        self,
        state: BaselineState,
        gaussians: Gaussians,
        step: int,
        refine: Refine,
        generator: torch.Generator,
    ) -> RefinePlan:
        """Decide one refinement; a Gaussian that is merged into another counts as pruned."""
        if step < self.at:
            return super().plan(state, gaussians, step, refine, generator)
        nothing = torch.zeros_like(state.sightings, dtype=torch.bool)
        pruned = refine.plan(gaussians, nothing, step, generator, self.unwanted(state)).edit
        assert pruned is not None, "a refinement has an edit"
        kept = gaussians.detach().index(pruned.keep)
        edit = pruned
        if len(kept) > self.count:
            change = simplification(kept, self.count, self.simplify)
            edit = RowEdit(pruned.keep[change.keep], change.children, pruned.keep[change.parents])
        return RefinePlan(is_selected=nothing, edit=edit, pruned=len(gaussians) - edit.rows_after)
