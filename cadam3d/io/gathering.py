"""Gathering: build the Gaussians of a file in small blocks of rows, to save memory.

Unpacking numbers and turning them into world axes needs several times the memory of the result. A reader
therefore does both for some rows at a time.
"""

import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.frames import file_to_world
from cadam3d.io.reading import unusable

ROWS_AT_ONCE = 1 << 13


def gathered(
    path: Path, count: int, sh_degree: int, up: str, local: Callable[[slice], Gaussians]
) -> Gaussians:
    """Return ``count`` Gaussians in world axes, where ``local(rows)`` returns rows in the axes of the file.

    ``up`` is the up axis of the file. The file must have the rows before this is called, because the result
    is allocated at once. Raises ``UserError`` if a number is NaN or infinite.
    """
    whole = Gaussians(
        means=torch.empty(count, 3),
        log_scales=torch.empty(count, 3),
        quats=torch.empty(count, 4),
        opacity_logits=torch.empty(count),
        sh=torch.empty(count, (sh_degree + 1) ** 2, 3),
    )
    bad = 0
    for first in range(0, count, ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        part = file_to_world(local(rows), up)
        bad += int((~_is_finite(part)).sum())
        for name, tensor in part.tensors().items():
            whole.tensors()[name][rows] = tensor
    if bad:
        raise unusable(path, f"expected finite numbers, got NaN or infinity in {bad} of {count} Gaussians")
    return whole


def _is_finite(gaussians: Gaussians) -> Tensor:
    columns = [
        tensor.isfinite().reshape(len(tensor), math.prod(tensor.shape[1:])).all(dim=1)
        for tensor in gaussians.tensors().values()
    ]
    return torch.stack(columns).all(dim=0)
