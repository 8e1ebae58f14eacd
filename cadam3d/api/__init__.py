"""The Python API: what ``import cadam3d`` offers to other programs and to notebooks (``docs/python.md``)."""

import os
import sys

OPENMP = "OMP_WAIT_POLICY"


def _load_torch() -> None:
    """Load torch with threads that sleep while they wait, as the command line does.

    OpenMP reads the variable once, while torch is loaded, so nothing can be done if torch is loaded already
    or if the user has set the variable. Spinning threads slow two busy programs on one machine tenfold. The
    environment is restored, because programs that the user starts later should not notice.
    """
    if "torch" in sys.modules or OPENMP in os.environ:
        return
    os.environ[OPENMP] = "PASSIVE"
    try:
        import torch  # noqa: F401  (loaded for its effect)
    finally:
        del os.environ[OPENMP]


_load_torch()
