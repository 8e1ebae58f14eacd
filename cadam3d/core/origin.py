"""Origin: the commit of the code and the machine that the numbers of a run come from."""

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[2]
DIGITS = 7  # of a commit


def origin_on(device: torch.device) -> dict[str, Any]:
    """Return the commit, the machine and the number of torch's threads, for ``summary.json``."""
    return {"commit": commit(), "machine": machine(device), "threads": torch.get_num_threads()}


def commit(root: Path = ROOT) -> str | None:
    """Return the commit of the checkout in ``root``, such as ``fbdfba5``, or ``fbdfba5-dirty``.

    It is dirty if files that git knows have changed. None without a checkout, as for an installed wheel, and
    if git cannot be run.
    """
    # Otherwise git would look in the folders above, and find the project of a user who has installed cadam3d.
    if not (root / ".git").exists():
        return None
    command = ["git", "--no-optional-locks", "status", "--porcelain=v2", "--branch", "--untracked-files=no"]
    try:
        answer = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    lines = answer.stdout.splitlines()
    found = next(line.split()[-1][:DIGITS] for line in lines if line.startswith("# branch.oid"))
    return found if all(line.startswith("#") for line in lines) else f"{found}-dirty"


def machine(device: torch.device) -> str:
    """Return the name of the GPU or the CPU that computes, and the number of cores of the machine."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor()
    return f"{name}, {os.cpu_count()} cores"


def processor() -> str:
    """Return the name of the CPU, as far as the system reports it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
