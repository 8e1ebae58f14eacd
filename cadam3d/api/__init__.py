"""The Python API: what ``import cadam3d`` offers to other programs and to notebooks (``docs/python.md``)."""

import os
import sys

from cadam3d.core.openmp import waiting


def _load_torch() -> None:
    """Load torch with threads that sleep while they wait, as the command line does.

    OpenMP reads its variables once, while torch is loaded, so nothing can be done if torch is loaded already
    or if the user has chosen a policy. The environment is restored, because programs that the user starts
    later should not notice.
    """
    added = waiting(os.environ)
    if "torch" in sys.modules or not added:
        return
    os.environ.update(added)
    try:
        import torch  # noqa: F401  (loaded for its effect)
    finally:
        for name in added:
            del os.environ[name]


_load_torch()
