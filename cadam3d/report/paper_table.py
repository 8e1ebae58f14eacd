"""The paper's table 1, made from the jobs of a sweep: objectives and methods with means over prompts.

Published numbers have rows of their own. Numbers of different protocols or models are never put into one
table.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from cadam3d.core.number import Number
from cadam3d.report.compare import Mean, baseline_of, change, main_setting, mean
from cadam3d.report.published import ROWS, SCORES, SIZES
from cadam3d.report.results import GUIDANCE, PROMPT, RECIPE, SEED, Cell, JobResult, arms_of, measured

FIRST = ("category", "objective", "method", "source", "prompts")
ALL, MINE, PUBLISHED = "all prompts", "this sweep", "published"
MISSING = "-"
ARROWS = {True: "↑", False: "↓", None: ""}


@dataclass(frozen=True)
class PaperTable:
    """The paper's table 1 of a sweep: the rows of all prompts, and then of each category."""

    numbers: list[Number]  # one for each column after FIRST
    lines: list[list[str]]  # a text for each column
    notes: list[str]  # sentences below it

    @property
    def titles(self) -> list[str]:
        """Return the titles of all columns, with an arrow towards the better numbers."""
        return [*FIRST, *(f"{each.heading} {ARROWS[each.is_more_better]}".strip() for each in self.numbers)]

    @property
    def is_text(self) -> list[bool]:
        """Return which columns are text, which a page aligns to the left."""
        return [True] * len(FIRST) + [False] * len(self.numbers)


def paper_table(results: Sequence[JobResult]) -> PaperTable | None:
    """Return the table of the jobs of a sweep; None if none has left an asset."""
    usable = measured(results)
    if not usable:
        return None
    known = columns(usable)
    numbers = comparable(known, usable)
    rows = _rows(results, numbers, ALL)
    published = _published(rows, numbers)
    rows += published
    for category in filter(None, dict.fromkeys(result.category for result in results)):
        own = [result for result in results if result.category == category]
        rows += _rows(own, numbers, category)
    notes = _notes(usable, numbers)
    if published:
        notes.append("Rows marked published are printed in the paper's table 1, by another protocol.")
    if left_out := [number.name for number in known if number not in numbers]:
        notes.append(f"Left out, because jobs measured them in different ways: {', '.join(left_out)}.")
    return PaperTable(numbers, rows, notes)


def columns(results: Sequence[JobResult]) -> list[Number]:
    """Return the numbers that every row of the table has, in order.

    These are the paper's scores, then other numbers that have a record of how they were measured or by which
    assets are chosen, then the paper's sizes.
    """
    rows: dict[tuple, set[str]] = defaultdict(set)
    for label, jobs in _groups(results):
        for job in jobs:
            rows[label, job.setting] |= job.numbers.keys()
    shared = set.intersection(*rows.values())
    recorded = {name for result in results for name in result.scores}
    declared = {each.name: each for result in results for each in result.declared.values()}
    papers = {number.name for number in (*SCORES, *SIZES)}
    others = [
        number
        for name, number in declared.items()
        if name not in papers and (name in recorded or number.preference is not None)
    ]
    return [number for number in (*SCORES, *others, *SIZES) if number.name in shared]


def comparable(numbers: Iterable[Number], results: Sequence[JobResult]) -> list[Number]:
    """Return the numbers that all jobs measured in the same way, by the protocol of the first that has one.

    Numbers without a protocol, such as a PSNR, have no record and need none.
    """
    kept: list[Number] = []
    protocol: dict[str, str] = {}
    for number in numbers:
        scores = [job.scores.get(number.name) for job in results if number.name in job.numbers]
        methods = [score.method if score is not None else {} for score in scores]
        own = {key: value for key, value in methods[0].items() if key.startswith("protocol")}
        is_of_table = not own or not protocol or own == protocol
        if is_of_table and all(method == methods[0] for method in methods):
            protocol = protocol or own
            kept.append(number)
    return kept


def _groups(results: Sequence[JobResult]) -> list[tuple[str, list[JobResult]]]:
    """Return the jobs of each objective with its label; they differ in arm, prompt and seed only."""
    values: dict[tuple[str, str], set[str]] = defaultdict(set)
    for result in results:
        for key, value in result.cell.axes:
            values[key, result.cell[PROMPT]].add(value)
    # Settings that come with prompts, such as their negative prompts, do not make groups.
    keys = {key for (key, _), found in values.items() if len(found) > 1} - {PROMPT, SEED}
    groups: dict[tuple, list[JobResult]] = defaultdict(list)
    for result in results:
        groups[tuple(pair for pair in result.cell.axes if pair[0] in keys)].append(result)
    return [(_label(axes, jobs), jobs) for axes, jobs in groups.items()]


