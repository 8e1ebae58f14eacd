"""Records: what a run writes about itself, as text, validated in one place when it is read.

Numbers and text in these files may come from a stranger, and reports calculate with them. Each reader returns
only entries of the kinds that training writes.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le

from cadam3d.core.errors import UserError
from cadam3d.core.number import COUNT, Number
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import Real, Whole, adapter_of, fits, is_number, read_json, read_jsonl
from cadam3d.io.reading import read_yaml
from cadam3d.io.run_folder import EVALUATION, HISTOGRAMS, METRICS, SUMMARY

# Limits of a histogram in histograms.jsonl.
MOST_BINS = 1000  # per decade
DECADES = 300  # powers of ten below and above 1

# The entry of summary.json and of eval.json with what metrics declare about their numbers, by name.
NUMBERS = "numbers"
MOST_DIGITS = 10
# The entry of summary.json and of eval.json with a record of how each number was measured, by its name.
MEASUREMENTS = "measurements"
# Entries of such a record that may differ between the assets of one table. All others describe how the number
# was measured.
OF_ASSET = ("value", "reason", "text", "views", "views_left_out", "mean", "interval")
# Entries that do not count if the hash of the weights is known: equal weights are the same model.
OF_PLACE = ("model", "revision")
WEIGHTS = "weights_sha256"


def read_summary(run: Path) -> dict[str, Any]:
    """Return the facts of the run in ``run``; {} if it has no summary, or one that cannot be believed."""
    summary = _read_entries(run / SUMMARY)
    kinds = dict.fromkeys(declared(summary), Real | None) | SUMMARY_KINDS
    is_believed = all(fits(summary[name], kind) for name, kind in kinds.items() if name in summary)
    return summary if is_believed and summary.get("outcome", Outcome.FINISHED) in set(Outcome) else {}


def _read_entries(path: Path) -> dict[str, Any]:
    """Return the entries of a JSON file; {} if it cannot be read."""
    try:
        entries = read_json(path)
    except UserError:
        return {}
    return entries if isinstance(entries, dict) else {}


def declared(facts: Mapping[str, Any]) -> dict[str, Number]:
    """Return what a ``summary.json`` or an ``eval.json`` declares about its numbers, by name.

    Declarations of another form than :meth:`Number.declaration` returns are left out.
    """
    entries, found = facts.get(NUMBERS), {COUNT.name: COUNT}
    adapter = adapter_of(Number)
    for name, entry in entries.items() if isinstance(entries, dict) else ():
        with suppress(ValueError, TypeError):
            number = adapter.validate_python({**entry, "name": name})
            # A terminal would obey control characters.
            texts = f"{number.label}{number.unit}{number.explained}"
            if texts.isprintable() and 0 <= number.digits <= MOST_DIGITS:
                found[name] = number
    return found


def psnr_of(summary: Mapping[str, Any]) -> float | None:
    """Return the PSNR by which an asset is judged, in dB: at the best turn, if it may face any side."""
    turned = summary.get("psnr_turned")
    return summary.get("psnr") if turned is None else turned


def read_evaluation(run: Path, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``eval.json``; {} if it cannot be read, or if it describes another asset than ``summary``."""
    evaluation = _read_entries(run / EVALUATION)
    is_of_asset = evaluation.get("num_gaussians") == summary.get("num_gaussians")
    # A run that was resumed may have as many Gaussians as before, but it has more steps.
    is_of_run = evaluation.get("steps", summary.get("steps")) == summary.get("steps")
    return evaluation if is_of_asset and is_of_run else {}


