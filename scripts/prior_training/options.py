"""The options of the training script, and what can be wrong with them."""

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from measuring import parser_of, positive
from prior_training import stages
from prior_training.formats import FORMATS
from prior_training.views import GROUPS

from cadam3d.io.pretrained import INDEX
from cadam3d.prior.latent import PRIORS

MOST_GROUPS = 100 * GROUPS
GROUPS_PER_MINUTE = 300  # of --minutes, per process; a CPU renders them in a small part of the time
STEP = 16  # pixels; sizes of images that all networks can halve are multiples of this


def parsed(description: str, line: Sequence[str] | None) -> argparse.Namespace:
    """Return the options of a command line, with ``groups`` and ``views`` filled in.

    A mistake is reported here, before the long rendering, and ends the program with exit code 2.
    """
    parser = _parser(description)
    arguments = parser.parse_args(line)
    if problem := next(_problems(arguments), None):
        parser.error(problem)
    arguments.views = arguments.out / "training" / "views"
    if arguments.start is not None:
        kept = stages.views_of(arguments.start)
        arguments.views, arguments.groups, arguments.size = kept.folder, kept.groups, kept.size
    arguments.groups = arguments.groups or _usual_groups(arguments)
    return arguments


def _problems(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the reasons why training cannot begin with these options and the files that exist."""
    name, out, start = arguments.format, arguments.out, arguments.start
    if arguments.size % STEP:
        yield f"argument --size: expected a multiple of {STEP}, got {arguments.size}"
    groups = arguments.groups or 1
    if groups > GROUPS and groups % GROUPS:
        yield f"argument --groups: expected a multiple of {GROUPS}, or less than that, got {groups}"
    if arguments.device == "cuda" and not torch.cuda.is_available():
        yield "argument --device: PyTorch finds no CUDA GPU on this machine"
    if (kept := _kept_format(out)) not in (None, name):
        yield f"argument --out: expected a new folder, got {out} with a model in the format {kept}"
    if start is None:
        return
    if missing := [path for path in stages.needed_to_continue(start) if not path.exists()]:
        yield f"argument --start: expected a finished training, got no {missing[0]}"
    allowed = {name, "stable_diffusion"} if name == "mvdream" else {name}
    if (kept := _kept_format(start)) not in allowed:
        yield f"argument --start: a model in the format {kept} cannot become a {name}"


def _kept_format(folder: Path) -> str | None:
    """Return the format of the model that a folder has; None without one."""
    if not (folder / INDEX).is_file():
        return None
    kind = str(json.loads((folder / INDEX).read_text(encoding="utf-8"))["_class_name"])
    return PRIORS.get(kind, kind).removeprefix("prior=")


def _usual_groups(arguments: argparse.Namespace) -> int:
    """Return how many groups of views to render, as many as suit the time and fill whole files."""
    if arguments.minutes is None:
        return MOST_GROUPS
    groups = min(MOST_GROUPS, round(GROUPS_PER_MINUTE * arguments.processes * arguments.minutes))
    return max(1, groups // GROUPS) * GROUPS


def _parser(description: str) -> argparse.ArgumentParser:
    parser = parser_of(description)
    parser.add_argument("--format", choices=list(FORMATS), required=True, help="format of the model")
    parser.add_argument("--out", type=Path, required=True, help="folder of the model")
    parser.add_argument(
        "--minutes", type=positive, help="train for about this long, not for fixed numbers of steps"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="(default: cpu)")
    parser.add_argument(
        "--processes",
        type=positive,
        default=os.cpu_count(),
        help="on a CPU: processes that train together (default: one per core)",
    )
    parser.add_argument(
        "--start",
        type=Path,
        help="output folder of a model to continue from with its views; mvdream can continue from "
        "stable_diffusion",
    )
    parser.add_argument(
        "--groups",
        type=positive,
        help=f"groups of four views to train on; above {GROUPS} a multiple of {GROUPS} "
        f"(default: {MOST_GROUPS}, and fewer with --minutes)",
    )
    parser.add_argument("--size", type=positive, default=64, help="pixels per side (default: 64)")
    parser.add_argument("--autoencoder-steps", type=positive, default=10_000, help="without --minutes")
    parser.add_argument("--steps", type=positive, default=16_000, help="of the denoiser")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn (default: 0)")
    return parser
