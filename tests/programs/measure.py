"""Print the table of ``docs/notes/programs.md``: every format in every program.

python tests/programs/measure.py
"""

import datetime
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from programs.files import FORMATS, PAGES, VIEW, Case, Draw, in_browser
from programs.render_elsewhere import (
    Browser,
    RefusedError,
    SplatTransform,
    ours,
    pinned,
    psnr,
    turned,
)
from programs.snowman import snowman_and_pine


def main() -> None:
    print(f"Measured on {datetime.date.today()} with")
    print(", ".join(f"{name} {version}" for name, version in pinned().items()) + ".\n")
    with Browser.start() as browser, tempfile.TemporaryDirectory() as folder:
        transform = SplatTransform.find()
        programs: dict[str, Draw] = {
            "splat-transform": lambda path: transform.picture(path, VIEW),
            **{name: in_browser(browser, name) for name in PAGES},
        }
        print("| format |", " | ".join(programs), "|")
        print("|" + "---|" * (1 + len(programs)))
        for name in FORMATS:
            cells = (cell(draw, name, Path(folder)) for draw in programs.values())
            print(f"| {name} |", " | ".join(cells), "|", flush=True)


def cell(draw: Draw, name: str, folder: Path) -> str:
    """Return the up axis with which a file is upright, and its PSNR at SH degree 0 and 3."""
    try:
        upright, db = shown(draw, Case(name, 0, "+y", 0), folder)
    except RefusedError:
        return "refused"
    _, at_three = shown(draw, Case(name, 3, upright, 0), folder)
    return f"{upright}: {db:.1f} / {at_three:.1f}"


def shown(draw: Draw, case: Case, folder: Path) -> tuple[str, float]:
    """Return the up axis that a program takes a file for, and the PSNR against our render of that."""
    picture = draw(case.write(folder, case.upright))
    gaussians = snowman_and_pine(min(case.degree, FORMATS[case.format].max_degree))
    found = {up: psnr(picture, ours(turned(gaussians, case.upright, up), VIEW)) for up in ("-y", "+y")}
    best = max(found, key=lambda up: found[up])
    return best, found[best]


if __name__ == "__main__":
    main()
