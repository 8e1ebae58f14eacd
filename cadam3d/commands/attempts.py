"""``cadam3d train attempts=N``: train several seeds, keep all of them, and link the best one."""

import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path

from omegaconf import DictConfig

from cadam3d import report
from cadam3d.commands.linking import link_best, link_latest
from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.jsonl import write_json
from cadam3d.io.run_folder import ASSET, BEST, CHOICE, REPORT, setting_word, shown
from cadam3d.sweep.choice import (
    Choice,
    attempt_of,
    choose,
    measuring_line,
    preferred,
    read_attempts,
    require_measured,
    require_one_method,
    selectable_numbers,
)
from cadam3d.sweep.folder import load, rows_of
from cadam3d.sweep.start import run_sweep


def run(
    cfg: DictConfig,
    overrides: Sequence[str],
    flags: Sequence[str],
    options: Namespace,
    words: Sequence[str],
) -> int:
    """Train the attempts that a line asks for, choose the best and report on them; return the exit code.

    ``overrides`` are quoted for Hydra, and ``words`` are the same as they were typed. The code is 0 if every
    attempt has a result and one was chosen, or after a dry run.
    """
    select = cfg.get("select")
    sweep, numbers = read_attempts(cfg, overrides, options), selectable_numbers(options)
    existing = [attempt_of(row) for row in rows_of(sweep.folder, sweep.jobs)]
    require_measured(select, numbers, list(cfg.get("metric") or ()), existing, sweep.folder)
    ended = run_sweep(sweep, words, flags, on_start=link_latest)
    if ended.was_dry:
        return ended.code
    rows = load(ended.folder)
    attempts = [attempt_of(row) for row in rows]
    choice = choose(attempts, select)
    if choice is not None:
        require_one_method(choice, rows, ended.folder)
        _keep(choice, ended.folder)
    if not ended.was_stopped:
        _write_report(ended.folder)
    if choice is not None:
        _print(choice, ended.folder)
    elif any(attempt.measured for attempt in attempts):
        raise _nothing_to_choose_by(select, numbers, ended.folder)
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
    try:
        link_best(folder, name)
    except OSError as error:
        raise UserError(
            f"{shown(folder)}/{BEST}: cannot be written ({error.strerror or error}). {choice.sentence} "
            f"Try: cadam3d view {setting_word('run', shown(folder / name))}"
        ) from error


def _write_report(folder: Path) -> None:
    """Write the page that compares the attempts. A failure is printed and does not stop the command."""
    try:
        report.write_sweep(folder)
    except UserError as error:
        print(f"cadam3d: {error}", file=sys.stderr)


def _print(choice: Choice, folder: Path) -> None:
    """Print why the best attempt was chosen, where its files are, and what to type next."""
    # Print the link itself instead of the folder to which it leads.
    best = shown(folder) / BEST
    print(f"\n{choice.sentence}\n")
    print(f"  {'best':<9}{best} -> seed={choice.best}")
    if (folder / BEST / ASSET).is_file():
        print(f"  {'asset':<9}{best / ASSET}")
    if (folder / REPORT).is_file():
        print(f"  {'report':<9}{shown(folder / REPORT)}")
    word = setting_word("run", best)
    print(f"  {'next':<9}cadam3d view {word}\n  {'':<9}cadam3d export {word}", flush=True)


def _nothing_to_choose_by(select: str | None, numbers: Mapping[str, Number], folder: Path) -> UserError:
    """Return the error for attempts of which none has the number to compare by."""
    names = preferred(numbers.values()) if select is None else [select]
    wanted = f"one of {', '.join(names)}" if select is None else select
    # The last of several needs no truth.
    line = measuring_line(folder, numbers[names[-1]])
    return UserError(
        f"select: no attempt has {wanted}. All of them are kept: measure them, and then type the same line "
        f"again. Try: {line}"
    )
