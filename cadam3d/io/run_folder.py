"""Run folder: the names of the files in the folder of a run or a sweep, and functions that inspect it.

No other module spells these names. This module does not import torch, so that a sweep is planned quickly.
"""

import os
import re
import shlex
import tempfile
from contextlib import suppress
from pathlib import Path

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.io.links import followed

# Written by training.
ASSET = "asset.ply"
CHARTS = "charts.json"  # the charts that the densifier and the objective declare
CHECKPOINTS = "checkpoints"  # a folder
CONFIG = "config.yaml"  # every setting, resolved
HYDRA = ".hydra"  # a folder: the settings as Hydra has read them
HYDRA_CONFIG = ".hydra/config.yaml"  # every setting, with its references to others
HYDRA_SETTINGS = ".hydra/hydra.yaml"  # how Hydra was set up, with the folders of YAML files
LOG = "train.log"
METRICS = "metrics.jsonl"
OVERRIDES = ".hydra/overrides.yaml"  # what was typed
SUMMARY = "summary.json"

# Written by exporters and callbacks. The other names of an exporter are in its class.
CANDIDATES = "candidates"  # a folder
HISTOGRAMS = "candidates/histograms.jsonl"
PREVIEW = "preview.png"
PREVIEWS = "previews"  # a folder
LIVE = "live"  # a folder, removed when training ends: what a run and a page that shows it tell each other
LIVE_PAUSE = "live/pause"  # while this file exists, training waits
LIVE_SAVE = "live/save"  # training removes this file and saves
LIVE_SNAPSHOT = "live/snapshot.bin"  # the Gaussians, packed for the page
LIVE_STATE = "live/state.json"  # the numbers beside them
LIVE_STOP = "live/stop"  # training removes this file, saves and ends
LIVE_WATCHED = "live/watched"  # touched by every page that shows the run
SNAPSHOTS = "snapshots"  # a folder: the Gaussians at some steps, packed for the report
SAVED = "saved"  # a folder: assets and states that a user has saved during training
TENSORBOARD = "tensorboard"  # a folder: event files
WANDB = "wandb"  # a folder: what Weights & Biases keeps of the run on this disk
WANDB_RUN = "wandb/cadam3d.json"  # under which id it is known there, and the last step that was recorded
TURNTABLE = "turntable.mp4"  # or .webm or .gif

# Written by ``cadam3d export``.
ASSET_RECORD = "asset.json"
EXPORTS = "exports"  # a folder

# Written after training, for a run or for a sweep.
EVALUATION = "eval.json"
REPORT = "report.html"

# Written by a sweep, into its own folder.
FIGURES = "figures"  # a folder
JOBS = "jobs.json"
MULTIRUN = "multirun.yaml"  # written by Hydra
# While this file exists, running jobs save and end, and no other job starts.
STOP = ".stop"
TABLE = "sweep.csv"
PAPER_TABLE_CSV = "table.csv"  # the paper's table 1 of the jobs
PAPER_TABLE_MARKDOWN = "table.md"
PAPER_TABLE_LATEX = "table.tex"

# Written by several attempts at one run, beside the files of a sweep.
BEST = "best"  # a link to the folder of the best attempt
CHOICE = "best.json"  # which attempt that is, and why

# Written by a sweep, into the folder of each job.
CONSOLE = "console.txt"
ENDED = "job.json"  # exit code and seconds

# In the folder of every run and of every sweep.
LOCK = ".lock"  # held by the process that works there

# The setting that names the folder of a run.
RUN_FOLDER = "hydra.run.dir"

LATEST = "outputs/latest"  # a link to the newest run, beside the runs that have no other place

# The step numbers are zero-padded, so that a list of the files is in the order of the steps.
CHECKPOINT_PATTERN = r"step_([0-9]{7,12})\.pt"
SAVED_PATTERN = r"step_([0-9]{7,12})\.ply"
SNAPSHOT_PATTERN = r"step_([0-9]{7,12})\.bin"


# What training, its callbacks and its exporters write, and eval. Many exporters write other files too, whose
# names begin with EXPORTED.
WRITTEN_BY_RUNS = (
    *(ASSET, CHARTS, CONFIG, EVALUATION, LOG, METRICS, PREVIEW, REPORT, SUMMARY, "images", "viewer.html"),
    *(CANDIDATES, CHECKPOINTS, HYDRA, LIVE, PREVIEWS, SAVED, SNAPSHOTS, TENSORBOARD, WANDB),
)
EXPORTED = ("asset.", "asset_mesh.", "turntable.", "progress.")


def checkpoint_name(step: int) -> str:
    """Return the file name of the checkpoint of ``step``; names sort as steps do."""
    return f"step_{step:07d}.pt"


def saved_name(step: int) -> str:
    """Return the file name of the asset that a user has saved after ``step``; names sort as steps do."""
    return f"step_{step:07d}.ply"


def snapshot_name(step: int) -> str:
    """Return the file name of the snapshot of ``step``; names sort as steps do."""
    return f"step_{step:07d}.bin"


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


def snapshots(run: Path) -> dict[int, Path]:
    """Return the path of every snapshot in the folder ``run`` by its step, in order."""
    named = [(re.fullmatch(SNAPSHOT_PATTERN, path.name), path) for path in (run / SNAPSHOTS).glob("*.bin")]
    return dict(sorted((int(name.group(1)), path) for name, path in named if name is not None))


