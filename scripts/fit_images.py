"""Fit Gaussians to images with known cameras, and measure the views that were held out.

    python scripts/fit_images.py capture/transforms.json --strategy cadam tau_Q=0.95 --out fitted
    python scripts/fit_images.py lego --rasterizer gsplat --strategy default grow_grad2d=0.0004
    python scripts/fit_images.py "a cupcake" --write cupcake
    OMP_NUM_THREADS=1 python scripts/fit_images.py --table

The images are those of a ``transforms.json`` of nerfstudio, those of a folder in Blender's layout with
``transforms_train.json``, or renders of an object that ``prior=objects`` knows, which ``--write`` saves as a
``transforms.json``. If there is no ``transforms_test.json``, every eighth view is held out. Images must be
undistorted and of one size. Gaussians start at random points of the ball that all cameras see, so the cameras
must surround an object.

The strategy is gsplat's ``DefaultStrategy`` or ``CAdamStrategy``, with any settings of theirs. The schedule
is that of 3DGS, scaled to the length of the run, with a tenth as many refinements. The rasterizer is one of
ours, or gsplat's, which needs a GPU. ``--table`` fits three objects with every arm, one after the other, and
appends a row to docs/data/fit_images.csv for each. The same line continues what was stopped, and
``scripts/make_tables.py`` then draws the table of docs/your_trainer.md.
"""

import argparse
import csv
import itertools
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from gsplat import DefaultStrategy
from jaxtyping import Float
from kornia.losses import ssim_loss
from measuring import HERE, commit, parser_of, positive, processor
from photos import Photos, photograph, read_data, seen_ball, write_transforms
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from cadam3d.build import component
from cadam3d.core.cameras import Cameras
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.image import contact_sheet, write_png
from cadam3d.io.ply import write_ply
from cadam3d.plugins.gsplat import CAdamStrategy
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.settings.compose import compose

STRATEGIES = {"default": DefaultStrategy, "cadam": CAdamStrategy}
# Adam's rates at the first and at the last step, between which they fall by a constant factor: those of the
# demo. That of the means is in radii of the ball that all cameras see.
RATES = {
    "means": (0.01, 0.0005),
    "scales": (0.01, 0.002),
    "quats": (0.01, 0.001),
    "opacities": (0.05, 0.05),
    "sh0": (0.03, 0.005),
    "shN": (0.0005, 0.0005),
}
SSIM_SHARE = 0.2  # of the loss, as in 3DGS

ROWS = HERE / "docs" / "data" / "fit_images.csv"
OBJECTS = ("cupcake", "horse", "potted plant")
SEEDS = (0,)
ARMS = [
    *(f"default grow_grad2d={value}" for value in ("inf", 0.006, 0.004, 0.0025, 0.0015, 0.0008, 0.0004)),
    *(f"default absgrad=True grow_grad2d={value}" for value in (0.012, 0.005)),
    "cadam",
    *(f"cadam tau_Q={value}" for value in (0.97, 0.8)),
    "cadam tau_Q=0.5 cap_max=2000",
    "cadam tau_SNR=0.4",
    *(f"cadam reset={value}" for value in ("none", "all")),
    "cadam tau_SNR=None reset=none",
]


def make_strategy(name: str, settings: Sequence[str], steps: int) -> DefaultStrategy:
    """Return a strategy with settings such as tau_Q=0.8, and the schedule of 3DGS scaled to ``steps``."""
    published = {"refine_start_iter": 500, "refine_stop_iter": 15_000, "reset_every": 3000}
    published["refine_every"] = 1000  # ten times that of 3DGS
    schedule = {key: max(1, round(steps * length / 30_000)) for key, length in published.items()}
    words = dict(word.split("=", 1) for word in settings)
    return STRATEGIES[name](**schedule | {key: value_of(text) for key, text in words.items()})


def value_of(text: str) -> Any:
    """Return what a word of the command line says: a number, True, False, None or a text."""
    words = {"None": None, "True": True, "False": False, "inf": math.inf}
    try:
        return words[text] if text in words else json.loads(text)
    except ValueError:
        return text


