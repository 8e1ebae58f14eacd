"""Schedules: numbers that depend on the training step. They are pure, printable values.

``Linear(start=1e-3, end=1e-5, steps=600)(300)`` is a number; a schedule has no state that training changes.
"""

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from cadam3d.core.checks import Count, Declared, Positive, are_numbers, whole, within

# A step at which every schedule has its final value.
FAR_STEP = 10**9


class Schedule(Declared, ABC):
    """A number that depends on the optimization step (0 is the first step)."""

    @property
    def extremes(self) -> Sequence[float]:
        """Return values that include the smallest and the largest: here, the first and the last."""
        return self(0), self(FAR_STEP)

    @abstractmethod
    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""


@dataclass(frozen=True)
class Constant(Schedule):
    """The same value at every step."""

    value: Annotated[float, within()]

    def __call__(self, step: int) -> float:
        """Return the value, whatever the step."""
        return self.value


@dataclass(frozen=True)
class _Ramp(Schedule):
    """From ``start`` at step ``begin`` to ``end`` at ``steps`` steps later, and constant before and after."""

    start: Annotated[float, within()]
    end: Annotated[float, within()]
    steps: Count
    begin: Annotated[int, whole()] = 0

    def _progress(self, step: int) -> float:
        """Return the share of the way that is done at ``step``, in [0, 1]."""
        return min(max((step - self.begin) / self.steps, 0.0), 1.0)


@dataclass(frozen=True)
class Linear(_Ramp):
    """A straight line from ``start`` at step ``begin`` to ``end``, ``steps`` steps later."""

    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""
        return self.start + (self.end - self.start) * self._progress(step)


@dataclass(frozen=True)
class LogLinear(_Ramp):
    """Like :class:`Linear`, but in the logarithm: equal factors over equal times, as for 3DGS' rates."""

    start: Positive
    end: Positive

    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""
        progress = self._progress(step)
        return math.exp(math.log(self.start) * (1 - progress) + math.log(self.end) * progress)


@dataclass(frozen=True)
class Steps(Schedule):
    """``values[i]`` from ``milestones[i - 1]`` on; ``values[0]`` before the first milestone."""

    values: Sequence[float]
    milestones: Sequence[int]

    def __post_init__(self) -> None:
        self.expect(
            are_numbers(self.values, low=-sys.float_info.max, high=sys.float_info.max)
            and are_numbers(self.milestones, low=-FAR_STEP, high=FAR_STEP)
            and len(self.values) == len(self.milestones) + 1
            and list(self.milestones) == sorted(self.milestones),
            "values",
            f"one number more than milestones, which ascend: {self.milestones}",
        )

    @property
    def extremes(self) -> Sequence[float]:
        """Return all values."""
        return self.values

    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""
        return self.values[sum(step >= milestone for milestone in self.milestones)]


def as_schedule(value: float | Schedule) -> Schedule:
    """Return ``value`` as a schedule; a plain number becomes a constant one."""
    return value if isinstance(value, Schedule) else Constant(float(value))