def sweep_of(run: Path) -> Path | None:
    """Return the folder of the sweep that the run in the folder ``run`` is a job of; None for another run."""
    return run.parent if (run.parent / JOBS).is_file() else None


def holds_run(folder: Path) -> bool:
    """Return whether a run has left results or checkpoints in ``folder``."""
    return any((folder / name).exists() for name in (SUMMARY, CHECKPOINTS))


def occupant(folder: Path) -> str | None:
    """Return the name of something in ``folder`` that a run would overwrite or add to; None if there is none.

    Files with other names may be in the folder of a run, because no run touches them.
    """
    names = [JOBS, *WRITTEN_BY_RUNS]
    with suppress(OSError):
        names += sorted(path.name for path in folder.iterdir() if path.name.startswith(EXPORTED))
    return next((name for name in names if os.path.lexists(folder / name)), None)


def occupant_of_sweep(folder: Path) -> str | None:
    """Return the name of something in ``folder`` that a sweep would overwrite or remove; None if nothing."""
    tables = (TABLE, PAPER_TABLE_CSV, PAPER_TABLE_MARKDOWN, PAPER_TABLE_LATEX)
    names = (*tables, REPORT, EVALUATION, FIGURES, MULTIRUN, STOP, BEST, CHOICE)
    return next((name for name in names if os.path.lexists(folder / name)), None)


def claim(folder: Path, key: str, *, is_chosen: bool) -> Path:
    """Create a folder for results, check that it can be written, and return it.

    ``is_chosen`` means that the user has named this folder. Otherwise the folder is new, even if other
    processes claim the same name at the same time: a name that exists gets a number. Raises ``UserError``
    with the setting ``key`` if the folder cannot be written.
    """
    free = folder
    try:
        while True:
            try:
                free.mkdir(parents=True, exist_ok=is_chosen)
                break
            except FileExistsError:
                if is_chosen:
                    raise
                free = numbered(folder)
        require_writable(free)
    except OSError as error:
        raise not_writable(key, free, error) from error
    return free


def not_writable(key: str, folder: Path, error: OSError) -> UserError:
    """Return the error for a folder that the setting ``key`` names and that cannot be written."""
    problem = f"cannot write to {shown(folder)} ({error.strerror or error})"
    return UserError(f"{key}: {problem}. Try: {another_folder(key, spare('cadam3d'))}")


def another_folder(key: str, free: Path) -> str:
    """Return what to type to use the folder ``free``; instead of a run that cannot be resumed, a new one."""
    return setting_word(RUN_FOLDER if key == "resume" else key, free)


def require_writable(folder: Path) -> None:
    """Raise ``OSError`` if no file can be created in ``folder``."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def nearest_existing(folder: Path) -> Path:
    """Return ``folder``, or the nearest of its parents that exists."""
    return next((place for place in (folder, *folder.parents) if os.path.lexists(place)), folder)


def remove_empty(folder: Path, existing: Path) -> None:
    """Remove ``folder`` and its parents up to ``existing``, as far as they are empty."""
    for place in (folder, *folder.parents):
        if place == existing:
            return
        try:
            place.rmdir()
        except OSError:
            return


def numbered(path: Path, *, first: int = 2, suffix: str = "") -> Path:
    """Return the first of ``path`` (as number 1), ``path-2``, ``path-3``, ... that does not exist.

    The number is in front of ``suffix``, with which the name of a file ends.
    """
    number, stem = first, path.name.removesuffix(suffix)
    while os.path.lexists(place := path.with_name(f"{stem}-{number}{suffix}") if number > 1 else path):
        number += 1
    return place


def spare(name: str, *, suffix: str = "") -> Path:
    """Return a path in the folder for temporary files that does not exist yet, to suggest it to the user."""
    return numbered(Path(tempfile.gettempdir(), name), first=1, suffix=suffix)


def setting_word(key: str, value: object) -> str:
    """Return ``KEY=VALUE`` as it is typed into a shell."""
    return shlex.quote(f"{key}={value}")


def expanded(text: str) -> Path:
    """Return the path that a user has typed, with the home folder in place of ``~``."""
    try:
        return followed(Path(text).expanduser())
    # There is no such user, or no file can have or show this name.
    except (RuntimeError, OSError, ValueError):
        return Path(text)


def typed_path(text: str) -> Path:
    """Return the absolute path that a user has typed, without links unless these form a circle."""
    path = expanded(text)
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        return path.absolute()


def found_file(path: str, key: str) -> Path:
    """Return the path that the setting ``key`` names. Raises ``UserError`` unless it is a file."""
    found = expanded(path)
    require(has_file(found), key, expected="a file", got=path, example=f"{key}=FILE")
    return found


def has_file(folder: Path, name: str = "") -> bool:
    """Return whether ``folder / name`` is a file; False also for a name that no file can have."""
    try:
        return (folder / name).is_file()
    except (OSError, ValueError):
        return False


def shown(path: Path) -> Path:
    """Return ``path`` as a user would type it: relative to the current folder if it is inside it."""
    path = typed_path(str(path))
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
