"""TruthSource: where the true object of a run comes from, with which its asset is compared."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from cadam3d.core.render import Truth
from cadam3d.prior.base import DiffusionPrior


class TruthSource(ABC):
    """Names the true object of a prompt. A subclass is a frozen dataclass of its settings."""

    # Whether the Gaussians at the start of a run are measured too, as a baseline for those at its end.
    measures_start: ClassVar[bool] = False

    @abstractmethod
    def of(self, prompt: str, prior: DiffusionPrior) -> Truth | None:
        """Return the true object of ``prompt`` for a run with ``prior``, or None if there is none.

        This is called before training, so it should not compute images yet. Raises ``UserError`` for a prompt
        that the source cannot read.
        """


@dataclass(frozen=True, kw_only=True)
class PriorTruth(TruthSource):
    """The truth of the prior itself, if the prior knows one."""

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth | None:
        """Return the truth of ``prior``, or None if it knows none."""
        return prior.truth(prompt)


@dataclass(frozen=True, kw_only=True)
class NoTruth(TruthSource):
    """No truth, so nothing is compared."""

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth | None:
        """Return None."""
        return None
