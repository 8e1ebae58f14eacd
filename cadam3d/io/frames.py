"""Frames of files: our world is +z up with its front at +x; viewers of 3DGS files expect -y up.

Every frame here is a signed permutation of axes that carries our front (+x) to the file's +z, where viewers
put their first camera. Two facts keep the change exact in floating point:

* positions, and the degree-1 part of a colour (a vector too), only change places and signs;
* a Gaussian's *own* axes may be renamed together with the world's. Its covariance ``R diag(s^2) R^T``
  becomes ``(A R A^T) (A diag(s^2) A^T) (A R A^T)^T``: the quaternion of ``A R A^T`` is the old one with its
  vector part permuted, and ``A diag(s^2) A^T`` permutes the scales. Multiplying quaternions instead would
  round.

Only SH bands 2 and 3 mix their coefficients (by factors such as sqrt(3)/2), which rounds once per direction.
"""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require_choice
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import sh_basis

# Rows: the file's x, y, z axes in world coordinates. Rotations (determinant +1), so nothing is mirrored.
FRAMES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "-y": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),  # 3DGS, COLMAP: x right, y down, z forward
    "+y": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),  # glTF, most engines and editors
    "+z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # ours, Blender
}
UPS = tuple(FRAMES)
TURNS = (0, 90, 180, 270)  # degrees; only quarter turns permute axes


def world_to_file(gaussians: Gaussians, up: str) -> Gaussians:
    """The same object in the frame whose ``up`` axis is one of ``-y``, ``+y``, ``+z``."""
    return _rotate(gaussians, _axes(up))


def file_to_world(gaussians: Gaussians, up: str) -> Gaussians:
    """Undo :func:`world_to_file`: bit for bit for SH degree 0 and 1, and for any degree with ``+z``."""
    return _rotate(gaussians, _axes(up).T)


def points_to_world(points: Float[Tensor, "n 3"], up: str) -> Float[Tensor, "n 3"]:
    """Positions of a file in the world, bit for bit; ``up`` is the file's up axis as above."""
    return _permute(points, _axes(up).T)


def turned(gaussians: Gaussians, turn_deg: int) -> Gaussians:
    """The same object, turned about the world's +z; counterclockwise from above, one of ``TURNS``."""
    return _rotate(gaussians, _turn(turn_deg))


def turned_points(points: Float[Tensor, "n 3"], turn_deg: int) -> Float[Tensor, "n 3"]:
    """The same positions, turned likewise."""
    return _permute(points, _turn(turn_deg))


def _axes(up: str) -> Float[Tensor, "3 3"]:
    require_choice("up", up, UPS)
    return torch.tensor(FRAMES[up], dtype=torch.float64)


def _turn(turn_deg: int) -> Float[Tensor, "3 3"]:
    require_choice("turn_deg", turn_deg, TURNS)
    quarter = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    return torch.linalg.matrix_power(quarter, turn_deg // 90)


def _permute(vectors: Float[Tensor, "n 3"], axes: Float[Tensor, "3 3"]) -> Float[Tensor, "n 3"]:
    old_axis, sign = axes.abs().argmax(dim=1), axes.sum(dim=1)
    return vectors[:, old_axis.to(vectors.device)] * sign.to(vectors)


def _rotate(gaussians: Gaussians, axes: Float[Tensor, "3 3"]) -> Gaussians:
    if torch.equal(axes, torch.eye(3, dtype=axes.dtype)):
        return gaussians
    old_axis = axes.abs().argmax(dim=1)

    def permute(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return _permute(vectors, axes)

    return Gaussians(
        means=permute(gaussians.means),
        log_scales=gaussians.log_scales[:, old_axis.to(gaussians.device)],
        quats=torch.cat([gaussians.quats[:, :1], permute(gaussians.quats[:, 1:])], dim=1),
        opacity_logits=gaussians.opacity_logits,
        sh=torch.cat([_rotate_band(band, permute, axes) for band in _bands(gaussians.sh)], dim=1),
    )


def _bands(sh: Float[Tensor, "n k 3"]) -> list[Tensor]:
    degrees = range(round(sh.shape[1] ** 0.5))
    return [sh[:, degree**2 : (degree + 1) ** 2] for degree in degrees]


def _rotate_band(band: Float[Tensor, "n b 3"], permute, axes: Float[Tensor, "3 3"]) -> Float[Tensor, "n b 3"]:
    size = band.shape[1]
    if size == 1:
        return band
    if size == 3:  # basis (-y, z, -x): the colour's gradient direction is the vector (-c2, -c0, c1)
        vector = torch.stack([-band[:, 2], -band[:, 0], band[:, 1]], dim=1)
        x, y, z = torch.stack([permute(vector[..., channel]) for channel in range(3)], dim=-1).unbind(1)
        return torch.stack([-y, z, -x], dim=1)
    matrix = band_matrix((size - 1) // 2, tuple(axes.flatten().tolist())).to(band.device)
    return torch.einsum("ij,njc->nic", matrix, band.double()).to(band.dtype)


@lru_cache(maxsize=16)
def band_matrix(degree: int, rotation: tuple[float, ...]) -> Float[Tensor, "b b"]:
    """How the ``b = 2 degree + 1`` coefficients of an SH band change under a rotation (9 numbers by rows).

    A function of directions turns with the object: ``new(R d) = old(d)`` for all d. Solved in float64 from
    more sampled directions than unknowns; the fit is exact, because rotations do not mix bands.
    """
    matrix = torch.tensor(rotation, dtype=torch.float64).reshape(3, 3)
    generator = torch.Generator().manual_seed(0)  # any directions do; these are always the same
    directions = torch.randn(64, 3, dtype=torch.float64, generator=generator)
    directions = torch.nn.functional.normalize(directions, dim=1)
    band = slice(degree**2, (degree + 1) ** 2)
    old = sh_basis(directions, degree)[:, band]
    new = sh_basis(directions @ matrix.T, degree)[:, band]
    solution = torch.linalg.lstsq(new, old).solution
    return torch.where(solution.abs() < 1e-12, 0.0, solution)  # a true zero must not spread noise