def with_earlier(fresh: Mapping[str, Any], run: Path, metrics: Collection[str]) -> dict[str, Any]:
    """Return the entries of a new ``eval.json``: the new numbers, and earlier numbers of the same asset.

    ``metrics`` are the options of ``metric=`` that were measured now. All their numbers are new. Numbers of
    other metrics that ``eval.json`` has already are kept with their records.
    """
    earlier = read_evaluation(run, fresh)
    numbers = declared(earlier)
    known = {
        name: value
        for name, value in earlier.items()
        if name in numbers and numbers[name].metric not in metrics and is_number(value) and name not in fresh
    }
    declarations = {name: numbers[name].declaration() for name in known} | fresh.get(NUMBERS, {})
    records = {name: score.record for name, score in scores_in(earlier).items() if name in known}
    records |= fresh.get(MEASUREMENTS, {})
    return {**known, **fresh, NUMBERS: declarations} | ({MEASUREMENTS: records} if records else {})


def read_quality(run: Path, summary: Mapping[str, Any]) -> dict[str, float]:
    """Return the comparisons with the truth in ``eval.json`` of a run that has measured none itself.

    Returns {} if the summary has a PSNR, or if the evaluation is of another asset or cannot be believed.
    """
    if psnr_of(summary) is not None:
        return {}
    evaluation = read_evaluation(run, summary)
    names = [name for name, number in declared(evaluation).items() if number.needs_truth]
    return {name: evaluation[name] for name in names if is_number(evaluation.get(name))}


@dataclass(frozen=True)
class Score:
    """A number with the record of how it was measured."""

    value: float
    record: Mapping[str, Any]
    metric: str = ""  # the option of ``metric=`` that has measured it, as far as known

    @property
    def method(self) -> dict[str, str]:
        """Return how the number was measured, as texts by dotted key: the protocol, the weights and so on.

        Only numbers with equal methods may be compared.
        """
        left_out = (*OF_ASSET, *(OF_PLACE if self.record.get(WEIGHTS) is not None else ()))
        return dict(_flat({key: value for key, value in self.record.items() if key not in left_out}))


def scores_in(numbers: Mapping[str, Any]) -> dict[str, Score]:
    """Return the numbers of a ``summary.json`` or an ``eval.json`` that have a record, by name."""
    records, known = numbers.get(MEASUREMENTS), declared(numbers)
    return {
        name: Score(float(numbers[name]), record, known[name].metric if name in known else "")
        for name, record in (records.items() if isinstance(records, dict) else ())
        if is_number(numbers.get(name)) and isinstance(record, dict)
    }


def read_scores(run: Path, summary: Mapping[str, Any]) -> dict[str, Score]:
    """Return the scores of a run by name. Those of ``eval.json`` replace those from the end of training."""
    return latest_scores([summary, read_evaluation(run, summary)])


def latest_scores(sources: Iterable[Mapping[str, Any]]) -> dict[str, Score]:
    """Return the scores by name, each from the last source that has a number of this name.

    A later number without a record replaces an earlier score, and then there is no score of this name.
    """
    found: dict[str, Score] = {}
    for numbers in sources:
        found = {name: each for name, each in found.items() if name not in numbers} | scores_in(numbers)
    return found


def difference(name: str, scores: Iterable[Score]) -> str | None:
    """Return a sentence about scores that must not be in one table; None if all have one method.

    ``name`` is the number's name.
    """
    methods = [score.method for score in scores]
    for key in dict.fromkeys(key for method in methods for key in method):
        values = sorted({method.get(key, "unknown") for method in methods})
        if len(values) > 1:
            return f"{name} was measured in different ways: {key} is {' and '.join(values)}"
    return None


