"""Gathering: build the Gaussians of a file in small blocks of rows, to save memory.

Unpacking numbers and turning them into world axes needs several times the memory of the result. A reader
therefore does both for some rows at a time.
"""

from collections.abc import Callable
from pathlib import Path

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.encoding import is_finite
from cadam3d.io.frames import file_to_world
from cadam3d.io.reading import unusable

ROWS_AT_ONCE = 1 << 13


def gathered(path: Path, count: int, up: str, local: Callable[[slice], Gaussians]) -> Gaussians:
    """Return ``count`` Gaussians in world axes, where ``local(rows)`` returns rows in the axes of the file.

    ``up`` is the up axis of the file. The file must have the rows before this is called, because the result
    is allocated at once. Raises ``UserError`` if a number is NaN or infinite.
    """
    whole = local(slice(0, 0)).map(lambda rows: rows.new_empty(count, *rows.shape[1:]))
    for first in range(0, count, ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        for name, tensor in file_to_world(local(rows), up).tensors().items():
            whole.tensors()[name][rows] = tensor
    if not is_finite(whole):
        raise unusable(path, "expected finite numbers, got NaN or infinity")
    return whole
