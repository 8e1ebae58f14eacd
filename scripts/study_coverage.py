"""Measure how often the intervals of a study contain the true value, with simulated raters.

    python scripts/study_coverage.py

A simulated rater chooses arm i over arm j of a prompt with the probability ``expit(u[i] - u[j])``, where u is
the strength of the arm plus an effect of the rater plus an effect of the prompt on this arm. The effects are
normal. The true rate is the one over all raters and all prompts. ``docs/notes/study_statistics.md`` has the
result.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from measuring import header, line_of, parser_of, positive
from scipy.optimize import brentq
from scipy.special import expit

from cadam3d.study.estimates import (
    CONFIDENCE,
    Clusters,
    Interval,
    count_wins,
    fit_strengths,
    is_ranked,
    rate_interval,
    sign_test,
    strength_margins,
)

SIZES = ((8, 6), (30, 6), (30, 12), (12, 50))
# Standard deviations of the effects of raters and of prompts on the difference of two arms, in log-odds.
EFFECTS = ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (1.5, 0.0), (0.0, 1.5))
RATES = (0.5, 0.7, 0.9)
RESAMPLES = 400  # of the bootstrap


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study with known preferences."""

    raters: int
    prompts: int
    strengths: tuple[float, ...]  # of the arms, in log-odds
    rater_sd: float = 0.0  # standard deviation of the effect of a rater on the difference of two arms
    prompt_sd: float = 0.0
    answered: float = 1.0  # share of the prompts about which a rater answers

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of arms, all of which a rater compares."""
        return list(combinations(range(len(self.strengths)), 2))

    def true_rate(self, first: int, second: int) -> float:
        """Return the rate at which the first arm is chosen over the second by all raters for all prompts."""
        points, weights = np.polynomial.hermite_e.hermegauss(61)
        sd = np.hypot(self.rater_sd, self.prompt_sd)
        difference = self.strengths[first] - self.strengths[second]
        return float(expit(difference + sd * points) @ weights / weights.sum())

    def true_strengths(self) -> np.ndarray:
        """Return the strengths that the model of Bradley and Terry has for infinitely many answers."""
        wins = np.zeros((len(self.strengths),) * 2)
        for first, second in self.pairs:
            wins[first, second] = self.true_rate(first, second)
            wins[second, first] = 1 - wins[first, second]
        return fit_strengths(wins)

    def answers(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Clusters]:
        """Return the arms that were chosen, the arms that were not, and the clusters of one such study."""
        arms = len(self.strengths)
        of_raters = self.rater_sd / np.sqrt(2) * generator.standard_normal((self.raters, 1, arms))
        of_prompts = self.prompt_sd / np.sqrt(2) * generator.standard_normal((1, self.prompts, arms))
        utility = np.asarray(self.strengths) + of_raters + of_prompts
        answered = generator.random((self.raters, self.prompts)) < self.answered
        raters, prompts = np.nonzero(answered)
        chosen, other = [], []
        for first, second in self.pairs:
            difference = (utility[..., first] - utility[..., second])[answered]
            wins = generator.random(len(raters)) < expit(difference)
            chosen.append(np.where(wins, first, second))
            other.append(np.where(wins, second, first))
        copies = len(self.pairs)
        clusters = Clusters(np.tile(raters, copies), np.tile(prompts, copies))
        return np.concatenate(chosen), np.concatenate(other), clusters


def two_arms(rate: float, rater_sd: float, prompt_sd: float, **size: float) -> Study:
    """Return a study of two arms, of which the first is chosen at ``rate``."""

    def study(strength: float) -> Study:
        return Study(strengths=(strength, 0.0), rater_sd=rater_sd, prompt_sd=prompt_sd, **size)

    return study(brentq(lambda strength: study(strength).true_rate(0, 1) - rate, -20, 20))


def bootstrap_interval(chosen: np.ndarray, clusters: Clusters) -> Interval:
    """Return the percentile interval of Owen's pigeonhole bootstrap (2007): raters and prompts are drawn."""
    generator = np.random.default_rng(0)
    raters, prompts = clusters.raters.max() + 1, clusters.prompts.max() + 1
    drawn_raters = generator.multinomial(raters, np.full(raters, 1 / raters), RESAMPLES)
    drawn_prompts = generator.multinomial(prompts, np.full(prompts, 1 / prompts), RESAMPLES)
    table = np.zeros((2, raters, prompts))
    np.add.at(table[0], (clusters.raters, clusters.prompts), chosen)
    np.add.at(table[1], (clusters.raters, clusters.prompts), 1)
    sums = ((drawn_raters @ table) * drawn_prompts).sum(-1)
    rates = sums[0, sums[1] > 0] / sums[1, sums[1] > 0]
    return Interval(*np.quantile(rates, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]).tolist())


