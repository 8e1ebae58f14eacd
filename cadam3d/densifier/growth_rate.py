"""Growth rate: the baseline with a threshold that lets a fixed share of the Gaussians grow.

Proposed for gsplat as ``AdaptiveStrategy`` (nerfstudio-project/gsplat, pull request 941, 2026).
"""

from dataclasses import dataclass
from math import inf

import torch

from cadam3d.core.checks import BelowOne, Count
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.densifier.baseline import BaselineState, ScreenGradients


@dataclass(frozen=True, kw_only=True)
class GrowthRate(ScreenGradients):
    """Select the share ``rate`` of the Gaussians with the largest mean gradient norms, up to a ``cap``.

    Each selected Gaussian adds one, so the count grows by ``rate`` at each refinement, before pruning, and
    the scale of the loss is irrelevant. Of equal norms at the threshold none is selected. Unlike
    ``refine.max_gaussians``, the cap does not end the run. The proposal also prunes the 1 % of the Gaussians
    with the lowest opacity; here pruning is the same for all densifiers (``refine``).
    """

    rate: BelowOne | Schedule  # of the Gaussians, per refinement
    cap: Count  # Gaussians

    def threshold(self, state: BaselineState, step: int) -> float:
        """Return the number just above the largest mean norm that must not grow."""
        norms = self._mean_norms(state)
        n = len(norms)
        if n == 0:
            return inf
        growing = min(int(as_schedule(self.rate)(step) * n), max(self.cap - n, 0))
        left = norms.sort().values[n - 1 - growing]
        return float(torch.nextafter(left, torch.full_like(left, inf)))
