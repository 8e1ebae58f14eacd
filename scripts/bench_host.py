"""Measure the host time of rasterizer=cuda on a machine without a GPU, here and in another checkout.

    python scripts/bench_host.py --base ../cadam3d-before

A driver of a few lines, compiled at the start, accepts every launch and does nothing. Tensors on the CPU
stand for the memory of a device. So the time is what Python, torch's autograd, the allocator and the calls of
the driver cost, which is all that the host does. A call of this driver takes no time inside, while a real
launch is estimated to take about two more microseconds. A torch operation on CPU tensors stands for one that
launches a kernel of torch; a few of them compute in microseconds what a device would compute meanwhile. The
choice of the device and its stream (``Driver.on``) and the upload of cameras are left out, because torch.cuda
answers only where there is a device. The kernels do nothing, so the images are garbage.

Times are CPU times of the process with one thread, which other load of the machine hardly changes. Both trees
take turns. The counts are of one forward and backward pass.
"""

import argparse
import ctypes
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from measuring import (
    HERE,
    add_base,
    environment_of,
    find_trees,
    in_turns,
    machine,
    median,
    new_file,
    parser_of,
    positive,
    table,
    write,
)

# Each Gaussian touches this many tiles in each view.
TILES = 16
# Options of mallopt.
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
WAYS = {"exact": "rasterize", "ahead": "rasterize_ahead"}
STUB = """
#include <string.h>
#include <time.h>
typedef unsigned long long u64;
struct Kernel { char name[64]; };
static Kernel kernels[64];
static int known = 0, tiles = 0;
static u64 pairs = 0;
static u64 now() {
  timespec time;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
  return u64(time.tv_sec) * 1000000000 + u64(time.tv_nsec);
}
extern "C" {
u64 stub_launches = 0, stub_nanoseconds = 0;
void stub_start(int of_each_pair, u64 all_pairs) { tiles = of_each_pair, pairs = all_pairs; }
int cuInit(unsigned) { return 0; }
int cuDeviceGet(int* device, int ordinal) { *device = ordinal; return 0; }
int cuDevicePrimaryCtxRetain(void** context, int) { *context = &known; return 0; }
int cuCtxPushCurrent_v2(void*) { return 0; }
int cuCtxPopCurrent_v2(void**) { return 0; }
int cuModuleLoadData(void** module, const void*) { *module = &known; return 0; }
int cuModuleGetFunction(void** function, void*, const char* name) {
  strncpy(kernels[known].name, name, 63);
  *function = &kernels[known++];
  return 0;
}
int cuLaunchKernel(Kernel* kernel, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned,
                   void*, void** arguments, void** extra) {
  ++stub_launches;
  // Some numbers must make sense to the host: the tiles of each pair, the last result of the projection, and
  // in older trees the order of the pairs, the last result of the sort, which torch uses as an index.
  const bool is_projection = strncmp(kernel->name, "project_forward", 15) == 0;
  if (is_projection || (arguments && strcmp(kernel->name, "sort_scatter") == 0)) {
    const u64 begin = now();
    u64 to = arguments ? *(u64*)arguments[is_projection ? 14 : 7] : ((u64*)extra[1])[*(u64*)extra[3] / 8 - 1];
    unsigned* numbers = (unsigned*)to;
    const unsigned number = is_projection ? tiles : 0;
    for (u64 i = 0; i < pairs; ++i) numbers[i] = number;
    stub_nanoseconds += now() - begin;
  }
  return 0;
}
int cuGetErrorString(int, const char** text) { *text = "error"; return 0; }
}
"""


def main() -> None:
    """Print the table."""
    args = read_arguments()
    if args.stub:
        print(json.dumps(measure(args)))
        return
    with tempfile.TemporaryDirectory() as folder:
        stub = compile_stub(Path(folder))
        works = {name: partial(start, tree, stub, args) for name, tree in find_trees(args.base).items()}
        found = {name: median(turns) for name, turns in in_turns(works, args.repeats).items()}
    rows = [
        {"": f"{tree}, {way}"} | {name: f"{number:.0f}" for name, number in numbers.items()}
        for tree, ways in found.items()
        for way, numbers in ways.items()
    ]
    for row, numbers in zip(rows, (each for ways in found.values() for each in ways.values()), strict=True):
        if "base" in found:
            row["to base, exact"] = f"{numbers['sum_us'] / found['base']['exact']['sum_us']:.2f}"
    print(
        f"{args.count} Gaussians, {args.views} views, {args.size} px, stub driver, CPU time\n\n{table(rows)}"
    )
    write(args.json, {"machine": machine(), **found})


def read_arguments() -> argparse.Namespace:
    parser = parser_of(__doc__)
    add_base(parser)
    parser.add_argument("--count", type=positive, default=20_000, help="Gaussians (default: 20000)")
    parser.add_argument("--size", type=positive, default=512, help="pixels along an edge (default: 512)")
    parser.add_argument("--views", type=positive, default=1, help="views (default: 1)")
    parser.add_argument("--steps", type=positive, default=200, help="passes in each process (default: 200)")
    parser.add_argument("--repeats", type=positive, default=5, help="processes of each tree (default: 5)")
    parser.add_argument("--json", type=new_file, help="also write all numbers to this file")
    parser.add_argument("--stub", help=argparse.SUPPRESS)
    return parser.parse_args()


