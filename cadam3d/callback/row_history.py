"""RowHistory: the age of each Gaussian and other numbers, by which a page can colour a snapshot of a run."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from cadam3d.state import RefineReport, RunContext, TrainState
from cadam3d.viewer.pack import pack


class RowHistory:
    """Ages and selections. A callback updates them at every refinement, because nothing else keeps them."""

    def __init__(self) -> None:
        # For each Gaussian, the step after which it was born, and whether the last refinement selected it.
        self.born: Int[Tensor, "n"] = torch.zeros(0, dtype=torch.int64)
        self.is_selected: Bool[Tensor, "n"] = torch.zeros(0, dtype=torch.bool)

    def start(self, state: TrainState) -> None:
        """Begin with the Gaussians of ``state``, none of which is selected."""
        shape, device = (len(state.gaussians),), state.gaussians.device
        self.born = torch.full(shape, state.step, dtype=torch.int64, device=device)
        self.is_selected = torch.zeros(shape, dtype=torch.bool, device=device)

    def follow(self, report: RefineReport) -> None:
        """Apply the edit of a refinement, and mark the children and the surviving parents as selected."""
        edit = report.edit
        if edit is None:
            return
        newborn = self.born.new_full((len(edit.children),), report.step)
        self.born = torch.cat([self.born[edit.keep], newborn])
        is_selected = report.population.is_selected
        self.is_selected = torch.cat([is_selected[edit.keep], is_selected[edit.parents]])

    def snapshot(self, context: RunContext, state: TrainState) -> bytes:
        """Return a snapshot (``viewer/pack.py``) with the densifier's scores, ``age`` and ``selected``.

        ``age`` is in steps, since birth or since :meth:`start`. ``selected`` is 1 for the children and the
        surviving parents of the last refinement, else 0.
        """
        layers = {
            **context.densifier.scores(state.densifier),
            "age": state.step - self.born,
            "selected": self.is_selected,
        }
        cpu = torch.device("cpu")
        shown = {name: values.detach().to(cpu, torch.float32) for name, values in layers.items()}
        return pack(state.gaussians.detach().to(cpu), shown)
