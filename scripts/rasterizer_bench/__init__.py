"""Checks and times of rasterizers, for ``scripts/bench_rasterizer.py`` and ``scripts/gpu.py``."""

import sys
from pathlib import Path

# The scripts measure the package that they stand beside, from any folder and without PYTHONPATH.
sys.path.insert(0, str(Path(__file__).parents[2]))