def fit(
    photos: Photos, strategy: DefaultStrategy, rasterizer: Rasterizer, args: argparse.Namespace
) -> Gaussians:
    """Return Gaussians that a loop like gsplat's ``simple_trainer.py`` has fitted, one view per step."""
    torch.manual_seed(args.seed)  # gsplat draws from torch's own generator
    cameras = photos.cameras
    centre, radius = seen_ball(cameras)
    params = start(centre, radius, args)
    optimizers = {name: torch.optim.Adam([tensor], eps=1e-15) for name, tensor in params.items()}
    strategy.check_sanity(params, optimizers)
    farthest = (cameras.positions - cameras.positions.mean(0)).norm(dim=1).max()
    state = strategy.initialize_state(scene_scale=1.1 * float(farthest))  # as in gsplat's trainer
    size = {"width": cameras.width, "height": cameras.height, "n_cameras": 1, "gaussian_ids": None}
    views: list[int] = []
    for step in range(args.steps):
        for name, (first, last) in RATES.items():
            unit = radius if name == "means" else 1.0
            optimizers[name].param_groups[0]["lr"] = unit * first * (last / first) ** (step / args.steps)
        views = views or torch.randperm(len(cameras)).tolist()
        view = slice(views[-1], views.pop() + 1)
        output = rasterizer.render(
            gaussians_of(params), cameras.index(view), torch.ones(1, 3).to(centre), strategy.absgrad
        )
        radii = output.radii.ceil().int()[..., None].expand(-1, -1, 2)
        info = {"means2d": output.means2d, "radii": radii, **size}
        shared = {"params": params, "optimizers": optimizers, "state": state, "step": step, "info": info}
        strategy.step_pre_backward(**shared)
        loss_of(output.rgb, photos.images[view]).backward()
        if output.absgrad is not None:
            output.means2d.absgrad = output.absgrad.grad
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(**shared)
    return gaussians_of(params).detach()


def start(centre: Float[Tensor, "3"], radius: float, args: argparse.Namespace) -> ParameterDict:
    """Return random Gaussians in a ball, as gsplat's trainer holds them."""
    words = [f"{key}={value}" for key, value in (("count", args.count), ("sh_degree", args.sh_degree))]
    words = [f"initializer.{word}" for word in ("radius=1", *words)]
    ball = component(compose(["prompt=any", "initializer=ball", *words]).initializer)
    unit = ball.build("any", torch.Generator().manual_seed(args.seed), centre.device)
    tensors = {
        "means": centre + radius * unit.means,
        "scales": unit.log_scales + math.log(radius),
        "quats": unit.quats,
        "opacities": unit.opacity_logits,
        "sh0": unit.sh[:, :1],
        "shN": unit.sh[:, 1:],
    }
    return ParameterDict({name: Parameter(tensor.clone()) for name, tensor in tensors.items()})


def gaussians_of(params: ParameterDict) -> Gaussians:
    """Return the parameters of a trainer of gsplat as ours."""
    sh = torch.cat([params["sh0"], params["shN"]], dim=1)
    return Gaussians(params["means"], params["scales"], params["quats"], params["opacities"], sh)


def loss_of(rgb: Float[Tensor, "v h w 3"], true: Float[Tensor, "v h w 3"]) -> Float[Tensor, ""]:
    """Return the loss of 3DGS (Kerbl et al. 2023, eq. 7)."""
    # The loss of kornia is half of 1 - SSIM.
    unlike = 2 * ssim_loss(rgb.permute(0, 3, 1, 2), true.permute(0, 3, 1, 2), 11)
    return (1 - SSIM_SHARE) * (rgb - true).abs().mean() + SSIM_SHARE * unlike


