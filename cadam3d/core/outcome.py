"""Outcome: how a run ended. Separate from ``cadam3d.state``, because sweeps read outcomes without torch."""

from enum import StrEnum


class Outcome(StrEnum):
    """How a run ended. Running out of memory is an outcome that is recorded, not a crash."""

    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    MAX_GAUSSIANS = "max_gaussians"
    OUT_OF_MEMORY = "out_of_memory"
    VANISHED = "vanished"  # every Gaussian was pruned
    FAILED = "failed"
    # By a signal, such as the one that the system sends when memory is short; recorded by the sweep.
    KILLED = "killed"
