"""``cadam3d sweep``: many trains, one ``sweep.csv``. A job that fails is a row of it, not the end of it.

The table is gathered from the job folders, so it is right whatever launcher ran the jobs and whenever it is
asked for; it is written again after every job, because a sweep may be stopped.
"""

import csv
import logging
import math
import sys
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.jsonl import read_json, write_json
from cadam3d.state import Outcome

COLUMNS = (
    *("job", "overrides", "seed", "outcome", "num_gaussians", "asset_bytes", "seconds", "psnr"),
    *("message", "folder"),
)
SUMMARY = "summary.json"  # of a job
UNFINISHED = "unfinished"  # the outcome of a job that is running, or that was killed
SHOWN = ("job", "outcome", "num_gaussians", "asset_bytes", "seconds", "psnr", "overrides")

log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> float | None:
    """One job: train, then bring the table up to date. A failure is written down and the sweep goes on."""
    from cadam3d.commands import train

    hydra = HydraConfig.get()
    folder, sweep_folder = Path(hydra.runtime.output_dir), Path(hydra.sweep.dir)
    try:
        return train.run(cfg)
    except UserError as error:
        _note_failure(folder, cfg, str(error))
    except Exception as error:
        log.exception("This job failed; the sweep goes on.")
        _note_failure(folder, cfg, f"{type(error).__name__}: {error}")
    finally:
        write(sweep_folder)
    return math.nan  # what a sweeper that optimises takes for "no value"


def finish(folder: Path) -> int:
    """Write the final table, print it, and return the exit code: 1 if no job came through."""
    rows = write(folder)
    if not rows:
        return 1
    print(as_text(rows))
    print(f"\n{len(rows)} jobs: {folder / 'sweep.csv'}")
    return 1 if all(row["outcome"] in (Outcome.FAILED, UNFINISHED) for row in rows) else 0


def write(folder: Path) -> list[dict[str, Any]]:
    """Gather the rows of the sweep in ``folder`` and write them to its ``sweep.csv`` in one move."""
    rows = gather(folder)
    if rows:
        path = folder / "sweep.csv"
        with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    return rows


def gather(folder: Path) -> list[dict[str, Any]]:
    """One row per job that was started, in the order of the jobs."""
    return [_row(job) for job in jobs(folder)]


def jobs(folder: Path) -> list[Path]:
    """The job folders of a sweep, in order: those that Hydra numbered and left its notes in."""
    found = [path.parent.parent for path in folder.glob("*/.hydra/overrides.yaml")]
    return sorted(found, key=lambda job: (_number(job), job.name))


def as_text(rows: list[dict[str, Any]]) -> str:
    """The rows as a table for the terminal."""
    lines = [list(SHOWN)] + [[_cell(row[name]) for name in SHOWN] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join("  ".join(line).rstrip() for line in padded)


def _row(job: Path) -> dict[str, Any]:
    path = job / SUMMARY
    summary = read_json(path) if path.is_file() else {"outcome": UNFINISHED}
    overrides = yaml.safe_load((job / ".hydra/overrides.yaml").read_text(encoding="utf-8")) or []
    told = {"job": _number(job), "overrides": " ".join(overrides), "folder": job.name}
    return {name: summary.get(name) for name in COLUMNS} | told


def _note_failure(folder: Path, cfg: DictConfig, message: str) -> None:
    """Leave the failure in the job's ``summary.json``, beside whatever training had written there."""
    print(f"cadam3d: {folder.name} failed: {message}", file=sys.stderr)
    path = folder / SUMMARY
    before = read_json(path) if path.is_file() else {"prompt": cfg.prompt}
    write_json(path, {"seed": cfg.seed, **before, "outcome": str(Outcome.FAILED), "message": message})


def _number(job: Path) -> int:
    head = job.name.partition("_")[0]
    return int(head) if head.isdigit() else -1


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
