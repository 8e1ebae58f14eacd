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

        ``truth`` is the true object if it is known, and ``asset`` is the file with these Gaussians if one was
        written. Numbers that need one of them are left out if it is ``None``. If the asset may face any side,
        ``truth.turned()`` faces as the asset does.
        """

    def measure_start(self, gaussians: Gaussians, render: RenderFn, truth: Truth) -> dict[str, float]:
        """Return named numbers about the Gaussians at the start of the run, as a baseline; {} by default.

        This is called only if the run names a truth. ``render`` shows these Gaussians, and ``truth`` is that
        of :meth:`measure`, with the turn of the asset.
        """
        return {}
