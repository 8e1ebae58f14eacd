"""Rotation: from quaternions to matrices."""

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Return the matrices of quaternions (w, x, y, z) of any length; a zero quaternion gives the identity.

    The results equal ``kornia.geometry.conversions.quaternion_to_rotation_matrix`` to the last bit.
    Importing kornia would add a fifth of a second to every start.
    """
    length = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    w, x, y, z = (quats / torch.where(length != 0, length, torch.ones_like(length))).unbind(dim=-1)
    tx, ty, tz = 2.0 * x, 2.0 * y, 2.0 * z
    wx, wy, wz = tx * w, ty * w, tz * w
    xx, xy, xz = tx * x, ty * x, tz * x
    yy, yz, zz = ty * y, tz * y, tz * z
    rows = (
        1.0 - (yy + zz),
        xy - wz,
        xz + wy,
        xy + wz,
        1.0 - (xx + zz),
        yz - wx,
        xz - wy,
        yz + wx,
        1.0 - (xx + yy),
    )
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)