def compile_stub(folder: Path) -> Path:
    # The script also runs where another cadam3d is installed, or none.
    sys.path.insert(0, str(HERE))
    from cadam3d.compiled.library import find_compiler

    compiler = find_compiler()
    if compiler is None:
        raise SystemExit("bench_host: no C++ compiler. Try: cadam3d doctor")
    source, library = folder / "stub.cpp", folder / "stub.so"
    source.write_text(STUB)
    subprocess.run(
        [*compiler.command, "-O1", "-shared", "-fPIC", str(source), "-o", str(library)], check=True
    )
    return library


def start(tree: Path, stub: Path, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Return what :func:`measure` returns in a process that imports the sources of ``tree``."""
    sizes = [f"--{name}={getattr(args, name)}" for name in ("count", "size", "views", "steps")]
    command = [sys.executable, str(Path(__file__).resolve()), f"--stub={stub}", *sizes]
    environment = environment_of(tree) | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{tree}: {done.stderr}")
    return json.loads(done.stdout)


def measure(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Return microseconds and counts of the forward and the backward pass, for each way to render."""
    import torch

    from cadam3d.rasterizer import cuda

    torch.set_num_threads(1)
    keep_memory()
    stub = ctypes.CDLL(args.stub)
    stub.stub_start(TILES, ctypes.c_uint64(args.views * args.count))
    launcher = StubLauncher(stub)
    found = {}
    for way, function in WAYS.items():
        if not hasattr(cuda, function):
            continue
        forward, backward = make_step(getattr(cuda, function), launcher, args)
        for _ in range(args.steps):
            backward(forward())
        found[way] = time_step(forward, backward, stub, args.steps) | count_step(forward, backward, stub)
    return found


def keep_memory() -> None:
    """Keep freed memory in the process, as torch's allocator of device memory does, if this is glibc."""
    if hasattr(ctypes.CDLL(None), "mallopt"):
        for option, value in ((M_TRIM_THRESHOLD, 2**31 - 1), (M_MMAP_MAX, 0)):
            ctypes.CDLL(None).mallopt(option, value)


class StubLauncher:
    """Launches kernels with the driver of this script; any tree accepts it as a launcher."""

    def __init__(self, stub: ctypes.CDLL) -> None:
        from cadam3d.rasterizer.driver import Module

        self.module = Module(stub, 0, b"")

    def on(self, _) -> AbstractContextManager:
        """Return a context with the function that launches kernels."""
        return self.module.launching(0)


def make_step(render: Callable, launcher, args: argparse.Namespace) -> tuple[Callable, Callable]:
    import torch

    from cadam3d.core.cameras import orbit
    from cadam3d.core.gaussians import Gaussians

    def leaf(*size: int) -> torch.Tensor:
        return torch.zeros(args.count, *size, requires_grad=True)

    gaussians = Gaussians(leaf(3), leaf(3), leaf(4), leaf(), leaf(1, 3))
    angles = torch.zeros(args.views)
    cameras = orbit(angles, angles, angles + 2, angles + 50, args.size, args.size)
    background, size = torch.zeros(args.views, 3), (args.views, args.size, args.size)
    grads = (torch.zeros(*size, 3), torch.zeros(size), torch.zeros(size))
    leaves, engine = list(gaussians.tensors().values()), torch.autograd.Variable._execution_engine

    def forward():
        return render(launcher, gaussians, cameras, background)

    def backward(output) -> None:
        for tensor in leaves:
            tensor.grad = None
        # Without the checks of torch.autograd.backward, which take longer than some of our kernels.
        engine.run_backward((output.rgb, output.alpha, output.depth), grads, False, False, (), True, True)

    return forward, backward


def time_step(forward: Callable, backward: Callable, stub: ctypes.CDLL, steps: int) -> dict[str, float]:
    """Return medians in microseconds, without the time in which the driver makes up numbers."""
    times, made_up = {"forward": [], "backward": []}, ctypes.c_uint64.in_dll(stub, "stub_nanoseconds")

    def now() -> int:
        return time.process_time_ns() - made_up.value

    for _ in range(steps):
        begin = now()
        output = forward()
        middle = now()
        backward(output)
        end = now()
        times["forward"].append(middle - begin)
        times["backward"].append(end - middle)
    found = {f"{name}_us": statistics.median(values) / 1e3 for name, values in times.items()}
    return found | {"sum_us": sum(found.values())}


def count_step(forward: Callable, backward: Callable, stub: ctypes.CDLL) -> dict[str, float]:
    """Return the numbers of launches and of torch operations of one pass."""
    from torch.utils._python_dispatch import TorchDispatchMode

    calls: list[str] = []

    class Count(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            # Views count too: they take no time on a device, but they do on the host.
            calls.append(func.__name__)
            return func(*args, **(kwargs or {}))

    launches = ctypes.c_uint64.in_dll(stub, "stub_launches")
    before = launches.value
    with Count():
        backward(forward())
    return {"launches": launches.value - before, "operations": len(calls)}


if __name__ == "__main__":
    main()
