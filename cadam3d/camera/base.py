"""CameraSampler: the interface that chooses the viewpoints of each training step."""

from abc import ABC, abstractmethod

import torch

from cadam3d.core.cameras import Cameras


class CameraSampler(ABC):
    """Draws the training views. Holds frozen hyper-parameters; all randomness comes from the generator."""

    @abstractmethod
    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Draw ``views`` cameras for ``step`` (0 is the first), on the CPU, from ``generator`` alone."""

    def check_views(self, views: int) -> None:  # noqa: B027 (most samplers can draw any number)
        """Raise ``UserError`` if the sampler cannot draw ``views`` per step; called before any loading."""
