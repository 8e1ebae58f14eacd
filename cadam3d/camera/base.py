"""CameraSampler: the interface that chooses the viewpoints of each training step."""

from abc import ABC, abstractmethod

import torch

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import Declared


class CameraSampler(Declared, ABC):
    """Draws the training views. Holds frozen hyper-parameters; all randomness comes from the generator."""

    @abstractmethod
    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Draw ``views`` cameras for ``step`` (0 is the first), on the CPU, from ``generator`` alone."""

    def check_views(self, views: int) -> None:
        """Raise ``UserError`` if the sampler cannot draw ``views`` per step; called before any loading."""
