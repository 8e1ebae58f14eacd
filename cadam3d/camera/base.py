"""CameraSampler: where to look at each training step."""

from abc import ABC, abstractmethod

import torch

from cadam3d.core.cameras import Cameras


class CameraSampler(ABC):
    """Draws the training views. Frozen hyper-parameters; the randomness comes in through the generator."""

    @abstractmethod
    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """``views`` cameras for ``step`` (0 is the first), on the CPU; all draws come from ``generator``."""

    def check_views(self, views: int) -> None:  # noqa: B027 (most samplers can draw any number)
        """Raise ``UserError`` if there cannot be ``views`` per step; asked before anything is loaded."""
