"""Memory of kernels: many named arrays in one allocation, which takes less time than one for each."""

import os
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

# Arrays begin at multiples of this; torch's allocator aligns at least as much.
ALIGNMENT = 256  # bytes
# Whether every array gets an allocation of its own. A tool that checks each access to memory cannot see that
# a kernel leaves one array for the next one in the same block. With such a tool this variable is set anyway,
# because otherwise torch's own allocator returns pieces of large blocks too.
APART = os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING") == "1"


@dataclass(frozen=True)
class Workspace:
    """Named arrays without their memory: where each of them begins."""

    places: Mapping[str, tuple[int, int]]  # by name: which block, and bytes from its beginning
    sizes: Mapping[str, int]  # bytes of each array
    blocks: tuple[int, ...]  # bytes of each block

    def allocate(self, device: torch.device) -> tuple[Tensor, ...]:
        """Return new blocks of memory, with arbitrary contents."""
        return tuple(torch.empty(size, dtype=torch.uint8, device=device) for size in self.blocks)

    def addresses(self, blocks: tuple[Tensor, ...]) -> dict[str, int]:
        """Return the addresses of all arrays in blocks that :meth:`allocate` has returned, or in copies."""
        starts = [block.data_ptr() for block in blocks]
        return {name: starts[block] + offset for name, (block, offset) in self.places.items()}

    def tensor(self, blocks: tuple[Tensor, ...], name: str, dtype: torch.dtype) -> Tensor:
        """Return an array as a tensor of one dimension."""
        (block, offset), size = self.places[name], self.sizes[name]
        return blocks[block][offset : offset + size].view(dtype)


def plan(sizes: Mapping[str, int], apart: bool) -> Workspace:
    """Return a workspace with an array of so many bytes for each name, in one block or in one block each."""
    if apart:
        places = {name: (block, 0) for block, name in enumerate(sizes)}
        # A block has at least one byte. Otherwise its address would be 0, which means a missing array.
        return Workspace(places, sizes, tuple(max(size, 1) for size in sizes.values()))
    places, end = {}, 0
    for name, size in sizes.items():
        places[name] = (0, end)
        end += -(-size // ALIGNMENT) * ALIGNMENT
    return Workspace(places, sizes, (max(end, 1),))
