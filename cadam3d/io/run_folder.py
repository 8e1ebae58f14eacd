"""Run folder: the names of the files in the folder of a run or a sweep, and functions that inspect it.

No other module spells these names. This module does not import torch, so that a sweep is planned quickly.
"""

import tempfile
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json

# Written by training.
ASSET = "asset.ply"
CHARTS = "charts.json"  # the charts that the densifier and the objective declare
CHECKPOINTS = "checkpoints"  # a folder
CONFIG = "config.yaml"  # every setting, resolved
METRICS = "metrics.jsonl"
OVERRIDES = ".hydra/overrides.yaml"  # what was typed
SUMMARY = "summary.json"

# Written by exporters and callbacks.
CANDIDATES = "candidates"  # a folder
HISTOGRAMS = "candidates/histograms.jsonl"
IMAGES = "images"  # a folder
PREVIEW = "preview.png"
PREVIEWS = "previews"  # a folder
TURNTABLE = "turntable.mp4"

# Written after training, for a run or for a sweep.
EVALUATION = "eval.json"
REPORT = "report.html"

# Written by a sweep, into its own folder.
FIGURES = "figures"  # a folder
JOBS = "jobs.json"
# While this file exists, running jobs save and end, and no other job starts.
STOP = ".stop"
TABLE = "sweep.csv"
SHARED = "traces"  # a folder, removed after the sweep

# Written by a sweep, into the folder of each job.
CONSOLE = "console.txt"
ENDED = "job.json"  # exit code and seconds

# In the folder of a sweep and of each of its jobs.
LOCK = ".lock"  # held by the process that works there

# The step numbers are zero-padded, so that the newest file sorts last.
CHECKPOINT_PATTERN = "step_*.pt"


def checkpoint_name(step: int) -> str:
    """Return the file name of the checkpoint of ``step``; names sort as steps do."""
    return f"step_{step:07d}.pt"


def has_checkpoint(run: Path) -> bool:
    """Return whether the run in ``run`` can continue from a checkpoint."""
    return any((run / CHECKPOINTS).glob(CHECKPOINT_PATTERN))


def holds_run(folder: Path) -> bool:
    """Return whether a run has left results or checkpoints in ``folder``."""
    return any((folder / name).exists() for name in (SUMMARY, CHECKPOINTS))


def read_summary(run: Path) -> dict[str, Any]:
    """Return the facts of the run in ``run``; {} if it has no summary or one that cannot be read."""
    try:
        summary = read_json(run / SUMMARY)
    except UserError:
        return {}
    return summary if isinstance(summary, dict) else {}


def claim(folder: Path, key: str, *, is_chosen: bool) -> Path:
    """Create a folder for results, check that it can be written, and return it.

    ``is_chosen`` means that the user has named this folder. Otherwise a name that exists gets a number.
    Raises ``UserError`` with the setting ``key`` if the folder cannot be written.
    """
    free = folder if is_chosen else numbered(folder, first=1)
    try:
        free.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=free):
            pass
    except OSError as error:
        raise UserError(
            f"{key}: cannot write to {free} ({error.strerror}). Try: {key}={_temporary()}"
        ) from error
    return free


def numbered(folder: Path, *, first: int = 2) -> Path:
    """Return the first of ``folder`` (as number 1), ``folder-2``, ``folder-3``, ... that does not exist."""
    number = first
    while (place := folder.with_name(f"{folder.name}-{number}") if number > 1 else folder).exists():
        number += 1
    return place


def _temporary() -> Path:
    """Return a new folder among the temporary files, where almost every user can write."""
    return numbered(Path(tempfile.gettempdir()) / "cadam3d", first=1)


def shown(path: Path) -> Path:
    """Return ``path`` as a user would type it: relative to the current folder if it is inside it."""
    path = path.resolve()
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
