"""The paper's table 1, made from the jobs of a sweep: objectives and methods with means over prompts.

Published numbers have rows of their own. Numbers of different protocols or models are never put into one
table.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from cadam3d.core.number import Number
from cadam3d.io import records
from cadam3d.io.run_folder import setting_word, shown
from cadam3d.report.formatting import plural
from cadam3d.report.means import Mean, change, difference, mean
from cadam3d.report.published import ROWS, PublishedRow
from cadam3d.report.results import GUIDANCE, PROMPT, RECIPE, SEED, WITH_ASSET, ArmSetting, Cell, JobResult
from cadam3d.report.verdicts import OURS, THEIRS

# The columns, in order, of which a table has those that were measured: the paper's scores, other scores, then
# comparisons with a truth.
PAPER_SCORES = ("clip_score", "image_reward", "hps", "niqe")
SCORES = (*PAPER_SCORES, "clip_r_precision", "pick_score", "vqa", "janus")
OF_TRUTH = ("psnr", "ssim", "psnr_turned", "ssim_turned", "iou", "colour_error")
# The numbers by whose ratio two settings are compared.
SIZES = ("num_gaussians", "asset_mib")
MINE, PUBLISHED = "this sweep", "published"
DIFFERENCE = f"{OURS} - {THEIRS}"
MISSING = "-"


@dataclass(frozen=True)
class TableCell:
    """A number of the table as text, without separators of thousands."""

    text: str = MISSING
    half: str = ""  # half the width of its 95 % interval; empty if there is none
    prompts: int | None = None  # how many prompts it was measured on; None for a published number

    @property
    def value(self) -> str:
        """Return the number for readers, such as ``12,345``."""
        whole, point, rest = self.text.partition(".")
        return f"{int(whole):,}{point}{rest}" if whole.isdigit() and len(whole) > 3 else self.text

    @property
    def shown_half(self) -> str:
        """Return half the width for readers."""
        return TableCell(self.half).value if self.half else ""


@dataclass(frozen=True)
class TableRow:
    """A row of the table."""

    objective: str
    method: str
    source: str  # MINE or PUBLISHED
    prompts: str  # how many have a result, such as "49 of 50"; empty for a published row
    cells: Mapping[str, TableCell]  # by the name of a number


@dataclass(frozen=True)
class Section:
    """The rows of all prompts, or of the prompts of one category."""

    category: str  # empty: all prompts
    rows: list[TableRow]


@dataclass(frozen=True)
class PaperTable:
    """The paper's table 1 of a sweep."""

    numbers: list[Number]  # one for each column
    sections: list[Section]
    notes: list[str]  # sentences below it

    @property
    def headings(self) -> list[str]:
        """Return the labels of the columns of numbers."""
        return [number.heading for number in self.numbers]

    @property
    def names(self) -> list[str]:
        """Return the names of the columns of numbers."""
        return [number.name for number in self.numbers]


@dataclass(frozen=True)
class Group:
    """The jobs of one objective; they differ in arm, prompt and seed only."""

    objective: str  # a label
    family: str  # such as SDS; empty if no job says so
    results: list[JobResult] = field(repr=False)

    @cached_property
    def settings(self) -> list[ArmSetting]:
        """Return the settings of all arms: no growth first, then the baseline, then the others."""
        found = {result.setting for result in self.results}
        return sorted(found, key=lambda each: (each.arm != "none", each.arm != THEIRS, each.order))

    def of(self, setting: ArmSetting) -> list[JobResult]:
        """Return the jobs of a setting."""
        return [result for result in self.results if result.setting == setting]

    def standard(self, arm: str) -> ArmSetting | None:
        """Return the setting of ``arm`` with the shipped thresholds, or its only one, or else None."""
        own = [result for result in self.results if result.arm == arm]
        found = {result.setting for result in own if result.is_standard} or {each.setting for each in own}
        return found.pop() if len(found) == 1 else None