def _flat(node: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted keys of nested dicts with their values as text; the name of a protocol comes first."""
    if not isinstance(node, dict):
        yield key, str(_plain(node))
        return
    for name in sorted(node, key=lambda name: (name != "protocol", name != "name", str(name))):
        yield from _flat(node[name], f"{key}.{name}" if key else str(name))


def _plain(value: Any) -> Any:
    """Return a value with whole floats as integers, because 3.0 and 3 are one setting."""
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return int(value) if type(value) is float and value.is_integer() else value


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the lines of ``metrics.jsonl``; lines with entries of another kind are left out.

    Every line has its ``kind`` and its ``step``. All other entries are numbers or None, except for
    ``statistics``, which is a dict of such entries. Raises ``UserError`` if the file cannot be read.
    """
    return [line for line in read_jsonl(run / METRICS) if _is_metrics(line)]


def counts(lines: Iterable[Mapping[str, Any]]) -> list[tuple[int, float]]:
    """Return steps and Gaussians over time from lines of ``metrics.jsonl``, in order.

    A refinement is two points at its step. The line of a step holds the count before its refinement.
    """
    points = [
        (line["step"], order, line[key])
        for line in lines
        for key, order in (("num_gaussians", 0), ("before", 0), ("after", 1))
        if is_number(line.get(key))
    ]
    return [(step, value) for step, _, value in sorted(points)]


def read_histograms(run: Path) -> list[dict[str, Any]]:
    """Return the lines of ``histograms.jsonl``; lines with entries of another kind are left out.

    The bins of each line are between 10^-300 and 10^300. Raises ``UserError`` if the file cannot be read.
    """
    return [line for line in read_jsonl(run / HISTOGRAMS) if _is_histogram(line)]


def read_config(path: Path) -> dict[str, Any]:
    """Return the settings that a run has saved. Raises ``UserError`` unless the file is a mapping of keys."""
    settings = read_yaml(path)
    if not isinstance(settings, dict) or not _has_text_keys(settings):
        raise UserError(f"{path}: expected the settings of a run, got something else. Try: another run")
    return settings


def _has_text_keys(value: Any) -> bool:
    """Return whether every key in nested dicts and lists is text."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _has_text_keys(item) for key, item in value.items())
    return not isinstance(value, list) or all(map(_has_text_keys, value))


def _is_metrics(line: dict[str, Any]) -> bool:
    """Return whether a line of ``metrics.jsonl`` has only entries of the kinds that training writes."""
    rest = {key: value for key, value in line.items() if key not in ("kind", "step", "statistics")}
    found = (line.get("kind"), line.get("step"), line.get("statistics", {}), rest)
    return fits(found, tuple[str, Whole, dict[str, Real | None], dict[str, Real | None]])


def _is_histogram(line: dict[str, Any]) -> bool:
    names = ("step", "score", "bins_per_decade", "first", "counts", "selected")
    bins = Annotated[int, Ge(1), Le(MOST_BINS)]
    found: Any = tuple(line.get(name) for name in names)
    if not fits(found, tuple[Whole, str, bins, int, list[Whole], list[Whole]]):
        return False
    _, _, per_decade, first, counts, selected = found
    is_in_range = -DECADES * per_decade <= first <= first + len(counts) <= DECADES * per_decade
    return is_in_range and len(counts) == len(selected)


# The kinds of the entries of summary.json that other parts calculate with. A summary may have more entries,
# such as numbers of a metric from elsewhere.
SUMMARY_KINDS: dict[str, Any] = {
    "warnings": list[str],
    **dict.fromkeys(("seconds", "cpu_seconds"), Annotated[Real, Ge(0)]),
    "seed": Annotated[int, Ge(0)],
    "grows": bool,
    **dict.fromkeys(("outcome", "prompt", "message", "device", "backend"), str),
    **dict.fromkeys(("negative_prompt", "densifier", "guidance", "prior", "initializer"), str | None),
    **dict.fromkeys(("commit", "machine"), str | None),
    **dict.fromkeys(("rasterizer", "camera", "refine", "optimizer", "initializer_note", "truth"), str | None),
    **dict.fromkeys(("steps", "steps_asked", "num_gaussians", "num_gaussians_initial"), Whole),
    **dict.fromkeys(("skipped_steps", "dimmed_steps", "asset_bytes", "threads"), Whole),
    **dict.fromkeys(("psnr", "ssim", "psnr_turned", "ssim_turned"), Real | None),
    **dict.fromkeys(("memory_estimate_gib", "memory_peak_gib"), Real | None),
}
