"""Exporter: writes an asset, or pictures of it, into a folder."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cadam3d.core.checks import Declared, one_of, require_extra
from cadam3d.core.contribution import RenderWithGradient
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderFn, Subject
from cadam3d.core.simplify import Simplify
from cadam3d.io.frames import UPS
from cadam3d.io.gaussforge import EXTRA


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The contents of a file that holds the asset itself. A number is None if it means nothing there."""

    words: str  # for the user, such as "6 Gaussians"
    up: str | None = None  # up axis of the file, one of UPS
    gaussians: int | None = None
    sh_degree: int | None = None
    triangles: int | None = None


class Exporter(Declared, ABC):
    """Write one kind of file; a subclass is a frozen dataclass of settings.

    The class variables say what the rest of the program has to know about the kind of file.
    """

    # Names of the one file that it writes, the usual one first; () if it writes several at once.
    # ``output=NAME.SUFFIX`` chooses an exporter by the suffixes, which begin at the first dot of these names.
    files: ClassVar[tuple[str, ...]] = ()
    # The setting that chooses between ``files``: the suffix without its dot. "" if there is only one file.
    suffix_setting: ClassVar[str] = ""
    # Whether ``output=`` chooses another exporter instead if both write files with the suffix.
    yields: ClassVar[bool] = False
    # Largest SH degree that the format can hold.
    max_degree: ClassVar[int | None] = None
    # What the format rounds or leaves out, and what in addition if the SH degree is above 0; "" for nothing.
    loss: ClassVar[str] = ""
    sh_loss: ClassVar[str] = ""
    # What else to know about the file.
    hint: ClassVar[str] = ""

    @abstractmethod
    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write into ``folder``, which exists, and return the paths of the files.

        ``render`` shows the same ``gaussians``. Raises ``UserError`` if a file cannot be written.
        """

    def simplified(self, gaussians: Gaussians, render: RenderWithGradient) -> Gaussians:
        """Return the Gaussians to export, by default all of ``gaussians``."""
        return gaussians

    def compare(self, subjects: Sequence[Subject], folder: Path) -> list[Path]:
        """Write pictures of all ``subjects`` into ``folder``, which exists, and return the paths.

        They are side by side in every picture, seen from the same cameras and with a caption under each.
        Raises ``UserError`` if a file cannot be written, or if this exporter makes no pictures.
        """
        raise UserError("it cannot show several assets side by side. Try: 'exporter=[preview,turntable]'")

    @property
    def file_name(self) -> str:
        """Return the name of the file that it writes with these settings; "" for several files."""
        if not self.suffix_setting:
            return next(iter(self.files), "")
        wanted = f".{getattr(self, self.suffix_setting)}"
        return next(name for name in self.files if suffix_in(name) == wanted)

    def contents(self, path: Path, gaussians: Gaussians) -> Contents | None:
        """Return what a file holds that ``export`` has written; None for a picture."""
        return None

    def losses(self, sh_degree: int) -> str:
        """Return what a file loses of Gaussians with SH degree ``sh_degree``; "" if nothing."""
        return ", ".join(part for part in (self.loss, self.sh_loss if sh_degree else "") if part)

    def omission(self, gaussians: Gaussians) -> str | None:
        """Return what of ``gaussians`` the files cannot hold, as a note for the user; None if nothing."""
        degree, highest = gaussians.sh_degree, self.max_degree
        if highest is None or degree <= highest:
            return None
        return f"{self.file_name} has SH degree {highest} at most, got {degree}"


def suffix_in(name: str) -> str:
    """Return the suffix of a name in ``files``, which begins at the first dot, such as .compressed.ply."""
    return name[name.index(".") :]


def exporters_by_suffix(classes: Mapping[str, type[Exporter]]) -> dict[str, list[str]]:
    """Return the names of the exporters for each suffix, the one that ``output=`` chooses first."""
    found: dict[str, list[str]] = {}
    for name in sorted(classes, key=lambda name: (classes[name].yields, name)):
        for file in classes[name].files:
            found.setdefault(suffix_in(file), []).append(name)
    return dict(sorted(found.items()))


def gaussians_in(count: int, *, up: str | None, sh_degree: int) -> Contents:
    """Return the contents of a file with ``count`` Gaussians."""
    return Contents(words=f"{count:,} Gaussians", up=up, gaussians=count, sh_degree=sh_degree)


@dataclass(frozen=True, kw_only=True)
class AssetExporter(Simplify, Exporter):
    """Write the Gaussians themselves as one file, in the axes that the user chooses, without a renderer."""

    # Writes the file, given its path, the Gaussians and ``up``; a format with settings overrides ``write``.
    writer: ClassVar[Callable[..., None]]
    # Node of the configuration, such as "exporter.sog", whose format needs GaussForge.
    gaussforge: ClassVar[str] = ""

    up: Annotated[str, one_of(UPS)]  # axis of the file

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gaussforge:
            require_extra(self.gaussforge, *EXTRA)

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write the file and return its path."""
        path = folder / self.file_name
        self.write(path, gaussians)
        return [path]

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write ``gaussians`` (in world axes) into ``path``, atomically.

        Raises ``UserError`` if the file cannot be written, or if the format cannot hold its numbers.
        """
        type(self).writer(path, gaussians, up=self.up)

    def contents(self, path: Path, gaussians: Gaussians) -> Contents:
        """Return the number of Gaussians, their SH degree in the file, and its axes."""
        degree = gaussians.sh_degree if self.max_degree is None else min(gaussians.sh_degree, self.max_degree)
        return gaussians_in(self.size(len(gaussians)), up=self.up, sh_degree=degree)
