"""Runs the kernels at small and at odd sizes, with whatever the sanitizers watch; started by a test.

python sanitized.py <folder to compile in> <folder of the kernels> <flag of the compiler> ...
"""

import os
import sys
from pathlib import Path

import torch
from emulation import compile_emulator
from splats import backgrounds, make_cameras, make_gaussians, make_weights, render_and_differentiate

from cadam3d.rasterizer import cuda

CPU = torch.device("cpu")
ODD = (1, 2, 31, 33, 255, 257, cuda.SCAN_CHUNK, cuda.SORT_CHUNK - 1, cuda.SORT_CHUNK + 1, cuda.SCAN_SHORT + 1)


def main(folder: Path, kernels: Path, flags: tuple[str, ...]) -> None:
    os.environ.pop("LD_PRELOAD")  # is for this process: the compiler needs no sanitizer
    emulator = compile_emulator(folder, kernels, "-O0", flags)
    with emulator.on(CPU) as launch:
        for n in ODD:
            keys = torch.arange(n, 0, -1, dtype=torch.int32)
            assert torch.equal(cuda._sort(launch, keys, 16)[0].long(), keys.long().sort().values)
            assert cuda._scan(launch, torch.ones(n, dtype=torch.int32))[-1] == n - 1
    for degree in range(4):
        cuda.RECORD_MEMORY = 0 if degree == 1 else 256 * 2**20  # one group per view, or one for all
        size = (9 + degree, 17)
        gaussians, cameras = make_gaussians(33, degree=degree, log_scale=-1.0), make_cameras(2, *size)
        scene = gaussians, cameras, backgrounds(2), make_weights(2, *size)
        render_and_differentiate(emulator.render, *scene, absgrad=degree > 0)
    wide = make_gaussians(3, log_scale=1.5), make_cameras(1, 75, 70), backgrounds(1), make_weights(1, 75, 70)
    for absgrad in (False, True):
        render_and_differentiate(
            emulator.render, *wide, absgrad=absgrad
        )  # more than a thread lists, or sums, alone
    print("all done")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), tuple(sys.argv[3:]))
