"""Exporter: writes an asset, or pictures of it, into a folder."""

from abc import ABC, abstractmethod
from pathlib import Path

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn


class Exporter(ABC):
    """Frozen hyper-parameters."""

    @abstractmethod
    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write into ``folder`` (which exists) and return the paths written."""
