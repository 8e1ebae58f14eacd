"""Mistakes that are planted in a copy of the CUDA kernels, to prove that the tests find them.

A mutant is a file, a piece of its text, and the text that replaces it. ``MUTANT`` in the new text is true
while that mutant is switched on (``Emulator.activate``), so one compilation holds all of them.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from cadam3d.rasterizer.sources import KERNELS

# The scenes of the judges have degree 0: kernels for more coefficients would only cost compile time.
UNUSED = "KERNELS_FOR(4)\nKERNELS_FOR(9)\nKERNELS_FOR(16)\n"
ONLY_DEGREE_0 = "#define EMULATOR_ONLY_DEGREE_0\n"

RENDERING = {
    "no barrier in the prefix sum": (
        "sort.cuh",
        "    sums[t] = inclusive;\n    __syncthreads();\n  }",
        "    sums[t] = inclusive;\n    if (!MUTANT) __syncthreads();\n  }",
    ),
    "a barrier that not all threads reach": (
        "sort.cuh",
        "  __syncthreads();  // after this",
        "  if (t || !MUTANT) __syncthreads();  // after this",
    ),
    "no wait before a bin moves on": (
        "sort.cuh",
        "    __syncwarp();  // all",
        "    if (!MUTANT) __syncwarp();  // all",
    ),
    "a bin that does not move on": ("sort.cuh", "= at + 1;", "= MUTANT ? at : at + 1;"),
    "no barrier before bins become positions": (
        "sort.cuh",
        "  __syncthreads();\n  u32 position",
        "  if (!MUTANT) __syncthreads();\n  u32 position",
    ),
    "the last row of tiles is forgotten": (
        "tiles.cuh",
        "row <= rows.last / TILE",
        "row <= rows.last / TILE - MUTANT",
    ),
    "a list that misses its last splat": ("tiles.cuh", "= u32(e + 1);", "= MUTANT ? u32(e) : u32(e + 1);"),
    "no wait for the stage": (
        "blend.cuh",
        "    __syncwarp();\n    const int count",
        "    if (!MUTANT) __syncwarp();\n    const int count",
    ),
    "the last splat is off by one": (
        "blend.cuh",
        "u32(base - begin) + j + 1)",
        "u32(base - begin) + j + !MUTANT)",
    ),
    "a pixel that never closes": ("blend.cuh", "pixel.is_open = false;", "pixel.is_open = MUTANT;"),
    "no gate at the largest alpha": (
        "blend.cuh",
        "free <= float(SPLAT_ALPHA_MAX) ? -alpha * g_alpha : 0.0f",
        "MUTANT || free <= float(SPLAT_ALPHA_MAX) ? -alpha * g_alpha : 0.0f",
    ),
    "a shuffle in a branch": (
        "blend.cuh",
        "if (__any_sync(ALL, hit0 || hit1))",
        "if (MUTANT ? hit0 || hit1 : __any_sync(ALL, hit0 || hit1))",
    ),
    "two sums are swapped": (
        "blend.cuh",
        "fold(b4, s.gt, s.green, 16)",
        "fold(b4, MUTANT ? s.green : s.gt, MUTANT ? s.gt : s.green, 16)",
    ),
    "records are not cleared": (
        "blend.cuh",
        "e = begin + used + lane;",
        "e = MUTANT ? end : begin + used + lane;",
    ),
    "half of a long run": (
        "project.cuh",
        "slot < from + many; slot += WARP",
        "slot < from + (MUTANT ? many / 2 : many); slot += WARP",
    ),
}
ABSOLUTE_GRADIENTS = {
    "absolute values that cancel": (
        "blend.cuh",
        "absolutes.u += fabsf(gu);",
        "absolutes.u += MUTANT ? gu : fabsf(gu);",
    ),
    "absolute values are not cleared": (
        "blend.cuh",
        "j < ABSOLUTES; ++j) absolutes",
        "j < (MUTANT ? 0 : ABSOLUTES); ++j) absolutes",
    ),
}
# This one must be harmless: a compiler might round differently where tiles are listed than where they are
# counted. It lists one tile too many for some pairs and one too few for others.
ROUNDING = {
    "lists that disagree with their counts": (
        "tiles.cuh",
        "each_tile_row(s, grid, [&](int row, int first, int last) {",
        "each_tile_row(s, grid, [&](int row, int first, int last) {"
        " if (MUTANT) last += pair % 3 == 0 ? 1 : pair % 3 == 1 ? -1 : 0;",
    ),
}
MUTANTS = RENDERING | ABSOLUTE_GRADIENTS | ROUNDING
NUMBERS = {name: number for number, name in enumerate(MUTANTS, start=1)}


def plant(mutants: Mapping[str, tuple[str, str, str]], folder: Path, only_degree_0: bool = True) -> Path:
    """Return a copy of the kernels in ``folder`` that holds all mutants, numbered from 1 in their order."""
    copy = folder / "kernels"
    shutil.copytree(KERNELS, copy)
    for number, (name, original, changed) in enumerate(mutants.values(), start=1):
        replace_once(copy / name, original, changed.replace("MUTANT", f"(active_mutant == {number})"))
    if only_degree_0:
        replace_once(copy / "project.cuh", UNUSED, "")
        (copy / "cuda.cu").write_text(ONLY_DEGREE_0 + (copy / "cuda.cu").read_text())
    return copy


def replace_once(path: Path, original: str, changed: str) -> None:
    """Replace a text that the file contains exactly once."""
    source = path.read_text()
    assert source.count(original) == 1, original
    path.write_text(source.replace(original, changed))
