"""Render the training set: groups of four views of random captions, in files that are made independently."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import torch
from prior_training.world import Draw, held_out_captions
from torch import Tensor
from tqdm import tqdm

from cadam3d.core.cameras import Cameras
from cadam3d.io.atomic import replacing
from cadam3d.prior.shapes.scene import build
from cadam3d.prior.shapes.tracing import find_tracer

GROUPS = 512  # per file, at most
SAMPLES = 2  # rays per pixel, along each axis
HELD_OUT_GROUPS = 256
HELD_OUT_FILE = "held_out.pt"
# The seed of the held-out set differs from that of every training file by this number.
HELD_OUT = 10**9
# The share of groups in front of a random colour; the others have one of PLAIN_BACKGROUNDS.
RANDOM_BACKGROUND = 0.5
PLAIN_BACKGROUNDS = ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.5, 0.5, 0.5))


@dataclass(frozen=True)
class Groups:
    """Views without backgrounds, in groups of four with one caption each."""

    rgba: Tensor  # bytes, "g 4 4 h w"; the colours are multiplied with alpha
    captions: list[str]
    azimuth_deg: Tensor  # "g 4"
    elevation_deg: Tensor  # "g 4"

    def __len__(self) -> int:
        return len(self.captions)

    def over(self, rows: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Return the images in [-1, 1] and alpha in [0, 1] of some groups, each over one colour ("n 3")."""
        rgba = self.rgba[rows].float() / 255
        alpha = rgba[:, :, 3:]
        return 2 * (rgba[:, :, :3] + (1 - alpha) * background[:, None, :, None, None]) - 1, alpha


def backgrounds(count: int, generator: torch.Generator) -> Tensor:
    """Return one colour per group, "count 3": a random one, white, black or grey."""
    plain = torch.tensor(PLAIN_BACKGROUNDS)[
        torch.randint(len(PLAIN_BACKGROUNDS), (count,), generator=generator)
    ]
    is_random = torch.rand(count, 1, generator=generator) < RANDOM_BACKGROUND
    return torch.where(is_random, torch.rand(count, 3, generator=generator), plain)


def file_count(groups: int) -> int:
    """Return the number of files that hold this many groups, ``GROUPS`` in each or fewer in a single one."""
    return max(1, groups // GROUPS)


def render_views(folder: Path, groups: int, size: int, seed: int, processes: int) -> None:
    """Render the files that are missing in ``folder``: those of the training set, and the held-out set."""
    folder.mkdir(parents=True, exist_ok=True)
    training = [(_file(folder, i), seed + i, min(groups, GROUPS)) for i in range(file_count(groups))]
    jobs = [(folder / HELD_OUT_FILE, seed + HELD_OUT, min(groups, HELD_OUT_GROUPS)), *training]
    missing = [job for job in jobs if not job[0].is_file()]
    if not missing:
        return
    if processes == 1:
        for job in tqdm(missing, desc="views", unit="file"):
            _render(*job, size)
        return
    with ProcessPoolExecutor(processes, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        pending = [pool.submit(_render, *job, size) for job in missing]
        for done in tqdm(as_completed(pending), total=len(pending), desc="views", unit="file"):
            done.result()


def load_views(folder: Path, numbers: Iterable[int], with_images: bool = True) -> Groups:
    """Return the views of some files of the training set, with or without their images."""
    return _joined(_read(_file(folder, i), with_images) for i in numbers)


def load_held_out(folder: Path) -> Groups:
    """Return views of captions and from cameras that are not in the training set."""
    return _read(folder / HELD_OUT_FILE)


def _file(folder: Path, number: int) -> Path:
    return folder / f"views_{number:04d}.pt"


def _read(path: Path, with_images: bool = True) -> Groups:
    kept = torch.load(path, weights_only=True, mmap=True)
    return Groups(
        rgba=kept["rgba"] if with_images else kept["rgba"][:0],
        captions=kept["captions"],
        azimuth_deg=kept["azimuth_deg"],
        elevation_deg=kept["elevation_deg"],
    )


def _joined(parts: Iterator[Groups]) -> Groups:
    every = list(parts)
    return Groups(
        captions=[caption for part in every for caption in part.captions],
        **{
            name: torch.cat([getattr(part, name) for part in every])
            for name in ("rgba", "azimuth_deg", "elevation_deg")
        },
    )


def _render(path: Path, seed: int, groups: int, size: int) -> None:
    """Write one file of views, which depends on nothing but the arguments."""
    draw = Draw(torch.Generator().manual_seed(seed))
    held_out = held_out_captions() if path.name == HELD_OUT_FILE else None
    captions, cameras, images = [], [], []
    for number in range(groups):
        caption = draw.caption(draw.form()) if held_out is None else held_out[number % len(held_out)]
        group = draw.group(size)
        captions.append(caption)
        cameras.append(group)
        images.append(_views(caption, group, draw))
    azimuth = torch.stack([group.azimuth_deg for group in cameras])
    elevation = torch.stack([group.elevation_deg for group in cameras])
    kept = Groups(torch.stack(images), captions, azimuth, elevation)
    with replacing(path) as temporary:
        torch.save(vars(kept), temporary)


def _views(caption: str, cameras: Cameras, draw: Draw) -> Tensor:
    """Return the views of one caption as bytes; colours that it leaves open are drawn."""
    scene = build(caption).to(torch.device("cpu"), torch.float32)
    layers = find_tracer("auto").trace(scene, cameras, SAMPLES)
    mode = int(draw.uniform(0, len(scene.albedo)))
    colour = torch.einsum("vhwp,pc->vchw", layers.paints, scene.albedo[mode])
    rgba = torch.cat([colour, layers.alpha[:, None]], dim=1)
    return (255 * rgba).round().clamp(0, 255).to(torch.uint8)
