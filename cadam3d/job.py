"""``python -m cadam3d.job PARENT train key=value ...``: ``cadam3d`` for as long as process PARENT lives.

A sweep starts its jobs like this, so that they end with it.
"""

import signal
import sys
from collections.abc import Sequence

from cadam3d import cli
from cadam3d.sweep.process import ANNOUNCING, end_with


def main(words: Sequence[str]) -> None:
    """Run ``cadam3d`` with ``words[1:]`` until it ends or process ``words[0]`` ends."""
    for number in ANNOUNCING:  # Slurm sends these to all processes; the launcher passes them on to the job
        signal.signal(number, signal.SIG_IGN)
    end_with(int(words[0]))
    sys.argv = ["cadam3d", *words[1:]]
    cli.main()


if __name__ == "__main__":
    main(sys.argv[1:])
