"""Train a small diffusion model of the embedded world, in the format of a released model.

    python scripts/train_prior.py --format stable_diffusion --out models/mine
    python scripts/train_prior.py --format stable_diffusion --out models/mine --minutes 60
    python scripts/train_prior.py --format mvdream --out models/mine4 --start models/mine
    cadam3d train prior=shapes_sd prior.path=models/mine prompt="a red mushroom"

It renders views with captions, trains an autoencoder, then a denoiser with its text encoders, and writes a
folder in the layout of diffusers with a model card (README.md), sample pictures and curves. After an
interruption, the same line continues from the files in OUT/training. It needs pip install '.[diffusers]'.
"""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from prior_training import loop, stages
from prior_training.card import write_card
from prior_training.formats import FORMATS
from prior_training.views import GROUPS

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError

# Of --minutes: the shares of the autoencoder and of the denoiser. The rest is for views and latents.
AUTOENCODER, DENOISER = 0.27, 0.6
MOST_GROUPS = 100 * GROUPS
GROUPS_PER_MINUTE = 300  # of --minutes, per process; a CPU renders them in a small part of the time
STEP = 16  # pixels; sizes of images that all networks can halve are multiples of this


def main(line: Sequence[str] | None = None) -> None:
    parser = _parser()
    arguments = parser.parse_args(line)
    try:
        _check(arguments)
    except UserError as error:
        parser.error(str(error))
    plan = stages.Plan(
        out=arguments.out,
        views=arguments.views or arguments.out / "training" / "views",
        groups=_groups(arguments),
        kind=stages.format_of(arguments.format, arguments.size, arguments.prediction or "v_prediction"),
        seed=arguments.seed,
        processes=arguments.processes if arguments.device == "cpu" else 1,
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


def _check(arguments: argparse.Namespace) -> None:
    """Raise ``UserError`` for a mistake that would otherwise stop a later stage, after the long rendering."""
    size, groups, minutes, start = arguments.size, arguments.groups, arguments.minutes, arguments.start
    _require(size >= STEP and size % STEP == 0, "size", f"a multiple of {STEP}", size, 64)
    is_whole = groups is None or 1 <= groups <= GROUPS or (groups > 0 and groups % GROUPS == 0)
    wanted = f"1 to {GROUPS}, or a multiple of {GROUPS}"
    _require(is_whole, "groups", wanted, groups, _whole_files(groups or GROUPS))
    _require(arguments.processes >= 1, "processes", "at least 1", arguments.processes, 1)
    _require(minutes is None or minutes > 0, "minutes", "more than 0", minutes, 60)
    has_cuda = arguments.device == "cpu" or torch.cuda.is_available()
    _require(has_cuda, "device", "cpu, since CUDA is not available here", arguments.device, "cpu")
    has_choice = arguments.prediction is None or arguments.format != "stable_diffusion_3"
    wanted = "nothing, since stable_diffusion_3 always predicts the velocity"
    _require(has_choice, "prediction", wanted, arguments.prediction, None)
    has_weights = start is None or stages.weights_of(start).is_file()
    _require(has_weights, "start", "the output folder of a finished training", str(start), "DIR")


def _require(holds: bool, option: str, expected: str, got: object, example: object) -> None:
    line = f"without --{option}" if example is None else f"--{option} {example}"
    require(holds, f"--{option}", expected=expected, got=got, example=line)


def _whole_files(groups: int) -> int:
    """Return how many of ``groups`` fill whole files, but at least those of one file."""
    return max(1, groups // GROUPS) * GROUPS


def _budget(steps: int, minutes: float | None) -> loop.Budget:
    """Return the length of a stage: ``minutes``, or ``steps`` if that is None."""
    return loop.Budget(steps, None) if minutes is None else loop.Budget(None, minutes)


def _groups(arguments: argparse.Namespace) -> int:
    """Return how many groups of views to render: as typed, or as many as suit the time."""
    if arguments.groups is not None:
        return arguments.groups
    if arguments.minutes is None:
        return MOST_GROUPS
    return _whole_files(min(MOST_GROUPS, round(GROUPS_PER_MINUTE * arguments.processes * arguments.minutes)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--format", choices=list(FORMATS), required=True, help="format of the model")
    parser.add_argument("--out", type=Path, required=True, help="folder of the model")
    parser.add_argument(
        "--minutes", type=float, help="train for about this long instead of for fixed numbers of steps"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="(default: cpu)")
    parser.add_argument(
        "--processes",
        type=int,
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
        type=int,
        help=f"groups of four views to train on; above {GROUPS} a multiple of {GROUPS} "
        f"(default: {MOST_GROUPS}, and fewer with --minutes)",
    )
    parser.add_argument("--size", type=int, default=64, help="pixels per side of an image (default: 64)")
    parser.add_argument(
        "--prediction",
        choices=("v_prediction", "epsilon"),
        help="what the network of stable_diffusion and mvdream predicts (default: v_prediction)",
    )
    parser.add_argument(
        "--autoencoder-steps", type=int, default=10_000, help="without --minutes (default: 10000)"
    )
    parser.add_argument(
        "--steps", type=int, default=16_000, help="of the denoiser, without --minutes (default: 16000)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn (default: 0)")
    return parser


if __name__ == "__main__":
    main()
