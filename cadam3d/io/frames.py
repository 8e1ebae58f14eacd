"""Conversion between the axes of the world and the axes of files.

The world is +z up with the front at +x, but viewers of 3DGS files expect -y up. Every choice of axes here is
a signed permutation that moves the front (+x) to +z of the file, where viewers put their first camera. Two
facts keep the conversion exact in floating point:

* In positions, and in the degree-1 part of a colour, which is a vector too, numbers only change places and
  signs.
* The axes of each Gaussian may be renamed together with the world's axes. The covariance ``R diag(s^2)
  R^T`` becomes ``(A R A^T) (A diag(s^2) A^T) (A R A^T)^T``. The quaternion of ``A R A^T`` is the old one with
  its vector part permuted, and ``A diag(s^2) A^T`` permutes the scales. Multiplying quaternions instead would
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

# The rows are the x, y and z axes of a file in world coordinates. All are rotations (determinant +1), so
# nothing is mirrored.
AXES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "-y": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),  # 3DGS and COLMAP: x right, y down, z forward
    "+y": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),  # glTF, most engines and editors
    "+z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # the world, Blender
}
UPS = tuple(AXES)
TURNS = (0, 90, 180, 270)  # degrees


def world_to_file(gaussians: Gaussians, up: str) -> Gaussians:
    """Return the object in the axes of a file with the up axis ``up``: ``-y``, ``+y`` or ``+z``."""
    return _rotate(gaussians, _axes(up))


def file_to_world(gaussians: Gaussians, up: str) -> Gaussians:
    """Undo :func:`world_to_file`.

    This is exact to the bit for SH degrees 0 and 1, and for any degree with ``+z``.
    """
    return _rotate(gaussians, _axes(up).T)


def points_to_file(points: Float[Tensor, "n 3"], up: str) -> Float[Tensor, "n 3"]:
    """Return world positions in the axes of a file, exact to the bit; ``up`` is the up axis of the file."""
    return _permute(points, _axes(up))


def points_to_world(points: Float[Tensor, "n 3"], up: str) -> Float[Tensor, "n 3"]:
    """Return positions of a file in world axes, exact to the bit; ``up`` is the up axis of the file."""
    return _permute(points, _axes(up).T)


def turned(gaussians: Gaussians, turn_deg: int) -> Gaussians:
    """Return the object turned about the world's +z axis, counterclockwise seen from above.

    ``turn_deg`` is one of ``TURNS``.
    """
    return _rotate(gaussians, _turn(turn_deg))


def turned_points(points: Float[Tensor, "n 3"], turn_deg: int) -> Float[Tensor, "n 3"]:
    """Return positions turned as in :func:`turned`."""
    return _permute(points, _turn(turn_deg))


def _axes(up: str) -> Float[Tensor, "3 3"]:
    require_choice("up", up, UPS)
    return torch.tensor(AXES[up], dtype=torch.float64)


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
    degrees = range(gaussians.sh_degree + 1)
    bands = [gaussians.sh[:, degree**2 : (degree + 1) ** 2] for degree in degrees]
    return Gaussians(
        means=_permute(gaussians.means, axes),
        log_scales=gaussians.log_scales[:, axes.abs().argmax(dim=1).to(gaussians.device)],
        quats=torch.cat([gaussians.quats[:, :1], _permute(gaussians.quats[:, 1:], axes)], dim=1),
        opacity_logits=gaussians.opacity_logits,
        sh=torch.cat([bands[0], *(_rotate_band(band, axes) for band in bands[1:])], dim=1),
    )


def _rotate_band(band: Float[Tensor, "n b 3"], axes: Float[Tensor, "3 3"]) -> Float[Tensor, "n b 3"]:
    size = band.shape[1]
    # The basis of band 1 is (-y, z, -x), so the colour increases along the vector (-c2, -c0, c1).
    if size == 3:
        vectors = torch.stack([-band[:, 2], -band[:, 0], band[:, 1]], dim=-1)
        x, y, z = _permute(vectors.flatten(end_dim=1), axes).view_as(vectors).unbind(-1)
        return torch.stack([-y, z, -x], dim=1)
    matrix = band_matrix((size - 1) // 2, tuple(axes.flatten().tolist())).to(band.device)
    return torch.einsum("ij,njc->nic", matrix, band.double()).to(band.dtype)


@lru_cache(maxsize=16)
def band_matrix(degree: int, rotation: tuple[float, ...]) -> Float[Tensor, "b b"]:
    """Return the matrix by which a rotation (9 numbers, row by row) changes the coefficients of an SH band.

    A band has ``b = 2 degree + 1`` coefficients. A function of directions turns with the object, so
    ``new(R d) = old(d)`` for all d. This is solved in float64 from more sampled directions than unknowns. The
    fit is exact, because rotations do not mix bands.
    """
    matrix = torch.tensor(rotation, dtype=torch.float64).reshape(3, 3)
    # Any directions work. A fixed seed makes them always the same.
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(64, 3, dtype=torch.float64, generator=generator)
    directions = torch.nn.functional.normalize(directions, dim=1)
    band = slice(degree**2, (degree + 1) ** 2)
    old = sh_basis(directions, degree)[:, band]
    new = sh_basis(directions @ matrix.T, degree)[:, band]
    solution = torch.linalg.lstsq(new, old).solution
    # Entries that are zero up to rounding become exactly zero, so that they add no noise.
    return torch.where(solution.abs() < 1e-12, 0.0, solution)
