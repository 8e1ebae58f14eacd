"""Files of the object in every format, and what a program must make of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from programs.render_elsewhere import Picture, View, ours, psnr, turned
from programs.snowman import snowman_and_pine

from cadam3d.io.compressed_ply import write_compressed_ply
from cadam3d.io.ply import write_ply
from cadam3d.io.splat import write_splat
from cadam3d.io.spz import write_spz

VIEW = View()
OPPOSITE = {"-y": "+y", "+y": "-y"}


@dataclass(frozen=True)
class Format:
    """A format of Gaussians."""

    suffix: str
    write: Callable[..., None]  # of a path, the Gaussians and up=
    max_degree: int = 3  # of the spherical harmonics that it holds


FORMATS = {
    "compressed_ply": Format(".compressed.ply", write_compressed_ply),
    "ply": Format(".ply", lambda path, gaussians, up: write_ply(path, gaussians, up=up, pad_sh=0)),
    "splat": Format(".splat", write_splat, max_degree=0),
    "spz": Format(".spz", write_spz),
}


@dataclass(frozen=True)
class Case:
    """A file of one format and SH degree in a program that shows it upright if its up axis is ``upright``."""

    format: str
    degree: int
    upright: str
    floor_db: float  # PSNR against our own render of the object

    def __str__(self) -> str:
        return f"{self.format}-sh{self.degree}"

    def write(self, folder: Path, up: str) -> Path:
        """Write the object with the up axis ``up`` and return the path of the file."""
        kind = FORMATS[self.format]
        path = folder / f"{self}{up}{kind.suffix}"
        kind.write(path, snowman_and_pine(self.degree), up=up)
        return path

    def wanted(self, up: str) -> Picture:
        """Return our picture of the object as the program must show a file with the up axis ``up``."""
        gaussians = snowman_and_pine(min(self.degree, FORMATS[self.format].max_degree))
        return ours(turned(gaussians, up, self.upright), VIEW)


def assert_upright(draw: Callable[[Path], Picture], case: Case, folder: Path) -> None:
    """Check that ``draw``, which opens a file in a program, gives our picture of the object."""
    path = case.write(folder, case.upright)
    assert_equal(draw(path), case.wanted(case.upright), case.floor_db, path)


def assert_wrong_axes_fail(draw: Callable[[Path], Picture], case: Case, folder: Path) -> None:
    """Check that the file with the opposite up axis shows the object upside down, and that we notice it."""
    path = case.write(folder, OPPOSITE[case.upright])
    picture = draw(path)
    assert psnr(picture, case.wanted(case.upright)) < 15, "an object upside down passes for an upright one"
    assert_equal(picture, case.wanted(OPPOSITE[case.upright]), case.floor_db, path)


def assert_equal(picture: Picture, wanted: Picture, floor_db: float, path: Path) -> None:
    """Check the PSNR of two pictures; if it is too low, keep both beside the file."""
    found = psnr(picture, wanted)
    if found < floor_db:
        kept = keep(picture, wanted, path)
        raise AssertionError(f"{path.name}: {found:.1f} dB, expected at least {floor_db}; see {kept}")


def keep(picture: Picture, wanted: Picture, path: Path) -> Path:
    """Keep two pictures side by side, the wanted one on the right, beside the file ``path``."""
    kept = path.with_name(path.name + ".png")
    Image.fromarray(np.hstack([picture, wanted])).save(kept)
    return kept
