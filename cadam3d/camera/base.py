"""CameraSampler: where to look at each training step."""

from abc import ABC, abstractmethod

import torch

from cadam3d.core.cameras import Cameras


class CameraSampler(ABC):
    """Draws the training views. Frozen hyper-parameters; the randomness comes in through the generator."""

    @abstractmethod
    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """``views`` cameras for ``step`` (0 is the first), on the CPU; all draws come from ``generator``."""
