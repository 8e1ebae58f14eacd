"""The light on objects whose images are known exactly.

It depends on the surface and not on the view, so that an asset of SH degree 0 can match it.
"""

from jaxtyping import Float
from torch import Tensor

# The direction towards the light; the front of objects faces +x, and +z is up.
LIGHT = (0.60, 0.42, 0.68)
# The first three sum to 1, so that nothing saturates.
AMBIENT, SKY, DIFFUSE, WRAP = 0.46, 0.18, 0.36, 0.5


def light_on(normal: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
    """Return the light that each surface with this unit normal sends, in [0, 1]."""
    facing = ((dot(light_direction(normal), normal) + WRAP) / (1 + WRAP)).clamp_min(0)
    return AMBIENT + SKY * (0.5 + 0.5 * normal[2]) + DIFFUSE * facing


def light_direction(like: Tensor) -> Float[Tensor, "3"]:
    """Return the unit vector towards the light, on the device and in the dtype of ``like``."""
    return normalized(like.new_tensor(LIGHT))


def normalized(vectors: Tensor) -> Tensor:
    """Normalize vectors that have their components along the first axis."""
    return vectors * dot(vectors, vectors).clamp_min(1e-30).rsqrt()


def dot(one: Tensor, other: Tensor) -> Tensor:
    """Return the products of vectors that have their components along the first axis, added in order."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
