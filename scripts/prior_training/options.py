"""The options of the training script, and what can be wrong with them."""

import argparse
import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from prior_training import stages
from prior_training.formats import FORMATS
from prior_training.views import GROUPS, size_of

from cadam3d.io.pretrained import INDEX
from cadam3d.prior.latent import PRIORS

MOST_GROUPS = 100 * GROUPS
GROUPS_PER_MINUTE = 300  # of --minutes, per process; a CPU renders them in a small part of the time
SIZE = 64  # pixels per side
STEP = 16  # pixels; sizes of images that all networks can halve are multiples of this


def parsed(description: str, line: Sequence[str] | None) -> argparse.Namespace:
    """Return the options of a command line, with ``groups`` and ``views`` filled in.

    A mistake is reported here, before the long rendering, and ends the program with exit code 2.
    """
    parser = _parser(description)
    arguments = parser.parse_args(line)
    if arguments.start is not None and (problem := next(_problems_of_start(arguments), None)):
        parser.error(problem)
    _fill_in(arguments)
    if problem := next(_problems(arguments), None):
        parser.error(problem)
    return arguments


def _fill_in(arguments: argparse.Namespace) -> None:
    """Complete the options about views: those of the model that training starts from, or the usual ones."""
    if arguments.start is not None:
        kept = stages.views_of(arguments.start)
        arguments.views, arguments.groups, arguments.size = kept.folder, kept.groups, kept.size
        return
    arguments.views = arguments.views or arguments.out / "training" / "views"
    arguments.groups = _groups(arguments)
    arguments.size = arguments.size or SIZE


def _problems(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the reasons why training cannot begin with these options and the files that exist."""
    size, groups, name = arguments.size, arguments.groups, arguments.format
    if size % STEP:
        yield f"argument --size: expected a multiple of {STEP}, got {size}"
    if groups > GROUPS and groups % GROUPS:
        yield f"argument --groups: expected a multiple of {GROUPS}, or less than that, got {groups}"
    if arguments.prediction is not None and name == "stable_diffusion_3":
        yield "argument --prediction: stable_diffusion_3 always predicts the velocity"
    if arguments.device == "cuda" and not torch.cuda.is_available():
        yield "argument --device: PyTorch finds no CUDA GPU on this machine"
    yield from _problems_of_folders(arguments.out, arguments.views, name, size)


def _problems_of_folders(out: Path, views: Path, name: str, size: int) -> Iterator[str]:
    nearest = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        yield f"argument --out: {nearest} is a file"
    if not os.access(nearest, os.W_OK):
        yield f"argument --out: {nearest} is not writable"
    if (kept := _kept_format(out)) not in (None, name):
        yield f"argument --out: {out} has a model in the format {kept}; each model needs a folder of its own"
    if (pixels := size_of(views)) not in (None, size):
        yield f"argument --size: the views in {views} have {pixels} pixels per side, got {size}"


def _problems_of_start(arguments: argparse.Namespace) -> Iterator[str]:
    start, name = arguments.start, arguments.format
    if start.resolve() == arguments.out.resolve():
        yield "argument --start: expected the folder of another model than --out"
    if missing := [path for path in stages.needed_to_continue(start) if not path.exists()]:
        yield f"argument --start: {missing[0]} is missing; the training of that model is not finished"
    allowed = {name, "stable_diffusion"} if name == "mvdream" else {name}
    if (kept := _kept_format(start)) not in allowed:
        yield f"argument --start: a model in the format {kept} cannot become a {name}"
    # The latents of that model belong to its views.
    for option in ("views", "groups", "size"):
        if getattr(arguments, option) is not None:
            yield f"argument --{option}: not with --start, which continues with the views of that model"
    if not (folder := stages.views_of(start).folder).is_dir():
        yield f"argument --start: its views are no longer in {folder}"


def _kept_format(folder: Path) -> str | None:
    """Return the format of the model that a folder has; None without one."""
    if not (folder / INDEX).is_file():
        return None
    kind = str(json.loads((folder / INDEX).read_text(encoding="utf-8"))["_class_name"])
    return PRIORS.get(kind, kind).removeprefix("prior=")


def whole_number(text: str) -> int:
    """Return a whole number of at least 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number >= 1, got {number}")
    return number


def positive_number(text: str) -> float:
    """Return a finite number above 0."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return number


def _whole_files(groups: int) -> int:
    """Return how many of ``groups`` fill whole files, but at least those of one file."""
    return max(1, groups // GROUPS) * GROUPS


def _groups(arguments: argparse.Namespace) -> int:
    """Return how many groups of views to render: as typed, or as many as suit the time."""
    if arguments.groups is not None:
        return arguments.groups
    if arguments.minutes is None:
        return MOST_GROUPS
    return _whole_files(min(MOST_GROUPS, round(GROUPS_PER_MINUTE * arguments.processes * arguments.minutes)))


def _parser(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--format", choices=list(FORMATS), required=True, help="format of the model")
    parser.add_argument("--out", type=Path, required=True, help="folder of the model")
    parser.add_argument(
        "--minutes",
        type=positive_number,
        help="train for about this long, not for fixed numbers of steps",
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="(default: cpu)")
    parser.add_argument(
        "--processes",
        type=whole_number,
        default=os.cpu_count(),
        help="on a CPU: processes that train together (default: one per core)",
    )
    parser.add_argument(
        "--start",
        type=Path,
        help="output folder of a model to continue from; mvdream can continue from stable_diffusion",
    )
    parser.add_argument("--views", type=Path, help="folder of rendered views, to share them between models")
    parser.add_argument(
        "--groups",
        type=whole_number,
        help=f"groups of four views to train on; above {GROUPS} a multiple of {GROUPS} "
        f"(default: {MOST_GROUPS}, and fewer with --minutes)",
    )
    parser.add_argument("--size", type=whole_number, help=f"pixels per side of an image (default: {SIZE})")
    parser.add_argument(
        "--prediction",
        choices=("v_prediction", "epsilon"),
        help="what the network of stable_diffusion and mvdream predicts (default: v_prediction)",
    )
    parser.add_argument(
        "--autoencoder-steps", type=whole_number, default=10_000, help="without --minutes (default: 10000)"
    )
    parser.add_argument(
        "--steps",
        type=whole_number,
        default=16_000,
        help="of the denoiser (default: 16000)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn (default: 0)")
    return parser
