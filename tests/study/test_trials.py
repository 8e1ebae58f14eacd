"""The plan of a study: which pairs it shows, on which side, in which order, and its catch trials."""

from collections import Counter
from itertools import combinations
from pathlib import Path
from random import Random

import pytest

from cadam3d.study.runs import RunPair, StudyRun, draw_pairs
from cadam3d.study.trials import StudyPlan, make_plan

ARMS = ("heron", "ibis", "stork")


def runs_of(arms=ARMS, prompts=5, seeds=1) -> list[StudyRun]:
    return [
        StudyRun(Path(arm, f"{prompt}_{seed}"), arm, f"prompt {prompt}", seed)
        for arm in arms
        for prompt in range(prompts)
        for seed in range(seeds)
    ]


def pairs_of(runs: list[StudyRun]) -> list[RunPair]:
    return [
        RunPair((one, other) if one.arm < other.arm else (other, one))
        for one, other in combinations(runs, 2)
        if one.arm != other.arm and (one.prompt, one.seed) == (other.prompt, other.seed)
    ]


def planned(arms=ARMS, prompts=5, catches=3, seed=0) -> tuple[list[RunPair], StudyPlan]:
    runs = runs_of(arms, prompts)
    pairs = pairs_of(runs)
    return pairs, make_plan(pairs, runs, catches, Random(seed))


@pytest.mark.parametrize("seed", range(5))
def test_every_pair_appears_once_and_with_its_own_prompt(seed):
    pairs, plan = planned(seed=seed)
    shown = [
        (trial.prompt, frozenset(plan.sources[clip].run for clip in trial.clips))
        for trial in plan.trials
        if trial.right is None
    ]
    assert Counter(shown) == Counter((pair.prompt, frozenset(pair.runs)) for pair in pairs)


@pytest.mark.parametrize("prompts", [1, 2, 5, 8])
@pytest.mark.parametrize("seed", range(3))
def test_of_each_two_arms_one_is_on_the_first_side_as_often_as_the_other(prompts, seed):
    _, plan = planned(prompts=prompts, seed=seed)
    first: Counter = Counter()
    for trial in plan.trials:
        if trial.right is None:
            one, other = (plan.sources[clip].run.arm for clip in trial.clips)
            first[one, other] += 1
    for one, other in combinations(ARMS, 2):
        assert abs(first[one, other] - first[other, one]) <= prompts % 2


@pytest.mark.parametrize("seed", range(3))
def test_the_right_clip_of_catch_trials_is_on_both_sides_equally_often(seed):
    _, plan = planned(catches=6, seed=seed)
    right = [trial.clips.index(trial.right) for trial in plan.trials if trial.right is not None]
    assert right.count(0) == right.count(1) == 3


def test_a_catch_trial_has_a_whole_clip_of_its_prompt_and_a_ruined_one_of_another():
    _, plan = planned()
    catches = [trial for trial in plan.trials if trial.right is not None]
    assert len(catches) == 3
    for trial in catches:
        [wrong] = set(trial.clips) - {trial.right}
        assert not plan.sources[trial.right].is_ruined
        assert plan.sources[trial.right].run.prompt == trial.prompt
        assert plan.sources[wrong].is_ruined
        assert plan.sources[wrong].run.prompt != trial.prompt


def test_catch_trials_are_spread_over_the_study():
    """Each third of the study has one of three, so that a rater who stops early has seen some."""
    pairs, plan = planned(prompts=20)
    places = [i for i, trial in enumerate(plan.trials) if trial.right is not None]
    length = len(pairs) / 3
    for number, place in enumerate(places):
        assert number * length <= place - number < (number + 1) * length


def test_the_seed_decides_order_sides_and_numbers():
    assert planned(seed=1) == planned(seed=1)
    assert planned(seed=1)[1].trials != planned(seed=2)[1].trials


def test_the_number_of_a_clip_does_not_show_its_arm():
    """Over many seeds, every number belongs to every arm about equally often."""
    arms = Counter(planned(catches=0, seed=seed)[1].sources[0].run.arm for seed in range(300))
    assert min(arms[arm] for arm in ARMS) > 60


def test_only_visible_runs_are_in_catch_trials():
    runs = runs_of()
    plan = make_plan(pairs_of(runs), runs[:2], 6, Random(0))
    shown = {
        plan.sources[clip].run for trial in plan.trials if trial.right is not None for clip in trial.clips
    }
    assert shown == set(runs[:2])


def test_a_draw_of_pairs_lets_every_two_arms_meet_equally_often():
    pairs = pairs_of(runs_of())
    drawn = draw_pairs(pairs, 9, Random(0))
    assert set(Counter(pair.arms for pair in drawn).values()) == {3}
    assert set(drawn) <= set(pairs)
    assert len(drawn) == 9


def test_a_draw_of_pairs_repeats_a_prompt_only_after_all_others():
    pairs = pairs_of(runs_of(ARMS[:2], prompts=4, seeds=3))
    drawn = draw_pairs(pairs, 6, Random(0))
    assert sorted(Counter(pair.prompt for pair in drawn).values()) == [1, 1, 2, 2]
