"""Exporter: writes an asset, or pictures of it, into a folder."""

from abc import ABC, abstractmethod
from pathlib import Path

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn


class Exporter(ABC):
    """Write one kind of file; a subclass is a frozen dataclass of settings."""

    @abstractmethod
    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write into ``folder``, which exists, and return the paths of the files.

        ``render`` shows the same ``gaussians``. Raises ``UserError`` if a file cannot be written.
        """
