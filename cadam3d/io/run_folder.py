"""Run folder: the names of the files in the folder of a run or a sweep, and functions that inspect it.

No other module spells these names. This module does not import torch, so that a sweep is planned quickly.
"""

import re
import tempfile
from pathlib import Path

from cadam3d.core.errors import UserError

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

# The step numbers are zero-padded, so that a list of the files is in the order of the steps.
CHECKPOINT_PATTERN = r"step_([0-9]{7,12})\.pt"


def checkpoint_name(step: int) -> str:
    """Return the file name of the checkpoint of ``step``; names sort as steps do."""
    return f"step_{step:07d}.pt"


def has_checkpoint(run: Path) -> bool:
    """Return whether the run in ``run`` can continue from a checkpoint."""
    return bool(checkpoints(run / CHECKPOINTS))


def checkpoints(folder: Path) -> list[Path]:
    """Return the files in ``folder`` with the name of a checkpoint, the newest last; [] without a folder."""
    steps = {path: step for path in folder.glob("*.pt") if (step := checkpoint_step(path)) is not None}
    return sorted((path for path in steps if not path.is_dir()), key=lambda path: steps[path])


def checkpoint_step(path: Path) -> int | None:
    """Return the step in the name of a checkpoint; None if the file has another name."""
    found = re.fullmatch(CHECKPOINT_PATTERN, path.name)
    return int(found.group(1)) if found else None


def holds_run(folder: Path) -> bool:
    """Return whether a run has left results or checkpoints in ``folder``."""
    return any((folder / name).exists() for name in (SUMMARY, CHECKPOINTS))


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
            f"{key}: cannot write to {free} ({error.strerror}). Try: {key}=/tmp/cadam3d"
        ) from error
    return free


def numbered(folder: Path, *, first: int = 2) -> Path:
    """Return the first of ``folder`` (as number 1), ``folder-2``, ``folder-3``, ... that does not exist."""
    number = first
    while (place := folder.with_name(f"{folder.name}-{number}") if number > 1 else folder).exists():
        number += 1
    return place


def shown(path: Path) -> Path:
    """Return ``path`` as a user would type it: relative to the current folder if it is inside it."""
    path = path.resolve()
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
