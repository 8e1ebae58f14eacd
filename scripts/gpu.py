"""Check, time and explain the CUDA kernels on this machine's NVIDIA GPU, in at most 25 minutes.

    python scripts/gpu.py                     # checks, then times, then explanations
    python scripts/gpu.py --part checks       # one of the three parts, each less than ten minutes
    python scripts/gpu.py --markdown FILE     # show the JSON of a run as Markdown

If a check fails, nothing is timed, and the stage of the kernels that is wrong is named. The same line
continues where the last one stopped: what has passed is kept, unless the GPU, a package or a file of the
project has changed. Results are in --folder: gpu.json, gpu.md, and logs. Without a GPU, one line says so.
"""

import argparse
import errno
import os
import signal
import sys
from pathlib import Path

if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit(
        "gpu: expected Python 3.11 or newer, got {}.{}. Try: python3.12 scripts/gpu.py".format(
            *sys.version_info
        )
    )

from gpu_run.machine import (
    REPOSITORY,
    NoGpuError,
    TroubleError,
    find_device,
    find_packages,
    fitting_torch,
)
from gpu_run.markdown import show
from gpu_run.pieces import PARTS
from gpu_run.record import read_record
from gpu_run.session import AGAIN, Session

FOLDER = REPOSITORY / "outputs" / "gpu"


class Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line."""

    def error(self, message: str):
        """Print the message and end the program."""
        self.exit(2, f"{self.prog}: {message}\n")


def parse(words: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = Parser("gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--part", nargs="+", choices=PARTS, default=list(PARTS), help="all by default, in this order"
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help="for results; %(default)s by default")
    parser.add_argument("--look", action="store_true", help="only look for a GPU")
    parser.add_argument(
        "--torch", action="store_true", help="only print which torch to install; nothing if there is one"
    )
    parser.add_argument(
        "--markdown", type=Path, metavar="FILE", help="only show the JSON of a run as Markdown"
    )
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    """Do what the command line says, and return the exit code: 1 without a GPU, or if something fails."""
    args = parse(words)
    try:
        return run(args)
    except NoGpuError as error:
        print(f"gpu: expected an NVIDIA GPU, got none: {error}. Try: nvidia-smi", file=sys.stderr)
    except BrokenPipeError:
        # The reader, such as head, has seen enough. Python would complain once more when it flushes the rest.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(
            f"gpu: cannot use {error.filename or args.folder}: {error.strerror}. Try: {advise(error)}",
            file=sys.stderr,
        )
    except (TroubleError, ValueError) as error:
        print(f"gpu: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        print("gpu: stopped. The same line continues.", file=sys.stderr)
        return 130
    return 1


def advise(error: OSError) -> str:
    """Return what to type after an error of the file system."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "df -h"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{AGAIN} --folder /tmp/gpu"
    return f"ls {FOLDER}"


def run(args: argparse.Namespace) -> int:
    """Do what the options say, and return the exit code."""
    if args.markdown:
        print(show(read_record(args.markdown)), end="")
        return 0
    device = find_device()
    if args.torch:
        if "torch" not in find_packages():
            print(fitting_torch(device.driver_cuda))
        return 0
    if args.look:
        # A driver that is too old for every torch ends the run before anything is downloaded.
        fitting_torch(device.driver_cuda)
        print(f"{device.name}, driver for CUDA up to {device.driver_cuda}")
        return 0
    # A signal that ends this process must end the process of a piece, too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    return Session(args.folder.absolute(), device).run([part for part in PARTS if part in args.part])


if __name__ == "__main__":
    sys.exit(main())
