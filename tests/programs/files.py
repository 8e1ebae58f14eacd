"""Files of the object in every format, and the pictures that other programs must draw of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from programs.render_elsewhere import Browser, Picture, View, ours, psnr, turned
from programs.snowman import snowman_and_pine

from cadam3d.io.compressed_ply import write_compressed_ply
from cadam3d.io.gaussforge import write_ksplat, write_sog, write_spz4
from cadam3d.io.glb import write_glb
from cadam3d.io.ply import write_ply
from cadam3d.io.splat import write_splat
from cadam3d.io.spz import write_spz

VIEW = View()
OPPOSITE = {"-y": "+y", "+y": "-y"}
# Opens a file in a program.
Draw = Callable[[Path], Picture]
# The page that shows a file in each program that runs in a browser, and its options.
PAGES = {
    "Babylon.js": ("babylon.html", {}),
    "PlayCanvas": ("playcanvas.html", {}),
    "Spark": ("spark.html", {}),
    # Files hold colours for the display. By default three.js takes them for linear and brightens them.
    "three.js": ("three.html", {"colours": "linear"}),
}


def in_browser(browser: Browser, program: str) -> Draw:
    """Return a function that opens a file in one of the programs of ``PAGES``."""
    page, options = PAGES[program]
    return lambda path: browser.picture(page, path, VIEW, **options)


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
    "spz4": Format(".spz", write_spz4),
    "sog": Format(".sog", write_sog),
    "ksplat": Format(".ksplat", write_ksplat, max_degree=2),
    "glb": Format(".glb", write_glb),
}


@dataclass(frozen=True)
class Case:
    """A file of one format and SH degree in a program that shows it upright if its up axis is ``upright``."""

    format: str  # one of FORMATS
    degree: int
    upright: str
    floor_db: float  # PSNR against our own render of the object

    def __str__(self) -> str:
        return f"{self.format}-sh{self.degree}"

    @property
    def exporter(self) -> str:
        """Return the name of the exporter; ``spz4`` is ``exporter=spz`` with ``version=4``."""
        return self.format.removesuffix("4")

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


def cases(up: str, floors_db: Mapping[str, Sequence[float]]) -> list[Case]:
    """Return cases with the up axis ``up``: for each format the floors at SH degree 0 and 3, or only at 0."""
    return [
        Case(name, degree, up, floor_db)
        for name, floors in floors_db.items()
        for degree, floor_db in zip((0, 3), floors, strict=False)
    ]


# The files that the programs in ``docs/exporting.md`` show upright. SPZ has a lower floor at SH degree 3,
# because its coefficients have few bits.
CASES = {
    # Babylon.js takes -y for up, except in glTF, which defines its axes. It needs a network for SPZ and SOG.
    "Babylon.js": [
        *cases("-y", {"ply": (38, 38), "compressed_ply": (38, 37), "splat": (38,)}),
        *cases("+y", {"glb": (38, 38)}),
    ],
    # The engine shows the numbers of every file unchanged in a world with +y up, whereas SuperSplat, which is
    # built on it, turns them by half a turn. Like three.js, it cuts off the faint ends of Gaussians.
    "PlayCanvas": cases("+y", {"ply": (35, 35), "compressed_ply": (35, 35), "sog": (35,), "glb": (35, 35)}),
    # Spark shows the numbers of every file unchanged in a world with +y up.
    "Spark": cases(
        "+y",
        {
            **{"ply": (38, 38), "compressed_ply": (38, 37), "splat": (38,), "spz": (38, 36)},
            **{"sog": (38, 38), "ksplat": (38, 38)},
        },
    ),
    # The program is splat-transform, which has SuperSplat's readers and its own renderer.
    "SuperSplat": cases(
        "-y",
        {
            **{"ply": (40, 40), "compressed_ply": (38, 38), "splat": (38,), "spz": (38, 36)},
            **{"spz4": (38, 36), "sog": (38, 38), "ksplat": (38, 38)},
        },
    ),
    # three.js cuts Gaussians off at two standard deviations, where we cut at an alpha of 1/255, and lowers
    # the opacity of small ones. This limits the PSNR to 31 dB.
    "three.js": cases(
        "+y",
        {
            **{"ply": (30, 30), "glb": (30, 30), "splat": (30,), "spz": (30, 30)},
            **{"spz4": (30, 30), "ksplat": (30, 30)},
        },
    ),
}


def assert_upright(draw: Draw, case: Case, folder: Path) -> None:
    """Check that ``draw``, which opens a file in a program, gives our picture of the object."""
    path = case.write(folder, case.upright)
    assert_equal(draw(path), case.wanted(case.upright), case.floor_db, path)


def assert_wrong_axes_fail(draw: Draw, case: Case, folder: Path) -> None:
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
