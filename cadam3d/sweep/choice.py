"""Choice: the best of several attempts at one run by one number, and the sentence that says why it is.

All functions are pure.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean

from cadam3d.core.checks import require_whole
from cadam3d.core.number import Number

MOST_ATTEMPTS = 1000


@dataclass(frozen=True)
class Attempt:
    """One attempt, with the numbers of its asset. Without an asset that can be compared it has none."""

    seed: int
    measured: Mapping[str, float] = field(default_factory=dict)
    evaluated: Mapping[str, float] = field(default_factory=dict)  # by cadam3d eval, after training
    declared: Mapping[str, Number] = field(default_factory=dict)  # what is known about these numbers


@dataclass(frozen=True)
class Choice:
    """The best of several attempts."""

    number: Number
    values: Mapping[int, float]  # by seed, the best first; at least one
    without: Sequence[int]  # the seeds of the attempts that do not have this number

    @property
    def best(self) -> int:
        """Return the seed of the best attempt."""
        return next(iter(self.values))

    @property
    def sentence(self) -> str:
        """Say which attempt is the best, by how much, and how far its number can be trusted."""
        (best, value), *others = self.values.items()
        written = self.number.written
        left_out = f" Without this number: {_seeds(self.without)}." if self.without else ""
        if not others:
            return f"seed={best} is the only attempt with {self._label}: {written(value)}.{left_out}"
        second, runner_up = others[0]
        if runner_up == value:
            ahead = f"the same as seed={second}, and of equal attempts the one with the lowest seed is chosen"
        else:
            ahead = f"ahead of seed={second} with {written(runner_up)}"
        low, high = min(self.values.values()), max(self.values.values())
        average = written(mean(self.values.values()))
        return (
            f"The best of {len(self.values)} attempts by {self._label} is seed={best} with {written(value)}, "
            f"{ahead}. All of them have {written(low)} to {written(high)}, {average} on average, "
            "which is what to expect of another seed: the best of several is partly luck."
            f"{left_out}"
        )

    @property
    def _label(self) -> str:
        return self.number.label if self.number.is_more_better else f"{self.number.label} (less is better)"


def require_attempts(attempts: object) -> None:
    """Raise ``UserError`` for a wrong value of the setting ``attempts``."""
    require_whole("attempts", attempts, low=1, high=MOST_ATTEMPTS, example=4)


def choose(attempts: Sequence[Attempt], select: str | None) -> Choice | None:
    """Return the best attempt by the number ``select``; None if no attempt has that number.

    ``None`` stands for the most preferred number that an attempt has (``Number.preference``). The numbers of
    an evaluation after training count only if training has measured none of them in any attempt, because both
    may have been measured with different settings. Of attempts with equal numbers, the one with the lowest
    seed is the best.
    """
    known = {name: number for attempt in attempts for name, number in attempt.declared.items()}
    for name in preferred(known.values()) if select is None else (select,):
        replacing = [number.name for number in known.values() if number.replaces == name]
        for key in (*replacing, name):
            for numbers in (
                {attempt.seed: attempt.measured for attempt in attempts},
                {attempt.seed: attempt.evaluated for attempt in attempts},
            ):
                values = {seed: own[key] for seed, own in numbers.items() if key in own}
                if values:
                    merit = known[key].merit
                    ordered = sorted(values, key=lambda seed: (-merit(values[seed]), seed))
                    without = sorted(seed for seed in numbers if seed not in values)
                    return Choice(known[key], {seed: values[seed] for seed in ordered}, without)
    return None


def known_numbers(attempts: Sequence[Attempt]) -> list[str]:
    """Return the numbers by which these attempts can be compared, which at least one of them has."""
    known = {name for attempt in attempts for name in (*attempt.measured, *attempt.evaluated)}
    declared = dict.fromkeys(name for attempt in attempts for name in attempt.declared)
    return [name for name in declared if name in known]


def preferred(numbers: Iterable[Number]) -> list[str]:
    """Return the names of the numbers that decide without ``select=``, the most preferred first."""
    ranks = {each.name: each.preference for each in numbers if each.preference is not None}
    return sorted(ranks, key=lambda name: ranks[name])


def _seeds(seeds: Sequence[int]) -> str:
    return ", ".join(f"seed={seed}" for seed in seeds)
