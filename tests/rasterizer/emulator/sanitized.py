"""Run sanitized kernels at small and at odd sizes, and then once with each planted mistake.

python sanitized.py LIBRARY NUMBER_OF_MISTAKES, started by test_cuda_sanitizer.py. Writes a line to stderr
before each planted mistake, so that the findings of the sanitizers can be distinguished. With the word
"races" instead of the number, it runs what can differ between threads.
"""

import ctypes
import sys
from functools import partial

import torch
from emulation import Emulator, count_slots, scan_tensor, sort_tensor
from splats import backgrounds, make_cameras, make_gaussians, make_weights, render_and_differentiate

from cadam3d.rasterizer import cuda, cuda_sort

CPU = torch.device("cpu")
SCANNED = (1, 31, 33, 257, cuda_sort.SCAN_CHUNK, cuda_sort.SCAN_CHUNK + 1)
SORTED = (1, 33, 257, 1023, 2049)
# The numbers up to which blocks count and add alone, and the largest number of blocks.
LAYOUTS = ((2**15, 2**15, 512), (0, 2**15, 512), (0, 0, 1))


def run_everything(emulator: Emulator) -> None:
    for cuda_sort.FEW_NUMBERS, cuda_sort.FEW_COUNTS, cuda_sort.MOST_BLOCKS in LAYOUTS:
        with emulator.on(CPU) as launch:
            for n in SCANNED:
                assert scan_tensor(launch, torch.ones(n, dtype=torch.int32))[-1] == n
            for n in SORTED:
                keys = torch.arange(n, 0, -1, dtype=torch.int32)
                assert torch.equal(sort_tensor(launch, keys, 16)[0].long(), keys.long().sort().values)
    for degree in range(4):
        # One group per view, or one for all views.
        cuda.RECORD_MEMORY = 0 if degree == 1 else 256 * 2**20
        # Tiles of 8x4 or of 8x8.
        cuda.FEW_TILES = 10**9 if degree % 2 else 0
        render(emulator, 33, degree, -1.0, (2, 9 + degree, 17), absgrad=degree > 0)
    # Memory that is reserved ahead: just enough, one slot too little, none.
    slots = sum(count_slots(emulator, make_gaussians(33, log_scale=-1.0), make_cameras(2, 9, 17)))
    for capacity in (slots, slots - 1, 0):
        render(emulator, 33, 0, -1.0, (2, 9, 17), absgrad=True, capacity=capacity)
    # These splats touch more tiles, and have more records, than one thread handles alone.
    for absgrad in (False, True):
        cuda.FEW_TILES = 10**9 if absgrad else 0
        render(emulator, 3, 0, 1.5, (1, 75, 70), absgrad=absgrad)


def run_races(emulator: Emulator) -> None:
    for cuda_sort.FEW_NUMBERS, cuda_sort.FEW_COUNTS, cuda_sort.MOST_BLOCKS in LAYOUTS[:2]:
        with emulator.on(CPU) as launch:
            scan_tensor(launch, torch.ones(cuda_sort.SCAN_CHUNK + 1, dtype=torch.int32))
            sort_tensor(launch, torch.arange(cuda_sort.SCAN_CHUNK + 1, 0, -1, dtype=torch.int32), 8)
    for absgrad in (False, True):
        cuda.FEW_TILES = 10**9 if absgrad else 0
        render(emulator, 33, 0, -1.0, (2, 9, 17), absgrad=absgrad)


def render(
    emulator: Emulator,
    n: int,
    degree: int,
    log_scale: float,
    size: tuple[int, int, int],
    absgrad: bool,
    capacity: int | None = None,
) -> None:
    gaussians, cameras = make_gaussians(n, degree=degree, log_scale=log_scale), make_cameras(*size)
    scene = gaussians, cameras, backgrounds(size[0]), make_weights(*size)
    render_and_differentiate(partial(cuda.rasterize, emulator, capacity=capacity), *scene, absgrad=absgrad)


def sanitize(emulator: Emulator, mistakes: int) -> None:
    run_everything(emulator)
    for mutant in range(1, mistakes + 1):
        print(f"planted {mutant}", file=sys.stderr, flush=True)
        emulator.activate(mutant)
        render(emulator, 10, 0, -1.0, (1, 9, 17), absgrad=False)


def look_for_races(emulator: Emulator) -> None:
    """Run with ordered blocks and a race between lanes, then with unordered ones and a race between blocks.

    ThreadSanitizer reports the same two places only once, and with unordered blocks it also reports all of
    the shared memory, so the order matters.
    """
    run_races(emulator)
    print("planted 1", file=sys.stderr, flush=True)
    emulator.activate(1)
    render(emulator, 10, 0, -1.0, (1, 9, 17), absgrad=False)
    print("unordered", file=sys.stderr, flush=True)
    emulator.activate(0)
    ctypes.c_int.in_dll(emulator.library, "unordered_blocks").value = 1
    run_races(emulator)
    print("planted 2", file=sys.stderr, flush=True)
    emulator.activate(2)
    with emulator.on(CPU) as launch:
        scan_tensor(launch, torch.ones(cuda_sort.SCAN_CHUNK + 1, dtype=torch.int32))


if __name__ == "__main__":
    kernels, count = Emulator(ctypes.CDLL(sys.argv[1])), sys.argv[2]
    look_for_races(kernels) if count == "races" else sanitize(kernels, int(count))
    print("all done", flush=True)