def paper_table(results: Sequence[JobResult], folder: Path) -> PaperTable | None:
    """Return the table of the jobs of the sweep in ``folder``; None if none has left an asset."""
    usable = with_asset(results)
    if not usable:
        return None
    left_out = mixed(usable)
    numbers = [number for number in columns(_rows_of_jobs(usable)) if number.name not in left_out]
    categories = [each for each in dict.fromkeys(result.category for result in results) if each]
    sections = [Section("", _rows(results, numbers, with_published=True))]
    for category in categories:
        members = [result for result in results if result.category == category]
        sections.append(Section(category, _rows(members, numbers, with_published=False)))
    notes = [*_notes(results, usable, numbers), *_again(left_out, usable, folder)]
    if not any(name in result.numbers for result in usable for name in PAPER_SCORES):
        notes.append(f"The paper's scores are not measured yet. Try: {_line(PAPER_SCORES, folder)}")
    return PaperTable(numbers, sections, notes)


def with_asset(results: Iterable[JobResult]) -> list[JobResult]:
    """Return the jobs that have left an asset with Gaussians."""
    return [result for result in results if result.outcome in WITH_ASSET and result.count]


def columns(rows: Sequence[Sequence[JobResult]]) -> list[Number]:
    """Return the numbers that every row has, each a sequence of jobs, in order."""
    known = [{name for job in jobs for name in job.numbers} for jobs in rows]
    shared = set.intersection(*known) if known else set()
    declared = {name: number for jobs in rows for job in jobs for name, number in job.declared.items()}
    names = [name for name in (*SCORES, *OF_TRUTH, *SIZES) if name in shared and name in declared]
    replaced = {declared[name].replaces for name in names}
    return [declared[name] for name in names if name not in replaced]


def mixed(results: Sequence[JobResult]) -> dict[str, str]:
    """Return a sentence about each number that must not be in a table of these jobs.

    Such a number was measured in different ways, or by another protocol than the columns before it. Numbers
    without a protocol, such as a PSNR, have no record and need none.
    """
    problems: dict[str, str] = {}
    protocol: dict[str, str] = {}
    for name in SCORES:
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
    scores = {name: score.metric or name for result in results for name, score in result.scores.items()}
    line = _line([scores[name] for name in SCORES if name in scores], folder)
    return [f"{problem}, so it is not in the table. Try: {line}" for problem in left_out.values()]


def _line(metrics: Iterable[str], folder: Path) -> str:
    """Return the command that measures with some metrics all jobs of the sweep in ``folder``."""
    chosen = ",".join(dict.fromkeys(metrics))
    return f"cadam3d eval {setting_word('run', shown(folder))} 'metric=[{chosen}]'"


def _groups(results: Sequence[JobResult]) -> list[Group]:
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


def _group(cell: Cell, jobs: list[JobResult]) -> Group:
    families = dict.fromkeys(job.objective.partition("_")[0].upper() for job in jobs if job.objective)
    family = "/".join(families)
    others = [value if key == RECIPE else f"{key}={value}" for key, value in cell.axes if key != GUIDANCE]
    return Group(", ".join(filter(None, [family, *others])) or MISSING, family, jobs)


def _rows_of_jobs(results: Sequence[JobResult]) -> list[list[JobResult]]:
    return [group.of(setting) for group in _groups(results) for setting in group.settings]


def _rows(results: Sequence[JobResult], numbers: Sequence[Number], *, with_published: bool) -> list[TableRow]:
    rows: list[TableRow] = []
    groups = _groups(results)
    for position, group in enumerate(groups):
        rows += [
            _row(group.objective, setting.name, group.of(setting), numbers) for setting in group.settings
        ]
        ours, theirs = group.standard(OURS), group.standard(THEIRS)
        if ours and theirs:
            rows.append(_difference_row(group.objective, group.of(ours), group.of(theirs), numbers))
        is_last = group.family not in [other.family for other in groups[position + 1 :]]
        if with_published and is_last:
            rows += _published_rows(group.family, [number.name for number in numbers])
    return rows


