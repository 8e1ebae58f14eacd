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
import os
from collections.abc import Sequence
from pathlib import Path

from prior_training import loop, stages
from prior_training.card import write_card
from prior_training.formats import FORMATS
from prior_training.views import GROUPS

# Of --minutes: the shares of the autoencoder and of the denoiser. The rest is for views and latents.
AUTOENCODER, DENOISER = 0.27, 0.6
MOST_GROUPS = 100 * GROUPS
GROUPS_PER_MINUTE = 300  # that are rendered in a small part of the time, per process


def main(line: Sequence[str] | None = None) -> None:
    arguments = _parser().parse_args(line)
    plan = stages.Plan(
        out=arguments.out,
        views=arguments.views or arguments.out / "training" / "views",
        groups=_groups(arguments),
        kind=stages.format_of(arguments.format, arguments.size, arguments.prediction),
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


def _budget(steps: int, minutes: float | None) -> loop.Budget:
    return loop.Budget(steps, None) if minutes is None else loop.Budget(None, minutes)


def _groups(arguments: argparse.Namespace) -> int:
    if arguments.groups is not None or arguments.minutes is None:
        return arguments.groups or MOST_GROUPS
    share = GROUPS_PER_MINUTE * arguments.processes * arguments.minutes
    return min(MOST_GROUPS, max(GROUPS, round(share)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--format", choices=list(FORMATS), required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of the model")
    parser.add_argument(
        "--minutes", type=float, help="train for about this long instead of for fixed numbers of steps"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument(
        "--processes", type=int, default=os.cpu_count(), help="on a CPU: processes that train together"
    )
    parser.add_argument(
        "--start",
        type=Path,
        help="output folder of a model to continue from; mvdream can continue from stable_diffusion",
    )
    parser.add_argument("--views", type=Path, help="folder of rendered views, to share them between models")
    parser.add_argument(
        "--groups", type=int, help="of four views; above 512 a multiple of 512 (default: up to 51200)"
    )
    parser.add_argument("--size", type=int, default=64, help="pixels per side")
    parser.add_argument("--prediction", choices=("v_prediction", "epsilon"), default="v_prediction")
    parser.add_argument("--autoencoder-steps", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=16_000, help="of the denoiser")
    parser.add_argument("--seed", type=int, default=0)
    return parser


if __name__ == "__main__":
    main()
