"""Launcher: the interface between the CUDA rasterizer and whatever executes its kernels."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager

import torch

# launch(kernel, blocks, threads, *arguments) starts ``blocks`` blocks of ``threads`` threads. An argument is
# a whole number. An array is passed as its address, and an array that is left out as 0.
Launch = Callable[..., None]


class Launcher(ABC):
    """Executes compiled kernels: on a GPU through the CUDA driver, or in the emulator of the tests."""

    @abstractmethod
    def on(self, device: torch.device) -> AbstractContextManager[Launch]:
        """Yield the :data:`Launch` function for ``device`` and its current stream."""
