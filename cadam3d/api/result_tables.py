"""Tables from Python: ``sweep`` and ``evaluate`` do what the commands do, and return their numbers."""

import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cadam3d.api.guest import as_guest, hinting, literal, require_free, stop_signals
from cadam3d.commands import eval as evaluation
from cadam3d.commands.opened import find_run
from cadam3d.commands.sweep import carry_out
from cadam3d.core.checks import fail
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import REPORT, shown, typed_path
from cadam3d.launch import completing, explaining, prepare, read_line
from cadam3d.settings.line import DRY_RUN, SWEEP_FOLDER, key_of
from cadam3d.sweep.folder import UNNAMED, Row, is_sweep, load
from cadam3d.sweep.table import as_text, records_of


class ResultTable:
    """The numbers in the folder of a sweep or of a run, as they are in ``sweep.csv``.

    They are read from the files when they are asked for. ``pandas.DataFrame(table.rows)`` is a data frame.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Open a folder. Raises ``UserError`` if it holds neither a sweep nor a run."""
        place = typed_path(os.fspath(folder))
        with hinting(has_words=False):
            self.folder: Path = place if is_sweep(place) else find_run(os.fspath(folder))

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return one dict per job, in order: arm, settings that differ, outcome, numbers and folder.

        A run has a single row. A number that is not known is None.
        """
        return records_of(self._jobs)

    @property
    def report(self) -> Path:
        """Return the path of the page with figures and tables."""
        return self.folder / REPORT

    def compare(self, ours: str, theirs: str) -> list[dict[str, Any]]:
        """Return how ``ours`` differs from ``theirs``, two arms or settings, paired within cells.

        There is one dict per noise level and number: the count in percent, the numbers by which assets are
        chosen, and the seconds. Each has the difference as ``value``, its 95 % interval from ``low`` to
        ``high`` over prompts (None with too few of them) and the p-values. The name of an arm stands for its
        main setting, as in the report. Raises ``UserError`` for other names.
        """
        from cadam3d.report.compare import named_settings
        from cadam3d.report.results import read
        from cadam3d.report.tables import two_settings

        results = read(self.folder) if is_sweep(self.folder) else []
        with hinting(has_words=False):
            settings = named_settings(results, [ours, theirs])
        lines, _ = two_settings(results, *settings)
        return [asdict(line.pop("difference")) | line for line in lines]

    @property
    def _jobs(self) -> Sequence[Row]:
        if is_sweep(self.folder):
            return load(self.folder)
        summary = read_summary(self.folder)
        return [
            Row(
                arm=str(summary.get("densifier", UNNAMED)),
                name=self.folder.name,
                overrides=[],
                swept={key: summary.get(key) for key in ("prompt", "seed")},
                number=0,
                folder=self.folder,
                summary=summary,
            )
        ]

    def __fspath__(self) -> str:
        """Return the folder, so that a table can stand for it: ``cadam3d.evaluate(table)``."""
        return str(self.folder)

    def __repr__(self) -> str:
        return f"<ResultTable {shown(self.folder)}>\n{as_text(self._jobs)}"


def sweep(*overrides: str, folder: str | os.PathLike[str] | None = None) -> ResultTable:
    """Train many times, and return the table of all jobs.

    This is ``cadam3d sweep OVERRIDES``, with the same checks, locks, files and processes: a job runs in a
    process of its own, so what it needs must be in YAML files and modules, and finished jobs are skipped if
    you call it again. ``overrides`` are the words of the command line, such as ``"grid=densifiers"`` or
    ``"seed=0,1"``. ``folder`` is the folder of the sweep, by default one in ``multirun``.

    Raises ``UserError`` for mistakes. A job without a result is no mistake: its row says why. After Ctrl-C,
    the running jobs save, and then ``KeyboardInterrupt`` is raised. Messages go to the logger
    ``cadam3d.messages``.
    """
    named = {} if folder is None else {SWEEP_FOLDER: os.fspath(folder)}
    require_free(overrides, named)
    words = [*(literal(key, text) for key, text in named.items()), *overrides]
    with as_guest(), explaining("sweep", words):
        line = read_line("sweep", words)
        if line.wants_page or any(key_of(word) == DRY_RUN for word in line.overrides):
            raise fail("sweep", expected="a sweep that runs", got=words, example="the command line")
        ended = carry_out(line, stop_signals())
    if ended.was_stopped:
        again = f"cadam3d.sweep({', '.join(map(repr, words))})"
        raise KeyboardInterrupt(f"Everything is saved. Continue with: {again}")
    return ResultTable(ended.folder)


def evaluate(run: str | os.PathLike[str], *overrides: str) -> ResultTable:
    """Measure a run, or every job of a sweep, and return the table with the new numbers.

    This is ``cadam3d eval run=RUN OVERRIDES``, with the same checks and files. ``run`` is a folder, a
    :class:`Run` or a :class:`ResultTable`, and ``overrides`` are words such as ``"metric=[clip]"``.

    Raises ``UserError`` for mistakes, and if nothing could be measured.
    """
    place = os.fspath(run)
    require_free(overrides, {"run": place})
    with as_guest(), completing():
        cfg, call = prepare("eval", [literal("run", place), *overrides])
        evaluation.run(cfg, call)
    return ResultTable(place)
