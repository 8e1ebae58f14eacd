"""Initializer: the Gaussians that training starts from."""

from abc import ABC, abstractmethod

import torch

from cadam3d.core.gaussians import Gaussians


class Initializer(ABC):
    """Builds the initial Gaussians. Frozen hyper-parameters."""

    @abstractmethod
    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Initial Gaussians on ``device``; every random draw comes from the (CPU) ``generator``."""
