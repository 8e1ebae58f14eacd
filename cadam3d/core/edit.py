"""RowEdit: the only way rows change. RowState: per-row tensors that follow one.

Three owners of rows (Gaussians, optimizer moments, densifier state) follow one edit: they cannot disagree.
"""

from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from cadam3d.core.gaussians import Gaussians, concatenate

State = TypeVar("State", bound="RowState")  # not Self: run-time type checkers refuse it on plain methods


@dataclass(frozen=True)
class RowEdit:
    """Which rows survive, and who is appended after them."""

    keep: Int[Tensor, "kept"]  # old row numbers of the survivors, ascending
    children: Gaussians  # appended after the survivors
    parents: Int[Tensor, "born"]  # old row number of each child's parent

    def __post_init__(self) -> None:
        assert len(self.children) == self.parents.shape[0], "every child names one parent"

    @property
    def rows_after(self) -> int:
        """Number of rows once the edit is applied."""
        return self.keep.shape[0] + len(self.children)

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Survivors, then children; a new object without autograd history."""
        return concatenate([gaussians.detach().index(self.keep), self.children.detach()])

    def carry(self, rows: Tensor) -> Tensor:
        """Carry a per-row tensor through the edit: survivors keep their values, newborns start at zero."""
        newborn = rows.new_zeros((len(self.children), *rows.shape[1:]))
        return torch.cat([rows[self.keep], newborn])


@dataclass
class RowState:
    """Base of every per-row state: a dataclass whose fields are tensors with one row per Gaussian.

    Newborns start at zero, which for CAdam is the paper's rule (m = v = 0, age = 0; sec. 4.2).
    """

    def carry(self: State, edit: RowEdit) -> State:
        """The state after ``edit``."""
        return type(self)(**{field.name: edit.carry(getattr(self, field.name)) for field in fields(self)})

    def to_dict(self) -> dict[str, Tensor]:
        """The tensors by name, for a checkpoint."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
