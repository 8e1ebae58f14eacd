"""Train a small diffusion model of the embedded world, in the format of a released model.

    python scripts/train_prior.py --format stable_diffusion --out models/mine
    python scripts/train_prior.py --format stable_diffusion --out models/mine --minutes 60
    python scripts/train_prior.py --format mvdream --out models/mine4 --start models/mine
    cadam3d train prior=shapes_sd prior.path=models/mine prompt="a red mushroom"

It renders views with captions, trains an autoencoder, then a denoiser with its text encoders, and writes a
folder in the layout of diffusers with a model card (README.md) and sample pictures. After an interruption,
the same line continues from the files in OUT/training. It needs pip install '.[diffusers]'.
"""

import sys
from collections.abc import Sequence

from prior_training import loop, options, stages
from prior_training.card import write_card
from prior_training.formats import FORMATS

# Of --minutes: the shares of the autoencoder and of the denoiser. The rest is for views and latents.
AUTOENCODER, DENOISER = 0.27, 0.6


def main(line: Sequence[str] | None = None) -> None:
    arguments = options.parsed(__doc__, line)
    plan = stages.Plan(
        out=arguments.out,
        views=arguments.views,
        groups=arguments.groups,
        kind=FORMATS[arguments.format](size=arguments.size),
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
    """Return the length of a stage: ``minutes``, or ``steps`` if that is None."""
    return loop.Budget(steps, None) if minutes is None else loop.Budget(None, minutes)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("\ninterrupted: the same line continues")
