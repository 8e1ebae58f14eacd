"""Initializer: the Gaussians that training starts from."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from cadam3d.core.gaussians import Gaussians


@dataclass(frozen=True)
class Beginning:
    """What a run starts from."""

    gaussians: Gaussians
    note: str | None = None  # for the user and the summary, where it is not what was asked for: why, and what


class Initializer(ABC):
    """Builds the initial Gaussians. Frozen hyper-parameters."""

    @abstractmethod
    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Initial Gaussians on ``device``; every random draw comes from the (CPU) ``generator``."""

    def begin(self, prompt: str, generator: torch.Generator, device: torch.device) -> Beginning:
        """What :meth:`build` builds, or what stands in for it, with a note. By default nothing stands in."""
        return Beginning(self.build(prompt, generator, device))
