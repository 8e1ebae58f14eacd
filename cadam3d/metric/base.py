"""Metric: numbers about a finished asset."""

from abc import ABC, abstractmethod
from pathlib import Path

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, Truth


class Metric(ABC):
    """Interface of all metrics. A subclass is a frozen dataclass of its settings."""

    @abstractmethod
    def measure(
        self, gaussians: Gaussians, render: RenderFn, truth: Truth | None, asset: Path | None
    ) -> dict[str, float]:
        """Return named numbers.

        ``truth`` is the true object if the prior knows it, and ``asset`` is the file with these
        Gaussians if one was written. Numbers that need one of them are left out if it is ``None``.
        """
