"""Pictures that a trained model draws, through the code of the prior that will use it."""

import itertools
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.prior.base import DiffusionPrior

STEPS = 25
SCALE = 4.0  # of classifier-free guidance
# The cameras of camera=orbit, seen from a little above.
ELEVATION_DEG, DISTANCE, FOV_DEG = 15.0, 3.1, 42.5


def four_cameras(size: int) -> Cameras:
    """Return the front, the right, the back and the left side."""
    one = torch.ones(4)
    azimuth = torch.tensor([0.0, 90.0, 180.0, -90.0])
    return orbit(azimuth, ELEVATION_DEG * one, DISTANCE * one, FOV_DEG * one, size, size)


@torch.no_grad()
def draw(
    prior: DiffusionPrior, prompt: str, cameras: Cameras, channels: int, seed: int, scale: float = SCALE
) -> Tensor:
    """Return images in [0, 1], "v h w 3", drawn with the deterministic sampler of DDIM (Song et al. 2021)."""
    condition = prior.embed(prompt, "").at(cameras, torch.ones(len(cameras), 3))
    generator = torch.Generator().manual_seed(seed)
    side = cameras.height // 8
    noisy = torch.randn(len(cameras), channels, side, side, generator=generator)
    levels = torch.linspace(0.98, 0.0, STEPS + 1)
    for now, after in itertools.pairwise(levels):
        t, s = now.expand(len(cameras)), after.expand(len(cameras))
        prediction = prior.predict(noisy, t, condition, scale)
        a, b = (x(s)[:, None, None, None] for x in (prior.noise_path.a, prior.noise_path.b))
        noisy = a * prediction.clean + b * prediction.noise
    return prior.decode(prediction.clean, cameras.height, cameras.width)


def write_grid(rows: list[Tensor], path: Path, enlarged: int = 2) -> None:
    """Write images, "v h w 3" for each row, as one PNG."""
    grid = torch.cat([torch.cat(list(row), dim=1) for row in rows], dim=0)
    image = Image.fromarray((255 * grid).round().clamp(0, 255).to(torch.uint8).numpy())
    image.resize((image.width * enlarged, image.height * enlarged), Image.Resampling.NEAREST).save(path)
