"""Print the table of ``docs/programs.md``: every format in every program, with both up axes.

python tests/programs/measure.py
"""

import contextlib
import datetime
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from programs.files import FORMATS, VIEW, Case
from programs.render_elsewhere import Browser, RefusedError, SplatTransform, ours, pinned, psnr, turned
from programs.snowman import snowman_and_pine

UPS = {"-y": "upright with -y", "+y": "upright with +y"}


def main() -> None:
    print(f"Measured on {datetime.date.today()} with", ", ".join(f"{n} {v}" for n, v in pinned().items()))
    print("\n| program | format | upright with | PSNR at SH 0 | at SH 3 |\n|---|---|---|---|---|")
    with Browser.start() as browser, tempfile.TemporaryDirectory() as folder:
        transform = SplatTransform.find()
        programs = {
            "splat-transform": lambda path: transform.picture(path, VIEW),
            "Spark": lambda path: browser.picture("spark.html", path, VIEW),
            "Babylon.js": lambda path: browser.picture("babylon.html", path, VIEW),
            "three.js": lambda path: browser.picture("three.html", path, VIEW, colours="linear"),
            "three.js, default colours": lambda path: browser.picture("three.html", path, VIEW),
        }
        for program, draw in programs.items():
            for name in FORMATS:
                print(f"| {program} | {name} |", *row(draw, name, Path(folder)), flush=True)


def row(draw, name: str, folder: Path) -> list[str]:
    """Return the cells of one format in one program."""
    try:
        upright, db = shown(draw, Case(name, 0, "+y", 0), folder)
    except RefusedError as error:
        return ["refused |", str(error).strip().splitlines()[-1][-90:], "| |"]
    opposite, _ = shown(draw, Case(name, 0, "-y", 0), folder)
    assert upright == opposite, "neither upright nor upside down"
    _, at_three = shown(draw, Case(name, 3, upright, 0), folder)
    return [f"{upright} | {db:.1f} | {at_three:.1f} |"]


def shown(draw, case: Case, folder: Path) -> tuple[str, float]:
    """Return the up axis that a program takes a file for, and the PSNR against our render of that."""
    picture = draw(case.write(folder, case.upright))
    gaussians = snowman_and_pine(min(case.degree, FORMATS[case.format].max_degree))
    found = {up: psnr(picture, ours(turned(gaussians, case.upright, up), VIEW)) for up in ("-y", "+y")}
    best = max(found, key=lambda up: found[up])
    return best, found[best]


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        main()
