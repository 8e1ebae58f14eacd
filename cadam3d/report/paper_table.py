"""The paper's table 1, made from the jobs of a sweep: objectives and methods with means over prompts.

Published numbers have rows of their own. Numbers of different protocols or models are never put into one
table.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from cadam3d.core.number import Number
from cadam3d.io import records
from cadam3d.io.run_folder import setting_word, shown
from cadam3d.report.compare import Mean, change, main_setting, mean, references
from cadam3d.report.formatting import plural
from cadam3d.report.published import ROWS, SCORES, SIZES, PublishedRow
from cadam3d.report.results import (
    GUIDANCE,
    PROMPT,
    RECIPE,
    SEED,
    ArmSetting,
    Cell,
    JobResult,
    arms_of,
    measured,
)

MINE, PUBLISHED = "this sweep", "published"
MISSING = "-"


@dataclass(frozen=True)
class TableCell:
    """A number of the table as text."""

    text: str = MISSING
    half: str = ""  # half the width of its 95 % interval; empty if there is none
    prompts: int | None = None  # how many prompts it was measured on; None for a published number


@dataclass(frozen=True)
class TableRow:
    """A row of the table."""

    objective: str
    method: str
    source: str  # MINE or PUBLISHED
    prompts: str  # how many have a result, such as "49 of 50"; empty for a published row
    cells: list[TableCell]  # one for each number of the table
    category: str = ""  # of its prompts; empty: all prompts


@dataclass(frozen=True)
class PaperTable:
    """The paper's table 1 of a sweep: the rows of all prompts, and then those of each category."""

    numbers: list[Number]  # one for each column
    rows: list[TableRow]
    notes: list[str]  # sentences below it


@dataclass(frozen=True)
class ObjectiveJobs:
    """The jobs of one objective; they differ in arm, prompt and seed only."""

    objective: str  # a label
    family: str  # such as SDS; empty if no job says so
    results: list[JobResult] = field(repr=False)

    @property
    def settings(self) -> list[ArmSetting]:
        """Return the settings of all arms, in the order of the sweep."""
        arms = dict.fromkeys(result.arm for result in self.results)
        found = {result.setting for result in self.results}
        return sorted(found, key=lambda each: (list(arms).index(each.arm), each.order))

    def of(self, setting: ArmSetting) -> list[JobResult]:
        """Return the jobs of a setting."""
        return [result for result in self.results if result.setting == setting]


def paper_table(results: Sequence[JobResult], folder: Path) -> PaperTable | None:
    """Return the table of the jobs of the sweep in ``folder``; None if none has left an asset."""
    usable = measured(results)
    if not usable:
        return None
    left_out = mixed(usable)
    numbers = [number for number in columns(usable) if number.name not in left_out]
    categories = [each for each in dict.fromkeys(result.category for result in results) if each]
    rows = _rows(results, numbers, with_published=True)
    for category in categories:
        members = [result for result in results if result.category == category]
        own = _rows(members, numbers, with_published=False)
        rows += [replace(row, category=category) for row in own]
    notes = [*_notes(results, usable, numbers), *_again(left_out, usable, folder)]
    papers = [number.name for number in SCORES]
    if not any(name in result.numbers for result in usable for name in papers):
        notes.append(f"The paper's scores are not measured yet. Try: {_line(papers, folder)}")
    return PaperTable(numbers, rows, notes)


def columns(results: Sequence[JobResult]) -> list[Number]:
    """Return the numbers that every row of the table has, in order.

    These are the paper's scores, then other numbers that have a record of how they were measured or by which
    assets are chosen, then the paper's sizes.
    """
    rows = [group.of(setting) for group in _groups(results) for setting in group.settings]
    known = [{name for job in jobs for name in job.numbers} for jobs in rows]
    shared = set.intersection(*known) if known else set()
    recorded = {name for result in results for name in result.scores}
    declared = {each.name: each for result in results for each in result.declared.values()}
    papers = {number.name for number in (*SCORES, *SIZES)}
    others = [
        number
        for name, number in declared.items()
        if name not in papers and (name in recorded or number.preference is not None)
    ]
    return [number for number in (*SCORES, *others, *SIZES) if number.name in shared]


