"""``cadam3d train attempts=N``: train several seeds, keep all of them, and link the best one."""

from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from cadam3d import report
from cadam3d.core.console import complain, show
from cadam3d.core.errors import UserError
from cadam3d.core.number import preferred
from cadam3d.io.jsonl import write_json
from cadam3d.io.links import link
from cadam3d.io.run_folder import ASSET, BEST, CHOICE, LATEST, REPORT, setting_word, shown
from cadam3d.settings.line import Line
from cadam3d.sweep.choice import (
    Choice,
    attempt_of,
    choose,
    measuring_line,
    read_attempts,
    require_measured,
    require_one_method,
    selectable_numbers,
)
from cadam3d.sweep.folder import load, rows_of
from cadam3d.sweep.start import run_sweep


def run(cfg: DictConfig, line: Line) -> int:
    """Train the attempts that a line asks for, choose the best and report on them; return the exit code.

    The code is 0 if every attempt has a result and one was chosen, or after a dry run.
    """
    select = cfg.get("select")
    sweep, numbers = read_attempts(cfg, line), selectable_numbers(line.folders)
    existing = [attempt_of(row) for row in rows_of(sweep.folder, sweep.plan.jobs)]
    require_measured(select, numbers, list(cfg.get("metric") or ()), existing)
    ended = run_sweep(sweep, on_start=partial(link, Path(LATEST)))
    if ended.was_dry:
        return ended.code
    rows = load(ended.folder)
    attempts = [attempt_of(row) for row in rows]
    choice = choose(attempts, select)
    if choice is not None:
        require_one_method(choice, rows, sweep)
        _keep(choice, ended.folder)
    if not ended.was_stopped:
        try:
            report.write_sweep(ended.folder)
        except UserError as error:
            complain(str(error))
    if choice is not None:
        _print(choice, ended.folder)
    elif any(attempt.numbers for attempt in attempts):
        names = [each.name for each in preferred(numbers.values())] if select is None else [select]
        # The last of several needs no truth.
        again = measuring_line(sweep, numbers[names[-1]])
        raise UserError(f"select: no attempt has {' or '.join(names)}. Try: {again}")
    return ended.code


def _keep(choice: Choice, folder: Path) -> None:
    """Write ``best.json``, which names the best attempt, and link this attempt."""
    name = f"seed={choice.best}"
    facts = {
        "best": name,
        "seed": choice.best,
        "select": choice.number.name,
        "values": {f"seed={seed}": value for seed, value in choice.values.items()},
        "without": [f"seed={seed}" for seed in choice.without],
        "why": choice.sentence,
    }
    write_json(folder / CHOICE, facts)
    link(folder / BEST, folder / name)


def _print(choice: Choice, folder: Path) -> None:
    """Print why the best attempt was chosen, where its files are, and what to type next."""
    best = folder / f"seed={choice.best}"
    show(f"\n{choice.sentence}\n\n  {'best':<9}{shown(best)}")
    for label, path in (("asset", best / ASSET), ("report", folder / REPORT)):
        if path.is_file():
            show(f"  {label:<9}{shown(path)}")
    show(f"  {'next':<9}cadam3d view {setting_word('run', shown(best))}")
