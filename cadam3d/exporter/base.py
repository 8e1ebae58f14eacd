"""Exporter: writes an asset, or pictures of it, into a folder."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.checks import require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, Subject
from cadam3d.io.frames import UPS


class Exporter(ABC):
    """Write one kind of file; a subclass is a frozen dataclass of settings."""

    @abstractmethod
    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write into ``folder``, which exists, and return the paths of the files.

        ``render`` shows the same ``gaussians``. Raises ``UserError`` if a file cannot be written.
        """

    def compare(self, subjects: Sequence[Subject], folder: Path) -> list[Path]:
        """Write pictures of all ``subjects`` into ``folder``, which exists, and return the paths.

        They are side by side in every picture, seen from the same cameras and with a caption under each.
        Raises ``UserError`` if a file cannot be written, or if this exporter makes no pictures.
        """
        raise UserError("it cannot show several assets side by side. Try: 'exporter=[preview,turntable]'")

    def omission(self, gaussians: Gaussians) -> str | None:
        """Return what of ``gaussians`` the files cannot hold, as a note for the user; None if nothing."""
        return None


@dataclass(frozen=True, kw_only=True)
class AssetExporter(Exporter):
    """Write the object itself as one file, in the axes that the user chooses, without rendering anything."""

    # Node of the configuration, such as "exporter.spz", with which error messages begin.
    node: ClassVar[str]
    file_name: ClassVar[str]

    up: str  # up axis of the file, one of UPS

    def __post_init__(self) -> None:
        require_choice(f"{self.node}.up", self.up, UPS)

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write the file and return its path."""
        path = folder / self.file_name
        self.write(path, gaussians)
        return [path]

    @abstractmethod
    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write ``gaussians`` (in world axes) into ``path``, atomically.

        Raises ``UserError`` if the file cannot be written.
        """
