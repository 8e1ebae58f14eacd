"""RowHistory: the age of each Gaussian and other numbers, by which a page can colour a snapshot of a run."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from cadam3d.callback.base import Callback
from cadam3d.state import RefineReport, RunContext, TrainState
from cadam3d.viewer.pack import pack


@dataclass(kw_only=True)
class RowHistory(Callback):
    """A callback that follows ages and selections through every refinement."""

    # For each Gaussian, the step after which it was born, and whether the last refinement selected it.
    _born: Int[Tensor, "n"] = field(init=False, repr=False)
    _is_selected: Bool[Tensor, "n"] = field(init=False, repr=False)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Begin with the Gaussians of ``state``, none of which is selected."""
        shape, device = (len(state.gaussians),), state.gaussians.device
        self._born = torch.full(shape, state.step, dtype=torch.int64, device=device)
        self._is_selected = torch.zeros(shape, dtype=torch.bool, device=device)

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Apply the edit of a refinement, and mark the children and the surviving parents as selected."""
        if (edit := report.edit) is not None:
            newborn = self._born.new_full((len(edit.children),), report.step)
            self._born = torch.cat([self._born[edit.keep], newborn])
            is_selected = report.population.is_selected
            self._is_selected = torch.cat([is_selected[edit.keep], is_selected[edit.parents]])

    def snapshot(self, context: RunContext, state: TrainState) -> bytes:
        """Return a snapshot (``viewer/pack.py``) with the densifier's scores, ``age`` and ``selected``.

        ``age`` is in steps, since birth or since :meth:`on_start`. ``selected`` is 1 for the children and the
        surviving parents of the last refinement, else 0.
        """
        layers = {
            **context.densifier.scores(state.densifier),
            "age": state.step - self._born,
            "selected": self._is_selected,
        }
        cpu = torch.device("cpu")
        shown = {name: values.detach().to(cpu, torch.float32) for name, values in layers.items()}
        return pack(state.gaussians.detach().to(cpu), shown)
