"""Gaussians: the five raw tensors that the optimizer moves, and their activations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.rotation import rotation_matrices

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh")


@dataclass
class Gaussians:
    """``n`` anisotropic 3D Gaussians in their raw, unconstrained form (3DGS, Kerbl et al. 2023, sec. 4).

    World units; the object fits in the unit ball, +z is up, its front faces +x (azimuth 0).
    """

    means: Float[Tensor, "n 3"]  # world units
    log_scales: Float[Tensor, "n 3"]  # natural log of standard deviations in world units
    quats: Float[Tensor, "n 4"]  # wxyz, of any length > 0
    opacity_logits: Float[Tensor, "n"]
    sh: Float[Tensor, "n k 3"]  # k = (degree + 1)**2; 0 is view-independent

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Return the degree of the spherical harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Return standard deviations along the three axes of each Gaussian, in world units, > 0."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """Return opacities in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def rotations(self) -> Float[Tensor, "n 3 3"]:
        """Return matrices from each Gaussian's axes to world axes; the identity for a zero quaternion."""
        # Divide by the largest component first, because squares might leave the range of float32.
        largest = self.quats.detach().abs().amax(dim=-1, keepdim=True)
        return rotation_matrices(self.quats / largest.clamp_min(torch.finfo(largest.dtype).tiny))

    @property
    def device(self) -> torch.device:
        """Return the device of the tensors."""
        return self.means.device

    def tensors(self) -> dict[str, Tensor]:
        """Return the five tensors by field name, in the fixed order of ``FIELDS``, without copying."""
        return {name: getattr(self, name) for name in FIELDS}

    def map(self, change: Callable[[Tensor], Tensor]) -> "Gaussians":
        """Return new Gaussians, each tensor replaced by ``change(tensor)``."""
        return Gaussians(**{name: change(tensor) for name, tensor in self.tensors().items()})

    def index(self, rows: Int[Tensor, "rows"] | Bool[Tensor, "n"] | slice) -> "Gaussians":
        """Return the chosen rows, in the given order."""
        return self.map(lambda tensor: tensor[rows])

    def detach(self) -> "Gaussians":
        """Return the same numbers, cut from the autograd graph."""
        return self.map(lambda tensor: tensor.detach())

    def to(self, target: torch.device | torch.dtype | str) -> "Gaussians":
        """Return the same Gaussians on another device or in another dtype."""
        return self.map(lambda tensor: tensor.to(target))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Return all rows of ``parts``, one after the other; they must share their SH degree."""
    columns = {name: [getattr(part, name) for part in parts] for name in FIELDS}
    return Gaussians(**{name: torch.cat(tensors) for name, tensors in columns.items()})
