"""From a signed distance to the triangles of the surface."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.mesh.surface import outer_shell
from cadam3d.core.rendering import Triangles

# The true surface is marched in the cube [-1, 1]^3, which holds every object, with this many nodes per side.
# It is off by up to a third of a cell (0.003 world units) at sharp edges, and by less than 0.0002 elsewhere.
TRUE_NODES = 256
CELL = 2.0 / TRUE_NODES  # world units
COARSE_NODES = 32


def true_surfaces(distance: Callable[[Tensor], Tensor]) -> list[Triangles]:
    """Return the outer surface of each of ``g`` shapes.

    ``distance`` maps points "n 3" to signed distances "g n", negative inside. Their sign is exact, and their
    size is at most the distance to the surface, in world units.
    """
    shapes = len(distance(torch.zeros(1, 3, dtype=torch.float64)))
    found = []
    for shape in range(shapes):
        inside = -_sampled(lambda points, shape=shape: distance(points)[shape]) / CELL
        vertices, faces = outer_shell(inside.clamp(-1, 1))
        found.append(((vertices + 0.5) * CELL - 1, faces))
    return found


def _sampled(distance: Callable[[Tensor], Tensor]) -> Float[Tensor, "x y z"]:
    """Return signed distances at the centres of ``TRUE_NODES``^3 cells, exact next to the surface.

    Elsewhere they belong to the centre of a larger cell that the surface does not reach. A distance
    function is never larger than the distance, so a cell with a larger one at its centre than its radius can
    be left whole.
    """
    size, nodes = 2.0 / COARSE_NODES, COARSE_NODES
    axis = torch.arange(nodes)
    cells = torch.cartesian_prod(axis, axis, axis)
    field = torch.zeros(nodes, nodes, nodes)
    while True:
        values = distance((cells.double() + 0.5) * size - 1)
        field[cells[:, 0], cells[:, 1], cells[:, 2]] = values.float()
        if nodes == TRUE_NODES:
            return field
        # The margin makes sure that a cell next to the surface has neighbours that are as fine.
        is_near = values.abs() <= math.sqrt(3) * (size / 2 + CELL)
        size, nodes = size / 2, nodes * 2
        corner = torch.cartesian_prod(*[torch.arange(2)] * 3)
        cells = (2 * cells[is_near][:, None] + corner).reshape(-1, 3)
        field = field.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
