"""RowEdit: the only way in which rows change. RowState: per-row tensors that follow an edit.

The three owners of rows (Gaussians, optimizer moments, densifier state) follow the same edit, so they cannot
disagree.
"""

from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from cadam3d.core.gaussians import Gaussians, concatenate

# Not typing.Self, because run-time type checkers refuse it on plain methods.
State = TypeVar("State", bound="RowState")


@dataclass(frozen=True)
class RowEdit:
    """The rows that survive, and the rows that are appended after them."""

    keep: Int[Tensor, "kept"]  # old row numbers of the survivors, ascending
    children: Gaussians  # appended after the survivors
    parents: Int[Tensor, "born"]  # old row number of each child's parent

    def __post_init__(self) -> None:
        assert len(self.children) == self.parents.shape[0], "every child has one parent"

    @property
    def rows_after(self) -> int:
        """Return the number of rows after the edit."""
        return self.keep.shape[0] + len(self.children)

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Return the survivors, then the children, as a new object without autograd history."""
        return concatenate([gaussians.detach().index(self.keep), self.children.detach()])

    def carry(self, rows: Tensor) -> Tensor:
        """Return a per-row tensor after the edit: survivors keep their values, newborns start at zero."""
        newborn = rows.new_zeros((len(self.children), *rows.shape[1:]))
        return torch.cat([rows[self.keep], newborn])


@dataclass
class RowState:
    """Base of every per-row state: a dataclass whose fields are tensors with one row per Gaussian.

    Newborns start at zero, which for CAdam is the paper's rule (m = v = 0, age = 0; sec. 4.2).
    """

    def carry(self: State, edit: RowEdit) -> State:
        """Return the state after ``edit``."""
        return type(self)(**{field.name: edit.carry(getattr(self, field.name)) for field in fields(self)})

    def to_dict(self) -> dict[str, Tensor]:
        """Return the tensors by name, for a checkpoint."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
