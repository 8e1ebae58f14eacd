"""Compare the two ray tracers of the embedded prior: their times, or their images.

    python scripts/bench_tracer.py                # times, in turns, and their ratio
    python scripts/bench_tracer.py --agreement    # how their images differ, over the whole vocabulary

Times are those of one call. One thread is timed by the clock of the process, which leaves out other
processes, and several threads by the clock on the wall. A turn is one call of the tracer in torch and five of
the native one, which count with their mean. The smallest of the turns is printed. The images are those of
every object, plain and with every pattern, from views above, beside and below, with one ray per pixel.
"""

import argparse
import ctypes
import os
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path

# The script measures the package that it stands beside, from any folder.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cadam3d.core.openmp import waiting

# As on the command line, and before torch is loaded: idle threads of torch leave the processor to others.
os.environ.update(waiting(os.environ))

import torch
from measuring import in_turns, milliseconds, parser_of, positive, table

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.native_tracer import load_tracer, trace_natively
from cadam3d.prior.shapes.objects import known_objects, known_primitives
from cadam3d.prior.shapes.scene import PATTERN_NAMES, Scene, build
from cadam3d.prior.shapes.tracer import Layers, trace

PROMPTS = ("a red and yellow checkered torus", "a lighthouse")
FOV_DEG = 40.0
ELEVATIONS_DEG = (-35.0, 15.0, 70.0)
# Images count as different above this. The order of sums alone changes less.
TOLERANCE = 1e-4


def scene_of(prompt: str) -> Scene:
    """Return the scene of a prompt in float32 on the CPU."""
    return build(prompt).to(torch.device("cpu"), torch.float32)


def views(count: int, size: int, elevation_deg: float = 15.0) -> Cameras:
    """Return views all around."""
    distance = fitting_distance(FOV_DEG)
    return turntable(count, elevation_deg=elevation_deg, distance=distance, fov_y_deg=FOV_DEG, size=size)


def compare_times(args: argparse.Namespace, library: ctypes.CDLL) -> None:
    """Print one row for each prompt, size and number of threads."""
    rows = []
    for prompt, size, threads in product(args.prompts, args.sizes, args.threads):
        scene, cameras = scene_of(prompt), views(args.views, size)
        torch.set_num_threads(threads)
        calls = {
            "torch": partial(trace, scene, cameras, args.samples),
            "native": partial(trace_natively, library, scene, cameras, args.samples),
        }
        # The mean of five native calls, because one is short. The smallest of five would flatter it.
        works = {
            name: partial(milliseconds, call, torch.device("cpu"), times=5 if name == "native" else 1)
            for name, call in calls.items()
        }
        slow, fast = (min(times) for times in in_turns(works, args.repeats).values())
        row = {"prompt": prompt, "parts": len(scene.radii), "size": size, "views": args.views}
        row |= {"threads": threads, "torch [ms]": f"{slow:.2f}", "native [ms]": f"{fast:.3f}"}
        rows.append({**row, "ratio": f"{slow / fast:.1f}"})
    print(table(rows))


def compare_images(args: argparse.Namespace, library: ctypes.CDLL) -> None:
    """Print how many samples and pixels differ for each pattern, and by how much."""
    rows = []
    names = args.objects or (*known_primitives(), *known_objects())
    for pattern in PATTERN_NAMES:
        count, covered, painted, total, largest = 0, 0, 0, 0.0, 0.0
        for name in names:
            scene = scene_of(f"a {pattern} {name}")
            for elevation_deg in ELEVATIONS_DEG:
                # One sample per pixel, so that a pixel that differs is a sample that differs.
                cameras = views(args.views, max(args.sizes), elevation_deg)
                ours, expected = trace_natively(library, scene, cameras, 1), trace(scene, cameras, 1)
                difference = largest_differences(ours, expected)
                count += difference.numel()
                covered += int((ours.alpha != expected.alpha).sum())
                painted += int((difference > TOLERANCE).sum())
                total, largest = total + float(difference.sum()), max(largest, float(difference.max()))
        row = {"pattern": pattern, "samples": count, "other coverage": covered, "other paint": painted}
        rows.append(row | {"mean difference": f"{total / count:.1e}", "largest difference": f"{largest:.1e}"})
    print(table(rows))


def largest_differences(ours: Layers, expected: Layers) -> torch.Tensor:
    """Return the largest difference of the light of any paint, for each pixel."""
    return (ours.paints - expected.paints).abs().amax(-1).double()


def main(words: Sequence[str] | None = None) -> None:
    """Read the command line and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--agreement", action="store_true", help="compare images instead of times")
    parser.add_argument("--prompts", nargs="+", default=PROMPTS, help="scenes that are timed")
    parser.add_argument("--objects", nargs="+", help="objects whose images are compared; default: all")
    parser.add_argument("--sizes", nargs="+", type=positive, default=[112, 512], help="pixels along an edge")
    parser.add_argument("--views", type=positive, default=2, help="images per call")
    parser.add_argument(
        "--samples", type=positive, default=2, help="rays per pixel along each axis, for times"
    )
    parser.add_argument("--threads", nargs="+", type=positive, default=[1, 2])
    parser.add_argument("--repeats", type=positive, default=10, help="turns for each row")
    args = parser.parse_args(words)
    try:
        _, library = load_tracer()
    except UserError as error:
        sys.exit(f"bench_tracer: {error}")
    samples = 1 if args.agreement else args.samples
    library.cadam3d_trace_instructions.restype = ctypes.c_char_p
    instructions = library.cadam3d_trace_instructions().decode()
    print(f"native tracer: {instructions}; {samples} x {samples} rays per pixel\n")
    (compare_images if args.agreement else compare_times)(args, library)


if __name__ == "__main__":
    main()