def mixed(results: Sequence[JobResult]) -> dict[str, str]:
    """Return a sentence about each number that must not be in a table of these jobs.

    Such a number was measured in different ways, or by another protocol than the columns before it. Numbers
    without a protocol, such as a PSNR, have no record and need none.
    """
    problems: dict[str, str] = {}
    protocol: dict[str, str] = {}
    for name in (number.name for number in columns(results)):
        found = [job.scores.get(name) for job in results if name in job.numbers]
        scores = [score for score in found if score is not None]
        if not scores:
            continue
        if problem := records.difference(name, scores):
            problems[name] = problem
        elif len(scores) < len(found):
            problems[name] = f"{name} has a record of how it was measured in some jobs only"
        elif own := {key: value for key, value in scores[0].method.items() if key.startswith("protocol")}:
            protocol = protocol or own
            if own != protocol:
                problems[name] = f"{name} belongs to another protocol than the other scores"
    return problems


def _again(left_out: Mapping[str, str], results: Sequence[JobResult], folder: Path) -> list[str]:
    """Return the sentences about numbers that are left out, with the line that measures all scores anew."""
    metrics = {score.metric for result in results for score in result.scores.values()}
    line = _line(sorted(metrics), folder)
    return [f"{problem}, so it is not in the table. Try: {line}" for problem in left_out.values()]


def _line(metrics: Iterable[str], folder: Path) -> str:
    """Return the command that measures all jobs of the sweep in ``folder``."""
    return f"cadam3d eval {setting_word('run', shown(folder))} 'metric=[{','.join(metrics)}]'"


def _groups(results: Sequence[JobResult]) -> list[ObjectiveJobs]:
    axes: dict[str, set[str]] = {}
    of_prompts: dict[tuple[str, str], set[str]] = {}
    for result in results:
        for key, value in result.cell.axes:
            axes.setdefault(key, set()).add(value)
            of_prompts.setdefault((key, result.cell[PROMPT]), set()).add(value)
    # Settings that come with prompts, such as their negative prompts, do not make groups.
    free = {key for (key, _), values in of_prompts.items() if len(values) > 1} - {PROMPT, SEED}
    members: dict[Cell, list[JobResult]] = {}
    for result in results:
        members.setdefault(result.cell.without(*axes.keys() - free), []).append(result)
    return [_group(cell, jobs) for cell, jobs in members.items()]


def _group(cell: Cell, jobs: list[JobResult]) -> ObjectiveJobs:
    families = dict.fromkeys(job.objective.partition("_")[0].upper() for job in jobs if job.objective)
    family = "/".join(families)
    others = [value if key == RECIPE else f"{key}={value}" for key, value in cell.axes if key != GUIDANCE]
    return ObjectiveJobs(", ".join(filter(None, [family, *others])) or MISSING, family, jobs)


def _rows(results: Sequence[JobResult], numbers: Sequence[Number], *, with_published: bool) -> list[TableRow]:
    rows: list[TableRow] = []
    groups = _groups(results)
    for position, group in enumerate(groups):
        rows += [
            _row(group.objective, setting.name, group.of(setting), numbers) for setting in group.settings
        ]
        rows += _difference_rows(group, numbers)
        is_last = group.family not in [other.family for other in groups[position + 1 :]]
        if with_published and is_last:
            rows += _published_rows(group.family, numbers)
    return rows


def _row(objective: str, method: str, jobs: Sequence[JobResult], numbers: Sequence[Number]) -> TableRow:
    usable = measured(jobs)
    cells = [_cell(mean(_by_prompt(usable, number.name)), number.digits) for number in numbers]
    return TableRow(objective, method, MINE, _prompts(_names(usable), _names(jobs)), cells)


def _difference_rows(group: ObjectiveJobs, numbers: Sequence[Number]) -> list[TableRow]:
    """Return a row for each other arm: its differences from the baseline, over what both have."""
    rows = []
    for baseline in references(group.results)[:1]:
        theirs = group.of(main_setting(group.results, baseline))
        for arm in (arm for arm in arms_of(group.results) if arm != baseline):
            ours = group.of(main_setting(group.results, arm))
            cells = [_difference(ours, theirs, number) for number in numbers]
            both = {job.cell for job in measured(ours)} & {job.cell for job in measured(theirs)}
            prompts = _prompts({cell[PROMPT] for cell in both}, _names(ours) | _names(theirs))
            rows.append(TableRow(group.objective, f"{arm} - {baseline}", MINE, prompts, cells))
    return rows


def _difference(ours: Sequence[JobResult], theirs: Sequence[JobResult], number: Number) -> TableCell:
    """Return the difference of a number over the prompts and seeds in which both have it."""
    having = [
        {job.cell: job for job in measured(jobs) if number.name in job.numbers} for jobs in (ours, theirs)
    ]
    shared = having[0].keys() & having[1].keys()
    first, second = (_by_prompt([jobs[cell] for cell in shared], number.name) for jobs in having)
    if number in SIZES:
        return _change_cell(change(first, second))
    differences = {prompt: first[prompt] - second[prompt] for prompt in first}
    return _cell(mean(differences), number.digits, signed=True)