def _label(axes: Iterable[tuple[str, str]], jobs: Iterable[JobResult]) -> str:
    families = dict.fromkeys(job.objective.partition("_")[0].upper() for job in jobs if job.objective)
    others = [value if key == RECIPE else f"{key}={value}" for key, value in axes if key != GUIDANCE]
    return ", ".join([*families, *others]) or MISSING


def _rows(results: Sequence[JobResult], numbers: Sequence[Number], category: str) -> list[list[str]]:
    """Return a row per objective and setting, and the differences between the arms of each objective."""
    rows = []
    for objective, jobs in _groups(results):
        for setting in dict.fromkeys(job.setting for job in jobs):
            own = [job for job in jobs if job.setting == setting]
            prompts = _prompts((job.cell for job in measured(own)), own)
            means = [mean(_by_prompt(_values(own, each))) for each in numbers]
            cells = [_text(each, number.digits, prompts) for each, number in zip(means, numbers, strict=True)]
            rows.append([category, objective, setting.name, MINE, prompts, *cells])
        rows += [[category, objective, *row] for row in _differences(jobs, numbers)]
    return rows


def _differences(jobs: Sequence[JobResult], numbers: Sequence[Number]) -> Iterator[list[str]]:
    """Yield a row for each other arm: its differences from the baseline, over what both have."""
    if baseline := baseline_of(jobs):
        for arm in (arm for arm in arms_of(jobs) if arm != baseline):
            settings = main_setting(jobs, arm), main_setting(jobs, baseline)
            ours, theirs = ([job for job in jobs if job.setting == each] for each in settings)
            both = {job.cell for job in measured(ours)} & {job.cell for job in measured(theirs)}
            prompts = _prompts(both, [*ours, *theirs])
            cells = [_difference(ours, theirs, number, prompts) for number in numbers]
            yield [f"{arm} - {baseline}", MINE, prompts, *cells]


def _difference(ours: Sequence[JobResult], theirs: Sequence[JobResult], number: Number, prompts: str) -> str:
    """Return the difference of a number over the prompts and seeds in which both have it."""
    having = _values(ours, number), _values(theirs, number)
    shared = having[0].keys() & having[1].keys()
    first, second = (_by_prompt({cell: values[cell] for cell in shared}) for values in having)
    if number in SIZES:
        return _text(change(first, second), 1, prompts, "+", " %")
    found = mean({prompt: first[prompt] - second[prompt] for prompt in first})
    return _text(found, number.digits, prompts, "+")


def _published(rows: Iterable[Sequence[str]], numbers: Sequence[Number]) -> list[list[str]]:
    """Return the published rows of the objectives in ``rows``."""
    objectives = {row[FIRST.index("objective")].partition(",")[0] for row in rows}
    return [
        [
            *(ALL, f"{row.objective}, {row.recipe}", row.arm, PUBLISHED, ""),
            *(row.texts.get(number.name, MISSING) for number in numbers),
        ]
        for row in ROWS
        if row.objective in objectives
    ]


def _text(found: Mean | None, digits: int, prompts: str, sign: str = "", unit: str = "") -> str:
    """Return a mean with half its interval, and its count of prompts if it is not its row's."""
    if found is None:
        return MISSING
    interval = "" if found.half is None else f" ± {found.half:,.{digits}f}"
    own = "" if str(found.prompts) == prompts.partition(" ")[0] else f" ({found.prompts})"
    return f"{found.value:{sign},.{digits}f}{unit}{interval}{own}"


def _values(jobs: Iterable[JobResult], number: Number) -> dict[Cell, float]:
    return {job.cell: job.numbers[number.name] for job in measured(jobs) if number.name in job.numbers}


def _by_prompt(values: Mapping[Cell, float]) -> dict[str, float]:
    """Return a number of each prompt, averaged over its seeds."""
    found: dict[str, list[float]] = defaultdict(list)
    for cell, value in values.items():
        found[cell[PROMPT]].append(value)
    return {prompt: sum(values) / len(values) for prompt, values in found.items()}


def _prompts(found: Iterable[Cell], planned: Iterable[JobResult]) -> str:
    done, all_ = len({cell[PROMPT] for cell in found}), len({job.cell[PROMPT] for job in planned})
    return f"{done}" if done == all_ else f"{done} of {all_}"


def _notes(usable: Sequence[JobResult], numbers: Sequence[Number]) -> list[str]:
    notes = [
        "Means over prompts and, after ±, half the width of their 95 % interval (Student's t).",
        "Differences compare the same prompts and seeds; Gaussians and sizes by the ratio of their means.",
    ]
    names = {number.name for number in numbers}
    methods = [score.method for job in usable for name, score in job.scores.items() if name in names]
    if protocols := {method["protocol.name"] for method in methods if "protocol.name" in method}:
        notes.append(f"Learned scores: protocol={', '.join(protocols)}, as eval.json of each job records it.")
    if early := sum(result.ended_early for result in usable):
        notes.append(f"{early} of {len(usable)} assets are unfinished, because their jobs ended early.")
    return notes
