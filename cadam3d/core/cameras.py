"""Cameras: OpenCV axes (+x right, +y down, +z forward) in a world with +z up and the object's front at +x."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

TENSORS = ("world_to_camera", "intrinsics", "azimuth_deg", "elevation_deg")


@dataclass(frozen=True)
class Cameras:
    """``v`` pinhole views that share one image size. Pixel centres are at +0.5."""

    world_to_camera: Float[Tensor, "v 4 4"]  # rigid; OpenCV axes
    intrinsics: Float[Tensor, "v 3 3"]  # pixels
    height: int
    width: int
    azimuth_deg: Float[Tensor, "v"]  # in [-180, 180]; 0 = front (+x), 90 = the +y side
    elevation_deg: Float[Tensor, "v"]  # in [-90, 90]; positive = from above
    # The same views on the CPU, if they were drawn there: to read them, the host need not wait for a device.
    drawn: "Cameras | None" = field(default=None, repr=False, compare=False)

    def __len__(self) -> int:
        return self.world_to_camera.shape[0]

    @property
    def positions(self) -> Float[Tensor, "v 3"]:
        """Return the camera centres in world units."""
        rotation, translation = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        return -(rotation.transpose(1, 2) @ translation[..., None])[..., 0]

    def tensors(self) -> dict[str, Tensor]:
        """Return the four tensors by field name, without copying."""
        return {name: getattr(self, name) for name in TENSORS}

    def map(self, change: Callable[[Tensor], Tensor]) -> "Cameras":
        """Return new cameras, each tensor replaced by ``change(tensor)``."""
        changed: dict[str, Any] = {name: change(tensor) for name, tensor in self.tensors().items()}
        return replace(self, **changed, drawn=None)

    def index(self, views: Int[Tensor, "views"] | slice) -> "Cameras":
        """Return the chosen views, in the given order."""
        return self.map(lambda tensor: tensor[views])

    def parts(self, most: int) -> Iterator["Cameras"]:
        """Yield the views in order, at most ``most`` at a time, which bounds the memory of rendering."""
        for first in range(0, len(self), most):
            yield self.index(slice(first, first + most))

    def to(self, target: torch.device | torch.dtype | str) -> "Cameras":
        """Return the same cameras on another device or in another dtype."""
        return self.map(lambda tensor: tensor.to(target))

    def on_cpu(self) -> "Cameras":
        """Return the same cameras on the CPU; waits for their device unless they were drawn on the CPU."""
        return self.to("cpu") if self.drawn is None else self.drawn

    def resize(self, height: int, width: int) -> "Cameras":
        """Return the same views at another image size, with intrinsics scaled per axis."""
        scale = self.intrinsics.new_tensor([width / self.width, height / self.height, 1.0])
        intrinsics = self.intrinsics * scale[None, :, None]
        return replace(self, intrinsics=intrinsics, height=height, width=width, drawn=None)

    def turned(self, turn_deg: float) -> "Cameras":
        """Return the views from cameras that are carried around the vertical axis, to larger azimuths."""
        return replace(
            self,
            world_to_camera=self.world_to_camera @ vertical_turn(-turn_deg, self.world_to_camera),
            azimuth_deg=wrapped(self.azimuth_deg + turn_deg),
            drawn=None,
        )


def vertical_turn(turn_deg: float, like: Tensor) -> Float[Tensor, "4 4"]:
    """Return the matrix that turns points around the world's +z, counterclockwise seen from above.

    It has the device and the dtype of ``like``.
    """
    matrix = torch.eye(4, dtype=torch.float64)
    cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    matrix[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
    return matrix.to(like)


def look_at(
    position: Float[Tensor, "v 3"], target: Float[Tensor, "v 3"], up: Float[Tensor, "v 3"]
) -> Float[Tensor, "v 4 4"]:
    """Return world-to-camera matrices at ``position``, looking at ``target``, image top towards ``up``.

    Looking along ``up`` itself is allowed: then the axis farthest from it replaces it (world +x for +z).
    """
    forward = torch.nn.functional.normalize(target - position, dim=-1)
    right = torch.linalg.cross(forward, up, dim=-1)
    is_parallel = right.norm(dim=-1, keepdim=True) < 1e-6 * up.norm(dim=-1, keepdim=True)
    if is_parallel.any():
        spare = torch.nn.functional.one_hot(forward.abs().argmin(dim=-1), 3).to(forward)
        right = torch.where(is_parallel, torch.linalg.cross(forward, spare, dim=-1), right)
    right = torch.nn.functional.normalize(right, dim=-1)
    down = torch.linalg.cross(forward, right, dim=-1)
    rotation = torch.stack([right, down, forward], dim=1)
    upper = torch.cat([rotation, -(rotation @ position[..., None])], dim=2)
    last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(upper), 1, 4)
    return torch.cat([upper, last], dim=1)


def pinhole(fov_y_deg: Float[Tensor, "v"], height: int, width: int) -> Float[Tensor, "v 3 3"]:
    """Return intrinsics with square pixels, a centred principal point and this vertical field of view."""
    focal = 0.5 * height / torch.tan(torch.deg2rad(fov_y_deg) / 2)
    fixed = [[0.0, 0.0, width / 2], [0.0, 0.0, height / 2], [0.0, 0.0, 1.0]]
    matrix = fov_y_deg.new_tensor(fixed).repeat(len(focal), 1, 1)
    matrix.diagonal(dim1=1, dim2=2)[:, :2] = focal[:, None]
    return matrix


def around(
    azimuth_deg: Float[Tensor, "v"], elevation_deg: Float[Tensor, "v"]
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "v 3"]]:
    """Return unit vectors from the origin towards a viewer, and the up direction of its image.

    Up is the direction of growing elevation. It appears as +z in the image and is well defined at the poles
    too.
    """
    angles = torch.deg2rad(torch.stack([azimuth_deg, elevation_deg]))
    (cos_azimuth, cos_elevation), (sin_azimuth, sin_elevation) = angles.cos(), angles.sin()
    outward = torch.stack([cos_elevation * cos_azimuth, cos_elevation * sin_azimuth, sin_elevation], dim=-1)
    up = torch.stack([-sin_elevation * cos_azimuth, -sin_elevation * sin_azimuth, cos_elevation], dim=-1)
    return outward, up


def wrapped(azimuth_deg: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
    """Return the same azimuths in [-180, 180)."""
    return (azimuth_deg + 180) % 360 - 180


def orbit(
    azimuth_deg: Float[Tensor, "v"],
    elevation_deg: Float[Tensor, "v"],
    distance: Float[Tensor, "v"],
    fov_y_deg: Float[Tensor, "v"],
    height: int,
    width: int,
) -> Cameras:
    """Return upright cameras on spheres around the origin that look at it (+z is up in the image).

    ``distance`` is in world units, angles in degrees; azimuth 0 sees the front (camera on +x).
    """
    outward, up = around(azimuth_deg, elevation_deg)
    position = distance[:, None] * outward
    return Cameras(
        world_to_camera=look_at(position, torch.zeros_like(position), up),
        intrinsics=pinhole(fov_y_deg, height, width),
        height=height,
        width=width,
        azimuth_deg=wrapped(azimuth_deg),
        elevation_deg=elevation_deg,
    )


def turntable(views: int, *, elevation_deg: float, distance: float, fov_y_deg: float, size: int) -> Cameras:
    """Return ``views`` square cameras evenly spaced over one full turn, starting at the front."""
    azimuth = torch.arange(views, dtype=torch.float32) * (360.0 / views)
    full = torch.ones_like(azimuth)
    return orbit(azimuth, full * elevation_deg, full * distance, full * fov_y_deg, size, size)


def fitting_distance(fov_y_deg: float, radius: float = 1.0) -> float:
    """Return the distance at which a ball of ``radius`` just touches the image border."""
    return radius / math.sin(math.radians(fov_y_deg) / 2)
