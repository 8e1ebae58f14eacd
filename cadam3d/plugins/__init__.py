"""CAdam in other trainers: a tracker for any trainer, and a strategy for gsplat (in ``plugins.gsplat``).

Nothing here needs our configuration, our loop or our Gaussians. ``docs/your_trainer.md`` shows how to use it.
"""

from cadam3d.plugins.opacity import reset_opacities
from cadam3d.plugins.tracker import CAdamTracker

__all__ = ["CAdamTracker", "reset_opacities"]
