"""Metric: numbers about a finished asset."""

from abc import ABC, abstractmethod

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, TruthFn


class Metric(ABC):
    """Frozen hyper-parameters."""

    @abstractmethod
    def measure(self, gaussians: Gaussians, render: RenderFn, truth: TruthFn | None) -> dict[str, float]:
        """Named numbers. ``truth`` gives the true images where the prior knows them.

        Without it, a metric that needs them returns nothing.
        """
