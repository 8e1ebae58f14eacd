"""Schedules: numbers that depend on the training step. They are pure, printable values.

``Linear(start=1e-3, end=1e-5, steps=600)(300)`` is a number; a schedule has no state that training changes.
"""

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from cadam3d.core.checks import are_numbers, require, require_range, require_whole

FAR_STEP = 10**9  # by then every schedule has its final value


class Schedule(ABC):
    """A number that depends on the optimization step (0 is the first step)."""

    @abstractmethod
    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""


@dataclass(frozen=True)
class Constant(Schedule):
    """The same value at every step."""

    value: float

    def __post_init__(self) -> None:
        require_range("schedule.value", self.value, example=0.001)

    def __call__(self, step: int) -> float:
        """Return the value, whatever the step."""
        return self.value


@dataclass(frozen=True)
class Linear(Schedule):
    """From ``start`` at step ``begin`` in a straight line to ``end`` ``steps`` later, then ``end``."""

    start: float
    end: float
    steps: int
    begin: int = 0

    def __post_init__(self) -> None:
        require_whole("schedule.steps", self.steps, low=1, example=600)
        require_whole("schedule.begin", self.begin, example=0)
        require_range("schedule.start", self.start, example=1e-3)
        require_range("schedule.end", self.end, example=1e-5)

    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""
        return self.start + (self.end - self.start) * _progress(step, self.begin, self.steps)


@dataclass(frozen=True)
class LogLinear(Schedule):
    """Like :class:`Linear`, but in the logarithm: equal factors over equal times, as for 3DGS' rates."""

    start: float
    end: float
    steps: int
    begin: int = 0

    def __post_init__(self) -> None:
        require_whole("schedule.steps", self.steps, low=1, example=600)
        require_whole("schedule.begin", self.begin, example=0)
        require_range("schedule.start", self.start, above=0, example=1e-3)
        require_range("schedule.end", self.end, above=0, example=1e-5)

    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""
        progress = _progress(step, self.begin, self.steps)
        return math.exp(math.log(self.start) * (1 - progress) + math.log(self.end) * progress)


@dataclass(frozen=True)
class Steps(Schedule):
    """``values[i]`` from ``milestones[i - 1]`` on; ``values[0]`` before the first milestone."""

    values: Sequence[float]
    milestones: Sequence[int]

    def __post_init__(self) -> None:
        require(
            are_numbers(self.values, low=-sys.float_info.max, high=sys.float_info.max)
            and are_numbers(self.milestones, low=-FAR_STEP, high=FAR_STEP)
            and len(self.values) == len(self.milestones) + 1
            and list(self.milestones) == sorted(self.milestones),
            "schedule.values",
            expected="one value more than milestones, all numbers, milestones ascending",
            got=(self.values, self.milestones),
            example="{values: [0.98, 0.5], milestones: [500]}",
        )

    def __call__(self, step: int) -> float:
        """Return the value at ``step``."""
        return self.values[sum(step >= milestone for milestone in self.milestones)]


def as_schedule(value: float | Schedule) -> Schedule:
    """Return ``value`` as a schedule; a plain number becomes a constant one."""
    return value if isinstance(value, Schedule) else Constant(float(value))


def require_scheduled(key: str, value: object, *, example: object, **bounds: float) -> None:
    """Raise unless ``value`` is a number in range, or a schedule whose first and final values are in range.

    ``bounds`` are those of :func:`~cadam3d.core.checks.require_range`: ``low``, ``high``, ``below`` and
    ``above``.
    """
    is_one = isinstance(value, int | float | Schedule)
    require(is_one, key, expected="a number or a schedule", got=value, example=f"{key}={example}")
    # Most mistakes are visible at one of the two ends.
    for step in (0, FAR_STEP):
        number = value(step) if isinstance(value, Schedule) else value
        require_range(key, number, example=example, **bounds)


def _progress(step: int, begin: int, steps: int) -> float:
    return min(max((step - begin) / steps, 0.0), 1.0)
