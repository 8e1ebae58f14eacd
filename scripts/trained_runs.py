"""Runs of ``cadam3d train`` for the scripts that measure: each is trained once, and has a row in a table."""

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def result(folder: Path, settings: Sequence[str]) -> dict[str, Any]:
    """Train with the given settings unless ``folder`` has a result already, and return the run's summary.

    Ends the program if training fails, which has reported the reason.
    """
    summary = folder / "summary.json"
    if not summary.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        line = ["train", *settings, f"hydra.run.dir={folder.absolute()}"]
        print("cadam3d", *line, file=sys.stderr)
        code = subprocess.call([sys.executable, "-m", "cadam3d", *line], stdout=sys.stderr)
        if code:
            sys.exit(f"cadam3d ended with exit code {code}. The same line continues with this run.")
    return json.loads(summary.read_text(encoding="utf-8"))


def folder_name(prompt: str, settings: Sequence[str]) -> str:
    """Return the name of the folder for a prompt and settings, such as ``a_red_boat_seed=1``."""
    return "_".join([*prompt.split(), *settings]).replace("/", "_")


def line_of(cells: Sequence[str]) -> str:
    """Return one line of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def header(columns: Mapping[str, Any]) -> str:
    """Return the two lines at the top of a table in Markdown."""
    return "\n".join([line_of(list(columns)), "|" + "---|" * len(columns)])
