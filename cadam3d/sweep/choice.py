"""Choice: the best of several attempts at one run by one number, and the sentence that says why it is.

All functions are pure.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean

from cadam3d.core.checks import require_choice, require_whole
from cadam3d.core.quality import AT_BEST_TURN, QUALITIES, Quality

# Without select=, the first of these numbers that an attempt has decides: a comparison with the truth, then
# the preferences of people, then agreement with the prompt.
PREFERRED = ("psnr", "image_reward", "hps", "pick_score", "vqa", "clip_score")
MOST_ATTEMPTS = 1000
# The numbers by which attempts can be compared.
SELECTABLE = tuple(name for name, quality in QUALITIES.items() if quality.is_more_better is not None)


@dataclass(frozen=True)
class Attempt:
    """One attempt, with the numbers of its asset. Without an asset that can be compared it has none."""

    seed: int
    measured: Mapping[str, float] = field(default_factory=dict)
    evaluated: Mapping[str, float] = field(default_factory=dict)  # by cadam3d eval, after training


@dataclass(frozen=True)
class Choice:
    """The best of several attempts."""

    quality: Quality
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
        written = self.quality.written
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
        return self.quality.label if self.quality.is_more_better else f"{self.quality.label} (less is better)"


def require_attempts(attempts: object, select: object) -> None:
    """Raise ``UserError`` for wrong values of the settings ``attempts`` and ``select``."""
    require_whole("attempts", attempts, low=1, high=MOST_ATTEMPTS, example=4)
    if select is not None:
        require_choice("select", select, SELECTABLE)


def choose(attempts: Sequence[Attempt], select: str | None) -> Choice | None:
    """Return the best attempt by the number ``select``; None if no attempt has that number.

    ``None`` stands for the first of ``PREFERRED`` that an attempt has. The numbers of an evaluation after
    training count only if training has measured none of them in any attempt, because both may have been
    measured with different settings. Of attempts with equal numbers, the one with the lowest seed is the
    best.
    """
    for name in PREFERRED if select is None else (select,):
        for key in filter(None, (AT_BEST_TURN.get(name), name)):
            for numbers in (
                {attempt.seed: attempt.measured for attempt in attempts},
                {attempt.seed: attempt.evaluated for attempt in attempts},
            ):
                values = {seed: known[key] for seed, known in numbers.items() if key in known}
                if values:
                    merit = QUALITIES[key].merit
                    ordered = sorted(values, key=lambda seed: (-merit(values[seed]), seed))
                    without = sorted(seed for seed in numbers if seed not in values)
                    return Choice(QUALITIES[key], {seed: values[seed] for seed in ordered}, without)
    return None


def known_numbers(attempts: Sequence[Attempt]) -> list[str]:
    """Return the numbers by which these attempts can be compared, which at least one of them has."""
    known = {name for attempt in attempts for name in (*attempt.measured, *attempt.evaluated)}
    return [name for name in SELECTABLE if name in known]


def _seeds(seeds: Sequence[int]) -> str:
    return ", ".join(f"seed={seed}" for seed in seeds)
