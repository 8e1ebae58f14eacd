"""Photos: images with known cameras, from a ``transforms.json`` or as renders of an object."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, orbit
from cadam3d.core.checks import fail, require
from cadam3d.io.image import write_png
from cadam3d.prior.objects.catalog import read_catalog

HOLD_OUT = 8  # every eighth view is held out
FOV_DEG, ELEVATIONS_DEG = 40.0, (-30.0, 75.0)  # of the renders of an object
TO_OPENCV = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()  # from OpenGL's axes
DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Photos:
    """Images over white, and the cameras that took them."""

    cameras: Cameras
    images: Float[Tensor, "v h w 3"]  # in [0, 1]

    def index(self, views: Int[Tensor, "views"]) -> "Photos":
        """Return the chosen views."""
        return Photos(self.cameras.index(views), self.images[views])

    def to(self, device: torch.device) -> "Photos":
        """Return the same on a device."""
        return Photos(self.cameras.to(device), self.images.to(device))

    def split(self) -> tuple["Photos", "Photos"]:
        """Return the views to fit and the held-out ones."""
        views = torch.arange(len(self.cameras))
        return self.index(views[views % HOLD_OUT > 0]), self.index(views[::HOLD_OUT])


def read_data(data: str, views: int, width: int) -> tuple[Photos, Photos]:
    """Return the views to fit and the held-out ones: of a file, of a folder or of an object.

    Of an object there are ``views`` renders. Images are ``width`` pixels wide. Raises ``UserError`` if there
    are none, and for images with distortion.
    """
    path = Path(data)
    if path.is_file():
        return read_transforms(path, width).split()
    if (path / "transforms.json").is_file():
        return read_transforms(path / "transforms.json", width).split()
    if (path / "transforms_train.json").is_file():
        train, test = (path / f"transforms_{name}.json" for name in ("train", "test"))
        photos = read_transforms(train, width)
        return (photos, read_transforms(test, width)) if test.is_file() else photos.split()
    return photograph(data, views, width).split()


def read_transforms(path: Path, width: int) -> Photos:
    """Return the views of a ``transforms.json`` of nerfstudio or Blender, ``width`` pixels wide.

    Raises ``UserError`` for images with distortion.
    """
    layout = json.loads(path.read_text(encoding="utf-8"))
    frames = [{**layout, **frame} for frame in layout["frames"]]
    distorted = [name for name in DISTORTIONS if any(frame.get(name) for frame in frames)]
    require(not distorted, str(path), expected="undistorted images", got=" and ".join(distorted))
    files = [path.parent / frame["file_path"] for frame in frames]
    # Blender's layout leaves out the suffix.
    images = torch.stack(
        [read_image(file if file.suffix else file.with_suffix(".png"), width) for file in files]
    )
    height, width = images.shape[1:3]
    full = {"h": height, "w": width} | frames[0]
    poses = torch.tensor([frame["transform_matrix"] for frame in frames], dtype=torch.float64)
    cameras = Cameras(
        world_to_camera=torch.linalg.inv(poses @ TO_OPENCV).float(),
        intrinsics=torch.tensor([intrinsics({**full, **frame}) for frame in frames]),
        height=int(full["h"]),
        width=int(full["w"]),
        # Not in the file, and not needed to render.
        azimuth_deg=torch.zeros(len(frames)),
        elevation_deg=torch.zeros(len(frames)),
    )
    return Photos(cameras.resize(height, width), images)


def intrinsics(frame: dict[str, Any]) -> list[list[float]]:
    """Return the rows of the matrix: nerfstudio's focal lengths, or Blender's angle of view."""
    focal = frame.get("fl_x") or 0.5 * frame["w"] / math.tan(0.5 * frame["camera_angle_x"])
    centre = frame.get("cx", frame["w"] / 2), frame.get("cy", frame["h"] / 2)
    return [[focal, 0.0, centre[0]], [0.0, frame.get("fl_y", focal), centre[1]], [0.0, 0.0, 1.0]]


def read_image(path: Path, width: int) -> Float[Tensor, "h w 3"]:
    """Return an image over white."""
    image = Image.open(path).convert("RGBA")
    image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.BOX)
    pixels = torch.from_numpy(np.array(image)).float() / 255
    return pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]


def write_transforms(folder: Path, photos: Photos) -> None:
    """Write images and a ``transforms.json`` for trainers that read the layout of nerfstudio or Blender."""
    cameras = photos.cameras
    (folder / "images").mkdir(parents=True, exist_ok=True)
    poses = torch.linalg.inv(cameras.world_to_camera.double()) @ TO_OPENCV
    frames = []
    for number, (image, pose, matrix) in enumerate(
        zip(photos.images, poses, cameras.intrinsics, strict=True)
    ):
        file = f"images/{number:04}.png"
        write_png(folder / file, image)
        focal = {"fl_x": float(matrix[0, 0]), "fl_y": float(matrix[1, 1])}
        centre = {"cx": float(matrix[0, 2]), "cy": float(matrix[1, 2])}
        frames.append({"file_path": file, "transform_matrix": pose.tolist(), **focal, **centre})
    angle = 2 * math.atan(cameras.width / 2 / frames[0]["fl_x"])
    layout = {"camera_angle_x": angle, "w": cameras.width, "h": cameras.height, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(layout, indent=1), encoding="utf-8")


def photograph(name: str, views: int, size: int) -> Photos:
    """Return renders of an object of ``prior=objects`` from all sides, in random order.

    Raises ``UserError`` if there is no such object.
    """
    catalog = read_catalog(None)
    if not (found := catalog.matching(name)[:1]):
        raise fail(
            "data", expected="a transforms.json, a folder with one, or the name of an object", got=name
        )
    number = torch.randperm(views, generator=torch.Generator().manual_seed(0)).float()
    low, high = (math.sin(math.radians(angle)) for angle in ELEVATIONS_DEG)
    elevation = torch.rad2deg(torch.asin(low + (high - low) * (number + 0.5) / views))
    azimuth, full = number * 180 * (3 - math.sqrt(5)), torch.ones(views)  # the golden angle
    cameras = orbit(azimuth, elevation, full * fitting_distance(FOV_DEG), full * FOV_DEG, size, size)
    return Photos(cameras, catalog.scene(found).truth(2).images(cameras, torch.ones(views, 3))[0])


def seen_ball(cameras: Cameras) -> tuple[Float[Tensor, "3"], float]:
    """Return centre and radius of the ball that all cameras see, around the point nearest to all axes."""
    forward, positions = cameras.world_to_camera[:, 2, :3], cameras.positions
    across = torch.eye(3).to(forward) - forward[:, :, None] * forward[:, None]
    centre = torch.linalg.solve(across.sum(0), (across @ positions[..., None]).sum(0))[:, 0]
    half = torch.tensor([cameras.width, cameras.height]).to(forward) / 2
    slope = (half / cameras.intrinsics.diagonal(dim1=1, dim2=2)[:, :2]).amin(dim=1)
    return centre, float(((positions - centre).norm(dim=1) * slope.atan().sin()).min())