def independent_interval(chosen: np.ndarray, clusters: Clusters) -> Interval:
    """Return Wilson's interval, which takes all answers for independent and ignores their clusters."""
    n, share, z = len(chosen), chosen.mean(), 1.96
    center, half = share + z * z / (2 * n), z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return Interval((center - half) / (1 + z * z / n), (center + half) / (1 + z * z / n))


def rate_coverage(
    study: Study, simulations: int, interval: Callable[[np.ndarray, Clusters], Interval], seed: int = 0
) -> tuple[float, float]:
    """Return how often the interval contains the true rate of the first of two arms, and its width, in %."""
    generator = np.random.default_rng(seed)
    truth = study.true_rate(0, 1)
    found = []
    for _ in range(simulations):
        arms, _, clusters = study.answers(generator)
        each = interval(arms == 0, clusters)
        found.append((not each.excludes(truth), each.high - each.low))
    coverage, width = (100 * np.mean(found, axis=0)).tolist()
    return coverage, width


def strength_coverage(study: Study, simulations: int, seed: int = 0) -> list[float]:
    """Return how often the interval of each arm's strength contains the true strength, in %.

    Studies in which the strengths cannot be estimated are drawn again.
    """
    generator = np.random.default_rng(seed)
    truth = study.true_strengths()
    hits = []
    while len(hits) < simulations:
        chosen, other, clusters = study.answers(generator)
        wins = count_wins(chosen, other, len(truth))
        if is_ranked(wins):
            strengths = fit_strengths(wins)
            hits.append(np.abs(strengths - truth) <= strength_margins(chosen, other, clusters, strengths))
    return (100 * np.mean(hits, axis=0)).tolist()


def false_alarms(study: Study, simulations: int, seed: int = 0) -> list[float]:
    """Return how often p < 0.05 in the sign test over prompts, over raters, and in both, in %."""
    generator = np.random.default_rng(seed)
    alarms = []
    for _ in range(simulations):
        arms, _, clusters = study.answers(generator)
        tests = [sign_test(arms == 0, units) for units in (clusters.prompts, clusters.raters)]
        p_values = [test.p_value for test in tests]
        alarms.append([p_value < 1 - CONFIDENCE for p_value in (*p_values, max(p_values))])
    return (100 * np.mean(alarms, axis=0)).tolist()


def rate_rows(simulations: int) -> Iterator[Sequence[str]]:
    """Yield the lines of the table of rates."""
    kinds = {
        "clustered": rate_interval,
        "bootstrap": bootstrap_interval,
        "independent": independent_interval,
    }
    yield ["raters x prompts", "effects", "rate", *kinds]
    for (raters, prompts), effects, rate in product(SIZES, EFFECTS, RATES):
        study = two_arms(rate, *effects, raters=raters, prompts=prompts)
        found = [rate_coverage(study, simulations, interval) for interval in kinds.values()]
        cells = [f"{coverage:.1f} ({width:.0f})" for coverage, width in found]
        yield [f"{raters} x {prompts}", f"{effects[0]:g}, {effects[1]:g}", f"{rate:g}", *cells]


def strength_rows(simulations: int) -> Iterator[Sequence[str]]:
    """Yield the lines of the table of strengths, of three arms."""
    yield ["raters x prompts", "effects", "first arm", "second arm", "third arm"]
    for (raters, prompts), (rater_sd, prompt_sd) in product(SIZES, EFFECTS):
        study = Study(
            raters=raters,
            prompts=prompts,
            strengths=(0.8, 0.0, -0.8),
            rater_sd=rater_sd,
            prompt_sd=prompt_sd,
        )
        cells = [f"{coverage:.1f}" for coverage in strength_coverage(study, simulations)]
        yield [f"{raters} x {prompts}", f"{rater_sd:g}, {prompt_sd:g}", *cells]


def alarm_rows(simulations: int) -> Iterator[Sequence[str]]:
    """Yield the lines of the table of sign tests of two equal arms."""
    yield ["raters x prompts", "effects", "over prompts", "over raters", "both"]
    for (raters, prompts), effects in product(SIZES, EFFECTS):
        found = false_alarms(two_arms(0.5, *effects, raters=raters, prompts=prompts), simulations)
        effect = f"{effects[0]:g}, {effects[1]:g}"
        yield [f"{raters} x {prompts}", effect, *(f"{share:.1f}" for share in found)]


def main() -> None:
    """Print the three tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--simulations", type=positive, default=2000, help="for each line of a table")
    simulations = parser.parse_args().simulations
    titles = {
        "Rates: coverage in % (mean width in %)": rate_rows,
        "Strengths of three arms: coverage in %": strength_rows,
        "Two equal arms: sign tests with p < 0.05, in %": alarm_rows,
    }
    for title, rows in titles.items():
        print(f"\n{title}\n")
        columns, *cells = rows(simulations)
        print("\n".join([header(columns), *map(line_of, cells)]), flush=True)


if __name__ == "__main__":
    main()
