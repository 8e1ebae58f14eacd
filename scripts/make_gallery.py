"""Draw docs/images/objects.webp: the objects of a sweep beside their truth, and print them as a table.

    cadam3d sweep grid=objects
    python scripts/make_gallery.py multirun/objects cadam baseline

Each object has a row of pictures from one side: the truth, then one per arm, with PSNR and the number of
Gaussians.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from omegaconf import OmegaConf
from PIL import Image

import cadam3d
from cadam3d.build import component
from cadam3d.core.cameras import Cameras, orbit
from cadam3d.io.atomic import replacing
from cadam3d.io.caption import Caption, side_by_side
from cadam3d.io.image import to_uint8
from cadam3d.io.records import read_config
from cadam3d.prior.objects.catalog import read_catalog
from cadam3d.sweep.folder import Row, load

OUTPUT = Path(__file__).parent.parent / "docs" / "images" / "objects.webp"
SIZE = 200  # pixels of a picture
COLUMNS = 3  # objects side by side
QUALITY = 88  # of the WebP file, up to 100


def camera() -> Cameras:
    """Return the camera of all pictures, in front of the object, a little to its left and above it."""
    return orbit(*(torch.tensor([value]) for value in (30.0, 15.0, 3.0, 38.0)), SIZE, SIZE)


def strip(rows: Mapping[str, Row]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the pictures of one object: its truth, and its asset of every arm."""
    first = next(iter(rows.values()))
    prompt = first.swept["prompt"]
    truth = component(OmegaConf.create(read_config(first.folder / "config.yaml")).prior).truth(prompt)
    pictures = [to_uint8(truth.images(camera(), torch.ones(1, 3))[0, 0])]
    captions = [Caption(prompt, credit(prompt))]
    for arm, row in rows.items():
        pictures.append(cadam3d.load(row.folder).render(camera(), background=[1, 1, 1])[0])
        captions.append(Caption(arm, f"{row.summary['num_gaussians']:,} at {row.summary['psnr']:.1f} dB"))
    return side_by_side(pictures, captions)


def credit(prompt: str) -> str:
    """Return the artist of an object that comes with cadam3d."""
    [entry] = read_catalog(None).matching(prompt)
    return entry.author


def main() -> None:
    """Read the sweep, draw one seed of it, and print the table of this seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sweep", type=Path, help="folder of the sweep")
    parser.add_argument("arms", nargs="+", help="arms of the sweep, from left to right")
    typed = parser.parse_args()
    objects: dict[str, dict[str, Row]] = {}
    for row in load(typed.sweep):
        if row.arm in typed.arms and row.has_result and row.swept.get("seed", 0) == 0:
            objects.setdefault(row.swept["prompt"], {})[row.arm] = row
    strips = [strip({arm: rows[arm] for arm in typed.arms}) for _, rows in sorted(objects.items())]
    strips += [np.full_like(strips[0], 255)] * (-len(strips) % COLUMNS)
    lines = [
        np.concatenate(strips[first :: len(strips) // COLUMNS], 1) for first in range(len(strips) // COLUMNS)
    ]
    with replacing(OUTPUT) as temporary:
        Image.fromarray(np.concatenate(lines)).save(temporary, "WEBP", quality=QUALITY)
    for prompt, rows in sorted(objects.items()):
        results = (rows[arm].summary for arm in typed.arms)
        cells = (f"{each['num_gaussians']:,}, {each['psnr']:.2f} dB, {each['ssim']:.3f}" for each in results)
        print(f"| {prompt} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
