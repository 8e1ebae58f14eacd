"""Real spherical harmonics of degree 0 to 3, in the order and with the constants of the 3DGS files.

Derived from the real basis Y_lm with the Condon-Shortley phase, ordered l = 0..3, m = -l..l.
"""

import torch
from jaxtyping import Float
from torch import Tensor

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
SH_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
SH_C2 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
MAX_DEGREE = 3


def sh_basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch k"]:
    """Return the ``k = (degree + 1)**2`` basis functions at unit ``directions`` (from camera to Gaussian)."""
    assert 0 <= degree <= MAX_DEGREE
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * zz - xx - yy),
            SH_C2[3] * x * z,
            SH_C2[4] * (xx - yy),
        ]
        if degree >= 3:
            basis += [
                SH_C3[0] * y * (3 * xx - yy),
                SH_C3[1] * x * y * z,
                SH_C3[2] * y * (4 * zz - xx - yy),
                SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                SH_C3[4] * x * (4 * zz - xx - yy),
                SH_C3[5] * z * (xx - yy),
                SH_C3[6] * x * (xx - 3 * yy),
            ]
    return torch.stack(basis, dim=-1)


def evaluate_sh(
    sh: Float[Tensor, "*batch k 3"], directions: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Return the RGB seen along unit ``directions``: ``max(basis . sh + 0.5, 0)``, as 3DGS defines it."""
    degree = round(sh.shape[-2] ** 0.5) - 1
    raw = (sh_basis(directions, degree)[..., None] * sh).sum(dim=-2)
    return (raw + 0.5).clamp_min(0.0)


def rgb_to_sh0(rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the view-independent coefficient that shows ``rgb`` (in [0, 1])."""
    return (rgb - 0.5) / SH_C0
