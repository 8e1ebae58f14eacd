"""Time Adam with one kernel for each tensor against the separate operations, and print the ratio.

    python scripts/bench_adam.py                  # on the CPU, where training uses the separate operations
    python scripts/bench_adam.py --device cuda    # where training uses one kernel for each tensor

Both work on the same gradients in turns. Times are medians in milliseconds.
"""

from functools import partial

import measuring
import torch

from cadam3d import optimizer
from cadam3d.build import component
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.settings.compose import compose

# Gaussians, and spherical harmonics per Gaussian.
SCENES = ((4_000, 1), (100_000, 1), (100_000, 16), (1_000_000, 16))


def random_gaussians(n: int, k: int, device: torch.device) -> Gaussians:
    """Return Gaussians of random numbers, which serve as gradients too."""
    shapes = dict(zip(FIELDS, ((n, 3), (n, 3), (n, 4), (n,), (n, k, 3)), strict=True))
    return Gaussians(**{name: torch.randn(shape, device=device) for name, shape in shapes.items()})


def step(adam: optimizer.GaussianOptimizer, noise: Gaussians, devices: tuple[str, ...]) -> None:
    """Do one step, with one kernel for each tensor on ``devices``."""
    optimizer.FUSED = devices
    for name, tensor in adam.gaussians.tensors().items():
        tensor.grad = getattr(noise, name)
    adam.step(0)


def main() -> None:
    """Print a row for each scene."""
    parser = measuring.parser_of(__doc__)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--repeats", type=measuring.positive, default=20)
    args = parser.parse_args()
    settings = component(compose(["prompt=a"]).optimizer)
    rows = []
    for n, k in SCENES:
        noise = random_gaussians(n, k, args.device)
        adam = settings.start(random_gaussians(n, k, args.device))
        works = {
            name: partial(measuring.milliseconds, partial(step, adam, noise, devices), args.device)
            for name, devices in (("separate", ()), ("one kernel", (args.device.type,)))
        }
        turns = measuring.in_turns(works, args.repeats, warm_up=3)
        separate, one = (measuring.median(times) for times in turns.values())
        times = {"separate": f"{separate:.3f}", "one kernel": f"{one:.3f}", "ratio": f"{separate / one:.2f}"}
        rows.append({"Gaussians": f"{n:,}", "coefficients": k, **times})
    print(measuring.table(rows))


if __name__ == "__main__":
    main()