def _published_rows(family: str, numbers: Sequence[Number]) -> list[TableRow]:
    """Return the published rows of an objective, and their differences; [] for other objectives."""
    found = [row for row in ROWS if row.objective == family]
    rows = [_published(row, row.arm, numbers, lambda name, row=row: row.texts.get(name)) for row in found]
    for theirs, ours in zip(found[:1] * len(found), found[1:], strict=False):
        rows.append(
            _published(
                ours,
                f"{ours.arm} - {theirs.arm}",
                numbers,
                lambda name, ours=ours, theirs=theirs: _published_difference(ours, theirs, name),
            )
        )
    return rows


def _published(
    row: PublishedRow, method: str, numbers: Sequence[Number], text: Callable[[str], str | None]
) -> TableRow:
    cells = [TableCell(text(number.name) or MISSING) for number in numbers]
    return TableRow(f"{row.objective}, {row.recipe}", method, PUBLISHED, "", cells)


def _published_difference(ours: PublishedRow, theirs: PublishedRow, name: str) -> str | None:
    first, second = ours.number(name), theirs.number(name)
    if first is None or second is None:
        return None
    if name in (number.name for number in SIZES):
        return _change_cell(Mean(first / second - 1, None, 0)).text
    return f"{first - second:+.{len(ours.texts[name].partition('.')[2])}f}"


def _cell(found: Mean | None, digits: int, *, signed: bool = False) -> TableCell:
    if found is None:
        return TableCell()
    half = "" if found.half is None else f"{found.half:,.{digits}f}"
    return TableCell(f"{found.value:{'+' if signed else ''},.{digits}f}", half, found.prompts)


def _change_cell(found: Mean | None) -> TableCell:
    if found is None:
        return TableCell()
    half = "" if found.half is None else f"{100 * found.half:.1f}"
    return TableCell(f"{100 * found.value:+.1f} %", half, found.prompts)


def _by_prompt(jobs: Iterable[JobResult], name: str) -> dict[str, float]:
    """Return a number of each prompt, averaged over its seeds."""
    found: dict[str, list[float]] = {}
    for job in jobs:
        if name in job.numbers:
            found.setdefault(job.cell[PROMPT], []).append(job.numbers[name])
    return {prompt: sum(values) / len(values) for prompt, values in found.items()}


def _names(jobs: Iterable[JobResult]) -> set[str]:
    return {job.cell[PROMPT] for job in jobs}


def _prompts(found: set[str], planned: set[str]) -> str:
    return f"{len(found)}" if len(found) == len(planned) else f"{len(found)} of {len(planned)}"


def _notes(results: Sequence[JobResult], usable: Sequence[JobResult], numbers: Sequence[Number]) -> list[str]:
    seeds = len({result.cell[SEED] for result in usable})
    each = f" of the means over {plural(seeds, 'seed')}" if seeds > 1 else ""
    notes = [
        f"Means over prompts{each}; after ±, half the width of the 95 % interval over prompts (Student's t).",
        "Rows of differences compare the same prompts and seeds under both arms. Gaussians and sizes are "
        "compared by their means, as in the paper: -90 % means that the mean is a tenth.",
    ]
    names = {number.name for number in numbers}
    scores = [score for job in usable for name, score in job.scores.items() if name in names]
    if known := [
        name for name in dict.fromkeys(score.method.get("protocol.name") for score in scores) if name
    ]:
        notes.append(f"Learned scores: protocol={', '.join(known)}, as eval.json of each job records it.")
    if any(group.family == row.objective for group in _groups(results) for row in ROWS):
        notes.append(
            "Rows marked published are printed in the paper's table 1. They belong to another protocol: "
            "other prompts, views, models and hardware. Compare their differences with ours, and not the "
            "numbers themselves."
        )
    if lacking := len(results) - len(usable):
        notes.append(
            f"{lacking} of {plural(len(results), 'job')} left nothing to measure or did not end yet."
        )
    if early := Counter((result.arm, result.outcome) for result in usable if result.ended_early):
        listed = ", ".join(f"{count} of {arm} ({outcome})" for (arm, outcome), count in sorted(early.items()))
        notes.append(f"Jobs that ended early, with unfinished assets: {listed}.")
    return notes
