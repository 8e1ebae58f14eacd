"""Launcher: the interface between the CUDA rasterizer and whatever executes its kernels."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager

import torch

# launch(kernel, blocks, threads, *arguments) starts ``blocks`` blocks of ``threads`` threads. An argument is
# a tensor, which is passed as its address, a whole number, or None, which is passed as a null pointer.
Launch = Callable[..., None]


class Launcher(ABC):
    """Executes compiled kernels: on a GPU through the CUDA driver, or in the emulator of the tests."""

    @abstractmethod
    def on(self, device: torch.device) -> AbstractContextManager[Launch]:
        """Yield the :data:`Launch` function for ``device`` and its current stream."""
