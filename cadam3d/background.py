"""Background: the colour behind the Gaussians. A random colour keeps them from imitating the background."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import Color, Declared, Share


class Background(Declared, ABC):
    """Draws one colour per training view. Holds frozen hyper-parameters."""

    @abstractmethod
    def sample(self, views: int, generator: torch.Generator) -> Float[Tensor, "v 3"]:
        """Return RGB in [0, 1] for each of ``views`` views, on the CPU, drawn from ``generator`` alone."""


@dataclass(frozen=True, kw_only=True)
class ConstantBackground(Background):
    """The same colour behind every view."""

    color: Color

    def sample(self, views: int, generator: torch.Generator) -> Float[Tensor, "v 3"]:
        """Return the colour, repeated for every view."""
        return _rgb(self.color).repeat(views, 1)


@dataclass(frozen=True, kw_only=True)
class RandomBackground(Background):
    """A uniformly random colour in some views and the constant one in the others, drawn for each view.

    With ``shared``, all views of a step have the same colour, as a model of several views has seen them.
    """

    probability: Share
    color: Color
    shared: bool

    def sample(self, views: int, generator: torch.Generator) -> Float[Tensor, "v 3"]:
        """Return one colour per view; the number of random draws does not depend on their outcome."""
        count = 1 if self.shared else views
        is_random = torch.rand(count, 1, generator=generator) < self.probability
        colors = torch.rand(count, 3, generator=generator)
        return torch.where(is_random, colors, _rgb(self.color)).expand(views, 3).contiguous()


@dataclass(frozen=True, kw_only=True)
class LucidBackground(Background):
    """Black, a random colour or the constant one, drawn for each view (LucidDreamer)."""

    probability: Share
    black: Share
    color: Color

    def sample(self, views: int, generator: torch.Generator) -> Float[Tensor, "v 3"]:
        """Return one colour per view; the number of random draws does not depend on their outcome."""
        is_other = torch.rand(views, 1, generator=generator) < self.probability
        is_black = torch.rand(views, 1, generator=generator) < self.black
        colors = torch.where(is_black, 0.0, torch.rand(views, 3, generator=generator))
        return torch.where(is_other, colors, _rgb(self.color))


@dataclass(frozen=True, kw_only=True)
class BlackOrWhite(Background):
    """White with probability ``white`` and otherwise black, drawn for each view (DreamGaussian)."""

    white: Share

    def sample(self, views: int, generator: torch.Generator) -> Float[Tensor, "v 3"]:
        """Return black or white for each view."""
        return (torch.rand(views, 1, generator=generator) < self.white).float().repeat(1, 3)


def _rgb(color: Sequence[float]) -> Float[Tensor, "3"]:
    return torch.tensor([float(channel) for channel in color])
