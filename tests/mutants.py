"""Mistakes that are planted in a copy of the CUDA kernels, to prove that the tests find them.

A mutant is a file, a piece of its text, and the text that replaces it. ``MUTANT`` in the new text is true
while that mutant is switched on (``Emulator.activate``), so one compilation holds all of them.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from cadam3d.rasterizer.base import KERNELS

# The scenes of the judges have degree 0: kernels for more coefficients would only cost compile time.
UNUSED = "KERNELS_FOR(4)\nKERNELS_FOR(9)\nKERNELS_FOR(16)\n"
ONLY_DEGREE_0 = "#define EMULATOR_ONLY_DEGREE_0\n"

RENDERING = {
    "the last row of tiles is forgotten": (
        "tiles.cuh",
        "row <= last_row;",
        "row <= last_row - MUTANT;",
    ),
    "a list that misses its last splat": ("tiles.cuh", "= u32(e + 1);", "= MUTANT ? u32(e) : u32(e + 1);"),
    "no wait for the stage": (
        "blend.cuh",
        "    __syncwarp();\n    const u32 count",
        "    if (!MUTANT) __syncwarp();\n    const u32 count",
    ),
    "the last splat is off by one": (
        "blend.cuh",
        "colour, mark)",
        "colour, mark - MUTANT)",
    ),
    "a pixel that never closes": ("blend.cuh", ": -fabsf(before);", ": MUTANT ? before : -fabsf(before);"),
    "a closed pixel that opens again": (
        "blend.cuh",
        ": -fabsf(before);",
        ": MUTANT ? -before : -fabsf(before);",
    ),
    "the two pixels of a lane too far apart": (
        "blend.cuh",
        "__fmaf_rn(float(STRIDE), centre.w, o.u)",
        "__fmaf_rn(float(STRIDE + MUTANT), centre.w, o.u)",
    ),
    "the second pixel of a lane instead of both": (
        "blend.cuh",
        "sum = IS_FIRST ? x * y :",
        "sum = IS_FIRST || MUTANT ? x * y :",
    ),
    "no gate at the largest alpha": (
        "blend.cuh",
        "free <= float(SPLAT_ALPHA_MAX) ? slope : 0.0f",
        "MUTANT || free <= float(SPLAT_ALPHA_MAX) ? slope : 0.0f",
    ),
    "a shuffle in a branch": (
        "blend.cuh",
        "if (__any_sync(ALL, any_hit))",
        "if (MUTANT ? any_hit : __any_sync(ALL, any_hit))",
    ),
    "two sums are swapped": (
        "blend.cuh",
        "fold(b4, s.gt, s.green, 16)",
        "fold(b4, MUTANT ? s.green : s.gt, MUTANT ? s.gt : s.green, 16)",
    ),
    "a sum that is not folded": ("blend.cuh", "q2 = fold_one(p2, 8)", "q2 = MUTANT ? p2 : fold_one(p2, 8)"),
    "a sum in the place of another one": ("blend.cuh", "(b3 ? 4 : 1)", "(b3 != MUTANT ? 4 : 1)"),
    "records are not cleared": ("blend.cuh", "e = dead + nth;", "e = MUTANT ? end : dead + nth;"),
    "records are not cleared to their end": (
        "blend.cuh",
        "part = u32(lane) % (RECORD / 2),",
        "part = u32(lane) % (RECORD / 2 - MUTANT),",
    ),
    "a cut to another base than the whitening": (
        "project.cuh",
        "cut = LOG2_E * shape.log_cut",
        "cut = (MUTANT ? 1 : LOG2_E) * shape.log_cut",
    ),
    "first moments to another base": (
        "project.cuh",
        "once = SQRT_LN_2,",
        "once = MUTANT ? LN_2 : SQRT_LN_2,",
    ),
    "second moments to another base": ("project.cuh", "twice = LN_2;", "twice = MUTANT ? SQRT_LN_2 : LN_2;"),
    "half of a long run": (
        "project.cuh",
        "slot < from + many; slot += WARP",
        "slot < from + (MUTANT ? many / 2 : many); slot += WARP",
    ),
}
ABSOLUTE_GRADIENTS = {
    "absolute values that cancel": (
        "blend.cuh",
        "(absolutes.u, fabsf(gu));",
        "(absolutes.u, MUTANT ? gu : fabsf(gu));",
    ),
    "absolute values are not cleared": (
        "blend.cuh",
        "e = dead + lane;",
        "e = MUTANT ? end : dead + lane;",
    ),
    "absolute values to another base": (
        "project.cuh",
        "sum[0] *= SQRT_LN_2, sum[1] *= LN_2;",
        "sum[0] *= SQRT_LN_2, sum[1] *= MUTANT ? 1 : LN_2;",
    ),
}
# These need tiles of 8x4.
SMALL_TILES = {
    "tiles that are listed with another height than they are counted with": (
        "tiles.cuh",
        "grid = make_grid(height, width, tile_height);",
        "grid = make_grid(height, width, MUTANT ? 8 : tile_height);",
    ),
    "tiles that are blended with another height than they are listed with": (
        "blend.cuh",
        "tile_height = PIXELS * STRIDE;",
        "tile_height = (MUTANT ? 2 : PIXELS) * STRIDE;",
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
# Mistakes in the number of slots that is on the device.
COUNTED = {
    "a capacity that is one too small": (
        "tiles.cuh",
        "const bool fits = i64(*total) <= capacity;",
        "const bool fits = i64(*total) <= capacity - MUTANT;",
    ),
    "a capacity that is one too large": (
        "tiles.cuh",
        "if (!fits) return;",
        "if (!fits && !(MUTANT && i64(*total) == capacity + 1)) return;",
    ),
    "an overflow that is not reported": (
        "tiles.cuh",
        "*overflowed = !fits;",
        "*overflowed = MUTANT ? false : !fits;",
    ),
    "ranges that are not cleared": (
        "tiles.cuh",
        "ranges[i] = 0;",
        "ranges[i] = MUTANT ? ranges[i] : 0;",
    ),
    "a sort that believes a total that does not fit": (
        "device.cuh",
        "return i64(*total) <= capacity ? i64(*total) : 0;",
        "return i64(*total) <= capacity || MUTANT ? i64(*total) : 0;",
    ),
    "gradients from records that do not exist": (
        "project.cuh",
        "if (is_mine && i64(*total_slots) <= capacity)",
        "if (is_mine && (MUTANT || i64(*total_slots) <= capacity))",
    ),
    "absolute gradients from records that do not exist": (
        "project.cuh",
        "const bool has_records = i64(*total) <= capacity;",
        "const bool has_records = MUTANT || i64(*total) <= capacity;",
    ),
    "a report of the Gaussians alone": ("tiles.cuh", "<< 32 | *total;", "<< 32 | (MUTANT ? 0 : *total);"),
}
SORTING = {
    "sums that wrap around": ("sort.cuh", "a + b < a ? ALL", "a + b < a && !MUTANT ? ALL"),
    "no barrier in the prefix sum": (
        "sort.cuh",
        "sums[warp] = carry;\n  __syncthreads();",
        "sums[warp] = carry;\n  if (!MUTANT) __syncthreads();",
    ),
    "a barrier that not all threads reach": (
        "sort.cuh",
        "  __syncthreads();  // after this",
        "  if (threadIdx.x || !MUTANT) __syncthreads();  // after this",
    ),
    "no barrier before the memory of sums is used again": (
        "sort.cuh",
        "numbers[r] = add_saturating(before, numbers[r]);",
        "numbers[r] = add_saturating(before, numbers[r]);\n  if (MUTANT) return total;",
    ),
    "a sum without the blocks before": (
        "sort.cuh",
        "i < blockIdx.x; i += BLOCK",
        "i < blockIdx.x && !MUTANT; i += BLOCK",
    ),
    "every block writes the total": (
        "sort.cuh",
        "threadIdx.x == 0 && share.end == u32(n)",
        "threadIdx.x == 0 && (MUTANT || share.end == u32(n))",
    ),
    "a digit without its highest bit": (
        "sort.cuh",
        "key >> shift & (values() - 1)",
        "key >> shift & ((values() >> MUTANT) - 1)",
    ),
    "votes on one bit too few": (
        "sort.cuh",
        "step <= DIGIT_BITS; ++step",
        "step <= DIGIT_BITS - MUTANT; ++step",
    ),
    "counters that are not ready": (
        "sort.cuh",
        "memory[i] = 0;\n    __syncthreads();",
        "memory[i] = 0;\n    if (!MUTANT) __syncthreads();",
    ),
    "counters that are not complete": (
        "sort.cuh",
        "      }\n    }\n    __syncthreads();\n  }\n  SPLAT_FN u32 sum",
        "      }\n    }\n    if (!MUTANT) __syncthreads();\n  }\n  SPLAT_FN u32 sum",
    ),
    "a key on the wrong side of the middle": (
        "sort.cuh",
        "j * BLOCK < middle ?",
        "j * BLOCK < middle + MUTANT ?",
    ),
    "no barrier between the columns": (
        "sort.cuh",
        "sums[warp][lane] = sum;\n  __syncthreads();",
        "sums[warp][lane] = sum;\n  if (!MUTANT) __syncthreads();",
    ),
    "rows that were never written": (
        "sort.cuh",
        "n > 0 ? (n + size - 1) / size : 0;",
        "MUTANT ? u32(blocks) : n > 0 ? (n + size - 1) / size : 0;",
    ),
    "counts of this block belong to those before": (
        "sort.cuh",
        "first + j < block ?",
        "first + j < block + MUTANT ?",
    ),
    "no barrier before the totals are read": (
        "sort.cuh",
        "bases[i] = totals[i];\n    __syncthreads();",
        "bases[i] = totals[i];\n    if (!MUTANT) __syncthreads();",
    ),
    "no barrier behind cleared bins": (
        "sort.cuh",
        "stage.pairs[i] = 0;\n    __syncthreads();",
        "stage.pairs[i] = 0;\n    if (!MUTANT) __syncthreads();",
    ),
    "no wait before a bin moves on": (
        "sort.cuh",
        "      __syncwarp();  // all",
        "      if (!MUTANT) __syncwarp();  // all",
    ),
    "a bin that does not move on": ("sort.cuh", "u16(place[r] + 1);", "u16(place[r] + !MUTANT);"),
    "no barrier before counts become places": (
        "sort.cuh",
        "    __syncthreads();\n    // Counts become places",
        "    if (!MUTANT) __syncthreads();\n    // Counts become places",
    ),
    "no barrier before places are read": (
        "sort.cuh",
        "places[r] = next;\n      });\n    __syncthreads();",
        "places[r] = next;\n      });\n    if (!MUTANT) __syncthreads();",
    ),
    "no barrier before items replace bins": (
        "sort.cuh",
        "    __syncthreads();  // the bins have been read",
        "    if (!MUTANT) __syncthreads();  // the bins have been read",
    ),
    "no barrier before the items are read": (
        "sort.cuh",
        "      }\n    __syncthreads();\n#pragma unroll 4",
        "      }\n    if (!MUTANT) __syncthreads();\n#pragma unroll 4",
    ),
    "no barrier before the next chunk": (
        "sort.cuh",
        "    __syncthreads();  // the bases and",
        "    if (!MUTANT) __syncthreads();  // the bases and",
    ),
    "bases that do not move on": (
        "sort.cuh",
        "+= ends[pair] & 0xffff,",
        "+= MUTANT ? 0 : ends[pair] & 0xffff,",
    ),
}
MUTANTS = RENDERING | ABSOLUTE_GRADIENTS | SMALL_TILES | ROUNDING | COUNTED | SORTING
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
