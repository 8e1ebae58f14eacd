"""Train a small diffusion model of the embedded world, in the format of a released model.

    python scripts/train_prior.py --format stable_diffusion --out models/mine
    python scripts/train_prior.py --format stable_diffusion --out models/mine --minutes 60
    python scripts/train_prior.py --format mvdream --out models/mine4 --start models/mine
    cadam3d train prior=stable_diffusion prior.path=models/mine prior.size=64 prompt="a red mushroom"

It renders views with captions, trains an autoencoder, then a denoiser with its text encoders, and writes a
folder in the layout of diffusers with a model card (README.md), sample pictures and curves. After an
interruption, the same line continues from the files in OUT/training. It needs pip install '.[diffusers]'.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from prior_training import loop, stages
from prior_training.card import write_card
from prior_training.formats import FORMATS
from prior_training.views import GROUPS, file_count, size_of

from cadam3d.io.pretrained import INDEX
from cadam3d.prior.latent import PRIORS

# Of --minutes: the shares of the autoencoder and of the denoiser. The rest is for views and latents.
AUTOENCODER, DENOISER = 0.27, 0.6
MOST_GROUPS = 100 * GROUPS
GROUPS_PER_MINUTE = 300  # that are rendered in a small part of the time, per process


def main(line: Sequence[str] | None = None) -> None:
    parser = _parser()
    arguments = parser.parse_args(line)
    groups = _groups(arguments)
    views = arguments.views or arguments.out / "training" / "views"
    if problem := next(_problems(arguments, views), None):
        parser.error(problem)
    plan = stages.Plan(
        out=arguments.out,
        views=views,
        groups=groups,
        kind=stages.format_of(arguments.format, arguments.size, arguments.prediction),
        seed=arguments.seed,
        # Each process reads files of its own.
        processes=min(arguments.processes, file_count(groups)) if arguments.device == "cpu" else 1,
        device=arguments.device,
        start=arguments.start,
    )
    minutes = arguments.minutes
    stages.render(plan, arguments.processes)
    if arguments.start is not None:
        stages.continue_from(plan, arguments.start)
    else:
        share = None if minutes is None else AUTOENCODER * minutes
        stages.train_autoencoder(plan, _budget(arguments.autoencoder_steps, share))
    scaling = stages.encode_views(plan)
    share = None if minutes is None else (DENOISER + AUTOENCODER * (arguments.start is not None)) * minutes
    stages.train_denoiser(plan, _budget(arguments.steps, share), scaling)
    stages.write_pipeline(plan, scaling)
    write_card(plan)
    print(f"model: {plan.out}")


def _budget(steps: int, minutes: float | None) -> loop.Budget:
    return loop.Budget(steps, None) if minutes is None else loop.Budget(None, minutes)


def _groups(arguments: argparse.Namespace) -> int:
    if arguments.groups is not None or arguments.minutes is None:
        return arguments.groups or MOST_GROUPS
    share = GROUPS_PER_MINUTE * arguments.processes * arguments.minutes
    return min(MOST_GROUPS, max(GROUPS, round(share)))


def _problems(arguments: argparse.Namespace, views: Path) -> Iterator[str]:
    """Yield the reasons why training cannot begin with these options and the files that exist."""
    if arguments.size % 16:
        yield f"argument --size: expected a multiple of 16, got {arguments.size}"
    if (groups := arguments.groups or 0) > GROUPS and groups % GROUPS:
        yield f"argument --groups: expected a multiple of {GROUPS}, or less than that, got {groups}"
    if arguments.device == "cuda" and not torch.cuda.is_available():
        yield "argument --device: PyTorch finds no CUDA GPU on this machine"
    yield from _problems_of_folders(arguments.out, views, arguments.format, arguments.size)
    if arguments.start is not None:
        yield from _problems_of_start(arguments.start, arguments.out, arguments.format)


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


def _problems_of_start(start: Path, out: Path, name: str) -> Iterator[str]:
    if start.resolve() == out.resolve():
        yield "argument --start: expected the folder of another model than --out"
    needed = [start / "training" / part for part in ("autoencoder.pt", "denoiser.safetensors", "latents")]
    if missing := [path for path in needed if not path.exists()]:
        yield f"argument --start: {missing[0]} is missing; the training of that model is not finished"
    allowed = {name, "stable_diffusion"} if name == "mvdream" else {name}
    if (kept := _kept_format(start)) not in allowed:
        yield f"argument --start: a model in the format {kept} cannot become a {name}"


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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--format", choices=list(FORMATS), required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of the model")
    parser.add_argument(
        "--minutes",
        type=positive_number,
        help="train for about this long, not for fixed numbers of steps",
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--processes",
        type=whole_number,
        default=os.cpu_count(),
        help="on a CPU: processes that train together",
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
        help="of four views; above 512 a multiple of 512 (default: up to 51200)",
    )
    parser.add_argument("--size", type=whole_number, default=64, help="pixels per side")
    parser.add_argument("--prediction", choices=("v_prediction", "epsilon"), default="v_prediction")
    parser.add_argument("--autoencoder-steps", type=whole_number, default=10_000)
    parser.add_argument("--steps", type=whole_number, default=16_000, help="of the denoiser")
    parser.add_argument("--seed", type=int, default=0)
    return parser


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("\ninterrupted: the same line continues")
