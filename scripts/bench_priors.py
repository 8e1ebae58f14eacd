"""Train objects with the shipped priors and compare them with the true ones: colour, outline and PSNR.

    python scripts/bench_priors.py --prior shapes_mvdream --out outputs/priors
    python scripts/bench_priors.py --prior shapes_sd --out outputs/priors guidance.scale=3

The prompts are pairs of a colour and an object that no caption in the training of the priors names. Words
after options are settings of ``cadam3d train``. The same line again trains only what has no result yet.

An object has the right colour if its error is at most 20 (CIE Lab, delta E 76), and the right outline if the
silhouettes overlap by at least 0.7 (IoU at the best turn). The gain is over the initial Gaussians of the run.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

PROMPTS = (
    "a red mushroom",
    "a purple cube",
    "a pink torus",
    "a green cylinder",
    "a white cone",
    "a yellow lighthouse",
    "a green chair",
    "a blue table",
    "a cyan snowman",
    "a red boat",
)
# The largest error of a right colour (delta E), and the smallest overlap of a right outline (IoU).
COLOUR, OUTLINE = 20.0, 0.7
HEADER = (
    "| prompt | Gaussians | start | PSNR | gain | IoU at the start | IoU | colour error | turn | seconds |"
)


def train(prior: str, prompt: str, folder: Path, settings: list[str]) -> dict[str, float]:
    """Train one object unless it has a result, and return its figures."""
    summary = folder / "summary.json"
    if not summary.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        line = [sys.executable, "-m", "cadam3d", "train", f"prior={prior}", f"prompt={prompt}"]
        subprocess.run(
            [*line, "truth=shapes", "exporter=[ply,preview]", f"hydra.run.dir={folder}", *settings],
            check=True,
        )
    return json.loads(summary.read_text(encoding="utf-8"))


def row(prompt: str, found: dict[str, float]) -> str:
    """Return a line of the table for the summary ``found`` of a run."""
    cells = [
        prompt,
        f"{found['num_gaussians']:,}",
        *(f"{found[name]:.1f}" for name in ("psnr_start", "psnr_turned")),
        f"{found['psnr_turned'] - found['psnr_start']:+.1f}",
        *(f"{found[name]:.2f}" for name in ("iou_start", "iou")),
        *(f"{found[name]:.0f}" for name in ("colour_error", "turn_deg", "seconds")),
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--prior", required=True, choices=("shapes_sd", "shapes_mvdream"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--prompts", nargs="+", default=PROMPTS)
    arguments, settings = parser.parse_known_args()
    settings = [word for word in settings if word != "--"]
    results = []
    print(HEADER, "|" + "---|" * HEADER.count(" |"), sep="\n")
    for prompt in arguments.prompts:
        folder = arguments.out / arguments.prior / "_".join(["seed0", *settings, *prompt.split()[1:]])
        results.append(train(arguments.prior, prompt, folder.absolute(), settings))
        print(row(prompt, results[-1]), flush=True)
    gains = [found["psnr_turned"] - found["psnr_start"] for found in results]
    colours = sum(found["colour_error"] <= COLOUR for found in results)
    outlines = sum(found["iou"] >= OUTLINE for found in results)
    both = sum(found["colour_error"] <= COLOUR and found["iou"] >= OUTLINE for found in results)
    counts = f"right colour {colours}, right outline {outlines}, both {both} of {len(results)}"
    print(f"\nmedian gain {statistics.median(gains):+.2f} dB; {counts}")


if __name__ == "__main__":
    main()
