"""Trials: what a rater sees, in which order and on which side, drawn from a seed.

A *trial* is a description and two clips, about which a rater answers all questions. A *catch trial* shows a
clip beside a ruined clip of another object, so that each of its questions has one right answer.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

from cadam3d.study.runs import RunPair, StudyRun

LEAST_CATCHES = 2


@dataclass(frozen=True)
class ClipSource:
    """The run that a clip shows, and whether it is ruined."""

    run: StudyRun
    is_ruined: bool  # so blurred and noisy that nothing can be recognised


@dataclass(frozen=True)
class Trial:
    """A description and the numbers of two clips."""

    prompt: str
    clips: tuple[int, int]  # on the first and on the second side
    right: int | None = None  # of a catch trial: the clip that must be chosen


@dataclass(frozen=True)
class StudyPlan:
    """All trials in their order, and the source of each clip by its number."""

    sources: tuple[ClipSource, ...]
    trials: tuple[Trial, ...]


# A trial before its clips have numbers: prompt, both sides, and the right one of a catch trial.
Sides = tuple[str, tuple[ClipSource, ClipSource], ClipSource | None]


def catch_count(pairs: int, share: float) -> int:
    """Return the number of catch trials: ``share`` of the pairs, rounded, and at least two unless it is 0.

    With two of them, a rater who always chooses the same side fails.
    """
    return max(LEAST_CATCHES, round(share * pairs)) if share > 0 else 0


def make_plan(
    pairs: Sequence[RunPair], visible: Sequence[StudyRun], catches: int, generator: Random
) -> StudyPlan:
    """Return the trials of a study: every pair once, and ``catches`` catch trials spread among them.

    Of any two arms, each is on the first side equally often, up to one trial. Catch trials show runs in
    ``visible``, which must not be empty, and the right clip is on each side equally often.
    """
    trials = generator.sample(_balanced(pairs, generator), len(pairs))
    checks = _catch_trials(visible, catches, generator)
    # The study has one section for each catch trial, so that a rater who stops early has seen some of them.
    for number, check in reversed(list(enumerate(checks))):
        low, high = (len(trials) * k // len(checks) for k in (number, number + 1))
        trials.insert(generator.randint(low, max(low, high - 1)) if high > low else low, check)
    # The number of a clip must not show its arm.
    sources = sorted(
        {source for _, sides, _ in trials for source in sides},
        key=lambda source: (source.run.prompt, source.run.arm, str(source.run.folder), source.is_ruined),
    )
    generator.shuffle(sources)
    numbers = {source: number for number, source in enumerate(sources)}
    shown = [
        Trial(prompt, (numbers[one], numbers[other]), None if right is None else numbers[right])
        for prompt, (one, other), right in trials
    ]
    return StudyPlan(tuple(sources), tuple(shown))


def _balanced(pairs: Sequence[RunPair], generator: Random) -> list[Sides]:
    """Return every pair as a trial, with sides that are drawn evenly for each two arms."""
    of_arms: dict[tuple[str, str], list[RunPair]] = defaultdict(list)
    for pair in pairs:
        of_arms[pair.arms].append(pair)
    trials: list[Sides] = []
    for arms in sorted(of_arms):
        members = of_arms[arms]
        for pair, is_turned in zip(members, _evenly(len(members), generator), strict=True):
            one, other = (ClipSource(run, is_ruined=False) for run in pair.runs)
            trials.append((pair.prompt, (other, one) if is_turned else (one, other), None))
    return trials


def _catch_trials(visible: Sequence[StudyRun], count: int, generator: Random) -> list[Sides]:
    """Return catch trials. Runs repeat only after each of them has been shown."""
    drawn = generator.sample(list(visible), len(visible))
    trials: list[Sides] = []
    for number, is_turned in enumerate(_evenly(count, generator)):
        run = drawn[number % len(drawn)]
        # A ruined clip of another object also fails to match the description.
        others = [other for other in drawn if other.prompt != run.prompt]
        right = ClipSource(run, is_ruined=False)
        wrong = ClipSource(generator.choice(others or [run]), is_ruined=True)
        trials.append((run.prompt, (wrong, right) if is_turned else (right, wrong), right))
    return trials


def _evenly(count: int, generator: Random) -> list[bool]:
    """Return ``count`` truth values in random order, of which half are true; an odd one is drawn."""
    first = generator.randint(0, 1)
    return generator.sample([(first + i) % 2 == 1 for i in range(count)], count)
