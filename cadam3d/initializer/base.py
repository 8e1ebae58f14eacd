"""Initializer: the interface that builds the Gaussians that training starts from."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from cadam3d.core.checks import Declared
from cadam3d.core.gaussians import Gaussians


@dataclass(frozen=True)
class Beginning:
    """The initial Gaussians of a run, with a note if they are not the requested ones.

    The note names the fallback and the reason. It appears on the console and in the summary.
    """

    gaussians: Gaussians
    note: str | None = None


class Initializer(Declared, ABC):
    """Builds the initial Gaussians. Holds frozen hyper-parameters."""

    @abstractmethod
    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return initial Gaussians on ``device``; all random numbers come from the CPU ``generator``."""

    def begin(self, prompt: str, generator: torch.Generator, device: torch.device) -> Beginning:
        """Return the result of :meth:`build`, or a fallback's result with a note.

        This implementation has no fallback: errors of :meth:`build` are raised.
        """
        return Beginning(self.build(prompt, generator, device))
