"""RowEdit: Gaussians and per-row states follow the same edit."""

from dataclasses import dataclass

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.gaussians import FIELDS, Gaussians


@dataclass
class Statistics(RowState):
    strength: Float[Tensor, "n 3"]
    age: Int[Tensor, "n"]


def numbered(first: int, n: int) -> Gaussians:
    """Return Gaussians with a different number in every row."""
    rows = torch.arange(first, first + n, dtype=torch.float32)
    return Gaussians(
        means=rows[:, None].repeat(1, 3),
        log_scales=rows[:, None].repeat(1, 3),
        quats=rows[:, None].repeat(1, 4),
        opacity_logits=rows,
        sh=rows[:, None, None].repeat(1, 4, 3),
    )


def edit_of(keep: list[int], born: int) -> RowEdit:
    return RowEdit(
        keep=torch.tensor(keep, dtype=torch.int64),
        children=numbered(100, born),
        parents=torch.zeros(born, dtype=torch.int64),
    )


@pytest.mark.parametrize(("keep", "born"), [([0, 2, 3], 2), ([], 3), ([0, 1, 2, 3, 4], 0), ([], 0)])
def test_survivors_come_first_in_order_then_the_children(keep, born):
    edit = edit_of(keep, born)
    after = edit.apply(numbered(0, 5))
    expected = torch.tensor([*keep, *range(100, 100 + born)], dtype=torch.float32)
    assert edit.rows_after == len(after) == len(keep) + born
    for name in FIELDS:
        rows = getattr(after, name).flatten()
        assert torch.equal(rows, expected.repeat_interleave(rows.shape[0] // max(len(after), 1))), name


def test_states_follow_the_same_rows_and_newborns_start_at_zero():
    state = Statistics(strength=torch.arange(15.0).reshape(5, 3) + 1, age=torch.arange(5) + 1)
    after = state.carry(edit_of([1, 4], born=3))
    assert isinstance(after, Statistics)
    assert after.age.tolist() == [2, 5, 0, 0, 0]
    assert after.age.dtype == torch.int64
    assert torch.equal(after.strength[:2], state.strength[[1, 4]])
    assert not after.strength[2:].any()


def test_an_edit_does_not_modify_its_arguments():
    gaussians, state = (
        numbered(0, 5),
        Statistics(strength=torch.ones(5, 3), age=torch.ones(5, dtype=torch.int64)),
    )
    edit = edit_of([1], born=1)
    edit.apply(gaussians)
    state.carry(edit)
    assert torch.equal(gaussians.opacity_logits, torch.arange(5.0))
    assert state.age.tolist() == [1] * 5


def test_every_child_has_one_parent():
    with pytest.raises(AssertionError, match="parent"):
        RowEdit(keep=torch.arange(2), children=numbered(0, 2), parents=torch.tensor([0]))
