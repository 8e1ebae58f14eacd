"""RenderOutput: the result of every rasterizer. RenderFn: renders Gaussians. Truth: the true object."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, vertical_turn
from cadam3d.core.device import read_numbers
from cadam3d.core.gaussians import Gaussians

# Alpha from which a pixel counts as object when disparities are stretched to [0, 1].
SOLID = 0.9
# Spread of inverse depths, per world unit, below which disparities are not stretched.
FLAT = 1e-6


class OverflowedError(Exception):
    """Too little memory was reserved for a render, so its images and gradients are meaningless."""


@dataclass(frozen=True)
class RenderOutput:
    """Images of ``v`` views, and the per-view numbers that densifiers need."""

    rgb: Float[Tensor, "v h w 3"]  # composited over the background; not clamped above
    alpha: Float[Tensor, "v h w"]  # in [0, 1)
    # Expected camera z, sum(w z) / sum(w), in world units; 0 where alpha is 0.
    depth: Float[Tensor, "v h w"]
    means2d: Float[Tensor, "v n 2"]  # pixels; keeps its gradient while training; meaningless if not seen
    radii: Float[Tensor, "v n"]  # pixels; 0 = not seen
    # Zeros, only on request and if gradients are on. The gradient that a backward pass leaves on them is not
    # a derivative but the sum over pixels of |dLoss/dmeans2d|, separately for each axis (AbsGS).
    absgrad: Float[Tensor, "v n 2"] | None = None
    # Whether the memory that was reserved ahead was too small, on the device. Then the images show only the
    # background and all gradients are zero. None if the memory always suffices.
    overflowed: Bool[Tensor, ""] | None = None

    @property
    def visible(self) -> Bool[Tensor, "v n"]:
        """Return the mask of Gaussians that touched each view."""
        return self.radii > 0

    def read(self, numbers: Sequence[Tensor | float]) -> list[float]:
        """Return numbers that follow from the images, after waiting once for the device that renders.

        Raises :class:`OverflowedError` if the images are meaningless, which is known only then.
        """
        flag = False if self.overflowed is None else self.overflowed
        overflowed, *read = read_numbers([flag, *numbers], self.rgb.device)
        if overflowed:
            raise OverflowedError
        return read

    def disparity(self) -> Float[Tensor, "v h w"]:
        """Return closeness as a grey image in [0, 1], with gradient; the nearest point of the object is 1.

        This is inverse depth times alpha, which puts the background infinitely far away, stretched per view:
        the farthest solid pixel (alpha from 0.9 on) becomes 0, and everything farther stays 0. The result
        does not depend on the unit of length.

        LucidDreamer stretches 1 / (alpha depth + 10 (1 - alpha)), which puts the background at a depth of 10
        in its units. The two pictures are equal if every alpha is 0 or 1.
        """
        is_hit = self.alpha > 0
        inverse = torch.where(is_hit, self.alpha / torch.where(is_hit, self.depth, 1.0), 0.0)
        is_solid = self.alpha >= SOLID
        farthest = torch.where(is_solid, inverse, torch.inf).amin(dim=(1, 2), keepdim=True)
        farthest = torch.where(is_solid.any(dim=2).any(dim=1)[:, None, None], farthest, 0.0)
        spread = (inverse.amax(dim=(1, 2), keepdim=True) - farthest).clamp_min(FLAT)
        return ((inverse - farthest) / spread).clamp(0, 1)


@runtime_checkable
class RenderFn(Protocol):
    """A function that renders given Gaussians, without gradients."""

    def __call__(
        self, cameras: Cameras, background: Float[Tensor, "v 3"], shown: Gaussians | None = None
    ) -> RenderOutput:
        """Return images with one RGB background per view, in [0, 1].

        ``shown`` replaces the given Gaussians, for example by the same ones in other colours.
        """
        ...


@dataclass(frozen=True)
class Subject:
    """One asset of a picture that shows several."""

    gaussians: Gaussians
    render: RenderFn  # shows these Gaussians
    label: str = ""  # written under it


# Vertices "v 3" and triangles "f 3".
Triangles = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Truth:
    """The true object of a prompt, with which an asset is compared.

    It has ``m`` modes, more than one if the prompt leaves something open.
    """

    # From cameras and one background per view, "v 3", to the true images of each mode, "m v h w 3" in [0, 1].
    images: Callable[[Cameras, Tensor], Tensor]
    # The surface of each mode in world units, or a single one if all modes share it. None if the shape is not
    # known.
    surfaces: Callable[[], list[Triangles]] | None = None
    # From cameras to the alpha of each mode, "m v h w" in [0, 1]. None if the outlines are not known.
    alpha: Callable[[Cameras], Tensor] | None = None
    # The asset may face any side, and this many turns about the vertical axis are tried, evenly spaced. None
    # if the front of the asset is known to be at azimuth 0.
    turns: int | None = None
    # The turn at which the object fits the asset best, in (-180, 180] degrees, counterclockwise seen from
    # above. None until it has been searched (``metric/turn.py``), and if the front is known.
    turn_deg: float | None = None

    def turned(self) -> "Truth":
        """Return the object as the asset faces, turned by ``turn_deg``."""
        if not self.turn_deg:
            return self
        images, surfaces, alpha, turn_deg = self.images, self.surfaces, self.alpha, self.turn_deg

        def surfaces_there() -> list[Triangles]:
            assert surfaces is not None
            turn = vertical_turn(turn_deg, torch.zeros(1, dtype=torch.float64))[:3, :3].numpy()
            return [(vertices @ turn.T, faces) for vertices, faces in surfaces()]

        def alpha_there(cameras: Cameras) -> Tensor:
            assert alpha is not None
            return alpha(cameras.turned(-turn_deg))

        return replace(
            self,
            images=lambda cameras, background: images(cameras.turned(-turn_deg), background),
            surfaces=None if surfaces is None else surfaces_there,
            alpha=None if alpha is None else alpha_there,
            turns=None,
            turn_deg=None,
        )