def _row(objective: str, method: str, jobs: Sequence[JobResult], numbers: Sequence[Number]) -> TableRow:
    usable = with_asset(jobs)
    cells = {}
    for number in numbers:
        found = mean(_by_prompt(usable, number.name))
        cells[number.name] = TableCell() if found is None else _cell(found, number.digits)
    return TableRow(objective, method, MINE, _prompts(_names(usable), _names(jobs)), cells)


def _difference_row(
    objective: str, ours: Sequence[JobResult], theirs: Sequence[JobResult], numbers: Sequence[Number]
) -> TableRow:
    """Return the row of the differences, over the prompts and seeds that both have."""
    usable, others = with_asset(ours), with_asset(theirs)
    both = {job.cell for job in usable} & {job.cell for job in others}
    usable, others = ([job for job in jobs if job.cell in both] for jobs in (usable, others))
    cells = {}
    for number in numbers:
        name = number.name
        measured = [{job.cell for job in jobs if name in job.numbers} for jobs in (usable, others)]
        shared = set.intersection(*measured)
        first, second = (
            _by_prompt([job for job in jobs if job.cell in shared], name) for jobs in (usable, others)
        )
        if name in SIZES:
            found = change(first, second)
            cells[name] = TableCell() if found is None else _change_cell(found)
        else:
            found = difference(first, second)
            cells[name] = TableCell() if found is None else _cell(found, number.digits, signed=True)
    planned = _names(ours) | _names(theirs)
    return TableRow(objective, DIFFERENCE, MINE, _prompts(_names(usable), planned), cells)


def _published_rows(family: str, names: Sequence[str]) -> list[TableRow]:
    """Return the published rows of an objective, and their differences; [] for other objectives."""
    found = [row for row in ROWS if row.objective == family]
    rows = [
        TableRow(
            f"{row.objective}, {row.recipe}",
            row.arm,
            PUBLISHED,
            "",
            {name: TableCell(row.texts[name]) if name in row.texts else TableCell() for name in names},
        )
        for row in found
    ]
    by_arm = {row.arm: row for row in found}
    if OURS in by_arm and THEIRS in by_arm:
        cells = {name: _published_difference(by_arm[OURS], by_arm[THEIRS], name) for name in names}
        rows.append(TableRow(rows[0].objective, DIFFERENCE, PUBLISHED, "", cells))
    return rows


def _published_difference(ours: PublishedRow, theirs: PublishedRow, name: str) -> TableCell:
    first, second = ours.number(name), theirs.number(name)
    if first is None or second is None:
        return TableCell()
    if name in SIZES:
        return TableCell(_change_cell(Mean(first / second - 1, None, 0)).text)
    return TableCell(f"{first - second:+.{len(ours.texts[name].partition('.')[2])}f}")


def _cell(found: Mean, decimals: int, *, signed: bool = False) -> TableCell:
    sign = "+" if signed else ""
    half = "" if found.half is None else f"{found.half:.{decimals}f}"
    return TableCell(f"{found.value:{sign}.{decimals}f}", half, found.prompts)


def _change_cell(found: Mean) -> TableCell:
    word = "more" if found.value > 0 else "fewer"
    half = "" if found.half is None else f"{100 * found.half:.1f}"
    return TableCell(f"{100 * abs(found.value):.1f} % {word}", half, found.prompts)


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
        f"{DIFFERENCE}: the same prompts and seeds under both. Gaussians and sizes are compared by their "
        "means, as in the paper: 90 % fewer means that the mean is a tenth.",
    ]
    protocols = dict.fromkeys(
        score.method.get("protocol.name")
        for job in usable
        for name, score in job.scores.items()
        if name in [number.name for number in numbers]
    )
    if known := [name for name in protocols if name]:
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
