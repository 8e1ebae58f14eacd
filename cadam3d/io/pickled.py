"""Pickled: the pickles in files of torch, looked at before torch reads them.

With ``weights_only=True``, torch executes nothing from a pickle, but it builds what the pickle describes. A
few bytes can describe a tuple of a tuple of a tuple, each of them twice in the next. Using it as a key visits
every copy and never ends, and a very deep tuple ends the process.
"""

import pickletools
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, BinaryIO

DEEPEST = 100  # containers within containers
MOST_COPIES = 10  # objects that are used again, per byte of the file
# A file of torch's old format begins with this many pickles.
OLD_PICKLES = 5
PUTS = ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE")
GETS = ("GET", "BINGET", "LONG_BINGET")
# These add to a container that exists.
ADDS = ("APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD")


@dataclass(frozen=True)
class _Built:
    """Describes an object on the stack of a pickle."""

    depth: int = 0
    size: int = 1  # objects in it, as often as they appear


def require_finite(file: BinaryIO) -> None:
    """Raise ``ValueError`` if a pickle in a file of torch describes something that is too deep or endless.

    A pickle that is damaged raises anything.
    """
    if not zipfile.is_zipfile(file):
        length = file.seek(0, 2)
        file.seek(0)
        for _ in range(OLD_PICKLES):
            _scan(pickletools.genops(file), length)
        return
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            # Torch finds names in any case.
            if entry.filename.lower().endswith(".pkl"):
                if entry.compress_type != zipfile.ZIP_STORED:
                    raise ValueError("its pickle is compressed")
                _scan(pickletools.genops(archive.read(entry)), entry.file_size)


def _scan(operations: Iterable[Any], length: int) -> None:
    """Follow the depth and the size of every object that a pickle of ``length`` bytes builds."""
    stack: list[_Built | None] = []  # None is a mark
    memo: dict[int, _Built | None] = {}
    copies = 0
    for operation, argument, _ in operations:
        name = operation.name
        if name in PUTS:
            memo[len(memo) if argument is None else int(argument)] = stack[-1]
        elif name in GETS or name == "DUP":
            again = stack[-1] if name == "DUP" else memo[int(argument)]
            copies += 1 if again is None else again.size
            stack.append(again)
        elif name == "MARK":
            stack.append(None)
        else:
            taken = _taken(stack, operation.stack_before)
            stack += [_combined(taken, is_added=name in ADDS) for _ in operation.stack_after]
        if copies > MOST_COPIES * length or (stack and stack[-1] and stack[-1].depth > DEEPEST):
            raise ValueError("it holds containers that are too deep or that repeat each other")


def _taken(stack: list[_Built | None], before: list[Any]) -> list[_Built]:
    """Remove what an operation takes from the stack, and return it from the lowest to the highest."""
    taken: list[_Built] = []
    if pickletools.stackslice in before:
        while (top := stack.pop()) is not None:
            taken.append(top)
    fixed = [each for each in before if each not in (pickletools.markobject, pickletools.stackslice)]
    taken += [top for _ in fixed if (top := stack.pop()) is not None]
    return taken[::-1]


def _combined(taken: list[_Built], *, is_added: bool) -> _Built:
    """Return an object made of others; ``is_added`` means that they were added to the first."""
    depth = max((each.depth + 1 for each in taken[is_added:]), default=0)
    depth = max(depth, taken[0].depth) if is_added else depth
    return _Built(depth, 1 + sum(each.size for each in taken))
