"""Job: run ``cadam3d`` in a process that ends with its parent process, as a sweep starts its jobs.

The command is ``python -m cadam3d.job PARENT train key=value ...``; PARENT is the id of the parent process.
"""

import signal
import sys
from collections.abc import Sequence

from cadam3d import cli
from cadam3d.sweep.process import ANNOUNCING, end_with


def main(words: Sequence[str]) -> None:
    """Run ``cadam3d`` with ``words[1:]`` until it ends or process ``words[0]`` ends."""
    # Slurm sends these signals to all processes. The launcher handles them and stops this job.
    for number in ANNOUNCING:
        signal.signal(number, signal.SIG_IGN)
    end_with(int(words[0]))
    sys.argv = ["cadam3d", *words[1:]]
    cli.main()


if __name__ == "__main__":
    main(sys.argv[1:])