@torch.no_grad()
def shown(gaussians: Gaussians, cameras: Cameras, rasterizer: Rasterizer) -> Float[Tensor, "v h w 3"]:
    """Return renders of all views, in [0, 1]."""
    white = torch.ones(1, 3).to(gaussians.means)
    return torch.cat([rasterizer.render(gaussians, one, white).rgb for one in cameras.parts(1)]).clamp(0, 1)


def psnr(images: Float[Tensor, "v h w 3"], true: Float[Tensor, "v h w 3"]) -> float:
    """Return the mean PSNR over the views, in dB."""
    return float((-10 * (images - true).square().mean(dim=(1, 2, 3)).log10()).mean())


def run(args: argparse.Namespace, photos: tuple[Photos, Photos]) -> dict[str, Any]:
    """Fit the images and measure the held-out ones; returns a row of the table."""
    train, held_out = (each.to(resolve_device(args.device)) for each in photos)
    strategy = make_strategy(args.strategy, args.settings, args.steps)
    rasterizer = component(compose(["prompt=any", f"rasterizer={args.rasterizer}"]).rasterizer)
    rasterizer.prepare(train.images.device)
    began, began_cpu = time.perf_counter(), time.process_time()
    gaussians = fit(train, strategy, rasterizer, args)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - began_cpu
    images = shown(gaussians, held_out.cameras, rasterizer)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        write_ply(args.out / "asset.ply", gaussians, up="+z", pad_sh=0)
        write_png(args.out / "held_out.png", contact_sheet(torch.cat([held_out.images, images]), len(images)))
    return {
        "object": args.data,
        "strategy": args.strategy,
        "settings": " ".join(args.settings),
        "seed": args.seed,
        "count": len(gaussians),
        "psnr": round(psnr(images, held_out.images), 3),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
    }


def fill(path: Path, args: argparse.Namespace) -> None:
    """Append the rows of the table that the file at ``path`` lacks."""
    rows = list(csv.DictReader(path.open(encoding="utf-8"))) if path.is_file() else []
    done = {(row["object"], f"{row['strategy']} {row['settings']}".strip(), int(row["seed"])) for row in rows}
    where = {"commit": commit(), "machine": processor(), "threads": torch.get_num_threads()}
    photos = {name: photograph(name, args.views, args.width).split() for name in OBJECTS}
    for seed, name, arm in itertools.product(SEEDS, OBJECTS, ARMS):
        if (name, arm, seed) not in done:
            args.data, args.seed, (args.strategy, *args.settings) = name, seed, arm.split()
            row = run(args, photos[name]) | where
            is_new = not path.is_file()
            with path.open("a", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, list(row), lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerow(row)


def main(words: Sequence[str] | None = None) -> None:
    """Fit what the command line names, or all rows of the table."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "data", nargs="?", help="a transforms.json, a folder with one, or the name of an object"
    )
    parser.add_argument("settings", nargs="*", help="settings of the strategy, such as tau_Q=0.95")
    parser.add_argument("--strategy", choices=list(STRATEGIES), default="cadam")
    parser.add_argument("--rasterizer", default="auto", help="as in cadam3d train; gsplat needs a GPU")
    parser.add_argument("--device", default="auto", help="as in cadam3d train")
    parser.add_argument("--steps", type=positive, default=1000)
    parser.add_argument("--count", type=positive, default=1000, help="Gaussians at the start")
    parser.add_argument("--views", type=positive, default=56, help="renders of an object")
    parser.add_argument("--width", type=positive, default=96, help="pixels of an image; others are resized")
    parser.add_argument("--sh-degree", type=int, choices=range(4), default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for asset.ply and held_out.png")
    parser.add_argument(
        "--write", type=Path, metavar="FOLDER", help="write the renders of an object, fit nothing"
    )
    parser.add_argument("--table", type=Path, nargs="?", const=ROWS, metavar="CSV", help="fit all arms")
    args = parser.parse_intermixed_args(words)
    try:
        if args.table:
            fill(args.table, args)
        elif args.write:
            write_transforms(args.write, photograph(args.data, args.views, args.width))
        else:
            print(run(args, read_data(args.data, args.views, args.width)))
    except UserError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
