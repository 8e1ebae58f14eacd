"""How a run ends. Apart from ``cadam3d.state``, because a sweep reads outcomes and never needs torch."""

from enum import StrEnum


class Outcome(StrEnum):
    """How a run ended. Running out of memory is an outcome, written down, not a crash."""

    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    MAX_GAUSSIANS = "max_gaussians"
    OUT_OF_MEMORY = "out_of_memory"
    VANISHED = "vanished"  # every Gaussian was pruned
    FAILED = "failed"
    KILLED = "killed"  # by a signal, such as that of the system when memory is out; written by the sweep
