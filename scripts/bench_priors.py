"""Train objects with the shipped priors and compare them with the true ones: colour, outline and PSNR.

    python scripts/bench_priors.py --prior shapes_mvdream --out outputs/priors
    python scripts/bench_priors.py --prior shapes_sd --out outputs/priors guidance.scale=3

The prompts are pairs of a colour and an object that no caption in the training of the priors names. Words
after options are settings of ``cadam3d train``. The same line again trains only what has no result yet.

An object has the right colour if its error is at most 20 (CIE Lab, delta E 76), and the right outline if the
silhouettes overlap by at least 0.7 (IoU at the best turn). The gain is over the initial Gaussians of the run.
"""

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import measuring

PRIORS = ("shapes_sd", "shapes_mvdream", "shapes_sd3")
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
SETTINGS = ("truth=shapes", "exporter=[ply,preview]")
# The largest error of a right colour (delta E), and the smallest overlap of a right outline (IoU).
COLOUR, OUTLINE = 20.0, 0.7
Summary = dict[str, Any]
# What each column of the table shows of a run.
COLUMNS: dict[str, Callable[[Summary], str]] = {
    "prompt": lambda found: found["prompt"],
    "Gaussians": lambda found: f"{found['num_gaussians']:,}",
    "start": lambda found: f"{found['psnr_start']:.1f}",
    "PSNR": lambda found: f"{found['psnr_turned']:.1f}",
    "gain": lambda found: f"{gain(found):+.1f}",
    "IoU at the start": lambda found: f"{found['iou_start']:.2f}",
    "IoU": lambda found: f"{found['iou']:.2f}",
    "colour error": lambda found: f"{found['colour_error']:.0f}",
    "turn": lambda found: f"{found['turn_deg']:.0f}",
    "seconds": lambda found: f"{found['seconds']:.0f}",
}


def gain(found: Summary) -> float:
    """Return the PSNR that a run gains over its start, in dB."""
    return found["psnr_turned"] - found["psnr_start"]


def verdict(results: Sequence[Summary]) -> str:
    """Return the median gain, and how many runs have the right colour, outline, and both."""
    is_right = [(found["colour_error"] <= COLOUR, found["iou"] >= OUTLINE) for found in results]
    colours, outlines = (sum(column) for column in zip(*is_right, strict=True))
    counts = f"right colour {colours}, right outline {outlines}, both {sum(map(all, is_right))}"
    return f"median gain {statistics.median(map(gain, results)):+.2f} dB; {counts} of {len(results)}"


def main(line: Sequence[str] | None = None) -> None:
    parser = measuring.parser_of(__doc__)
    parser.add_argument("--prior", required=True, choices=PRIORS)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--prompts", nargs="+", default=PROMPTS)
    arguments, settings = parser.parse_known_args(line)
    results = []
    print(measuring.header(COLUMNS))
    for prompt in arguments.prompts:
        folder = arguments.out / arguments.prior / measuring.folder_name(prompt, settings)
        words = [f"prior={arguments.prior}", f"prompt={prompt}", *SETTINGS, *settings]
        results.append(measuring.trained(folder, words))
        print(measuring.line_of([show(results[-1]) for show in COLUMNS.values()]), flush=True)
    print(f"\n{verdict(results)}")


if __name__ == "__main__":
    main()
