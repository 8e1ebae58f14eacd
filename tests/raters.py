"""Simulated raters with known preferences, as the analysis of a study reads them."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.special import expit

from cadam3d.study.answers import Answer, Rater
from cadam3d.study.questions import QUESTION_NAMES


def simulated_raters(
    strengths: Mapping[str, float],
    raters: int,
    prompts: int,
    *,
    questions: Sequence[str] = QUESTION_NAMES,
    rater_sd: float = 0.5,
    prompt_sd: float = 0.5,
    catches: Sequence[bool] = (True,) * 5,
    seed: int = 0,
) -> list[Rater]:
    """Return raters who compare all arms for all prompts; ``strengths`` are in log-odds."""
    generator = np.random.default_rng(seed)
    arms = list(strengths)
    found = []
    of_prompts = prompt_sd * generator.standard_normal((prompts, len(arms)))
    for rater in range(raters):
        of_rater = rater_sd * generator.standard_normal(len(arms))
        answers = []
        for prompt in range(prompts):
            utility = np.array(list(strengths.values())) + of_rater + of_prompts[prompt]
            for question in questions:
                for i, j in combinations(range(len(arms)), 2):
                    won = generator.random() < expit(utility[i] - utility[j])
                    chosen, other = (i, j) if won else (j, i)
                    answers.append(
                        Answer(f"rater {rater}", f"prompt {prompt}", question, arms[chosen], arms[other])
                    )
        found.append(Rater(f"rater {rater}", tuple(answers), tuple(catches)))
    return found
