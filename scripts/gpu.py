"""Check, time and explain the CUDA kernels on this machine's NVIDIA GPU, in at most 35 minutes.

    python scripts/gpu.py                     # all parts
    python scripts/gpu.py --part checks       # one part, less than ten minutes

If the self-test or the difficult scenes fail, nothing is timed, and the stage of the kernels that is wrong is
named. The same line continues where the last one stopped: what has passed is kept, unless the GPU, a package
or a file of the project has changed. Results are in --folder: gpu.json, gpu.md, and logs. Without a GPU, one
line says so.
"""

import argparse
import sys
from pathlib import Path

if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit(
        f"gpu: expected Python 3.11 or newer, got {sys.version.split()[0]}. "
        "Try: uv python install 3.12, or conda create -p python3.12 python=3.12"
    )

from gpu_run import session
from gpu_run.machine import REPOSITORY, TroubleError, find_device, find_packages, fitting_torch
from gpu_run.pieces import PARTS


def parse(words: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        "gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS), help="default: all")
    parser.add_argument("--folder", type=Path, default=REPOSITORY / "outputs" / "gpu", help="for results")
    parser.add_argument("--look", action="store_true", help="only look for a GPU")
    parser.add_argument(
        "--torch", action="store_true", help="only print which torch to install; nothing if there is one"
    )
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    """Do what the command line says, and return the exit code: 1 without a GPU, or if something fails."""
    args = parse(words)
    try:
        device = find_device()
        # A driver that is too old for every torch ends the run before anything is downloaded.
        torch = fitting_torch(device.driver_cuda)
        if args.torch:
            print(torch if "torch" not in find_packages() else "")
        elif args.look:
            print(f"{device.name}, driver for CUDA up to {device.driver_cuda}")
        else:
            return session.run(args.folder.absolute(), device, [part for part in PARTS if part in args.part])
    except (TroubleError, OSError) as error:
        print(f"gpu: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("gpu: stopped. The same line continues.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
