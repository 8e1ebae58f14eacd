"""Split whole training steps into their parts, here and in another checkout, and count what a step costs.

    python scripts/bench_step.py                                  # the demo on the CPU, and a learned prior
    python scripts/bench_step.py --device cuda --json step.json   # also networks of full size, random weights
    python scripts/bench_step.py --priors exact --base ../cadam3d-before
    python scripts/bench_step.py --priors exact densifier=baseline initializer.count=50000

A step is that of ``cadam3d train`` with the settings on the line, callbacks included. The command itself
runs, but its training loop is replaced by three passes, which continue one another:

1. The step as a whole, untouched. CPU time is that of the process, on all threads.
2. Its parts, with a clock around each component. On CUDA the clock waits for the device before and after each
   part, which hides all overlap, so that the parts add up to more than the whole. A part that another one
   calls, such as the prior inside the guidance, is subtracted from it. "condition" is what the prior does
   once per step for the views, such as tracing rays; "rest" is Python between the parts.
3. Operations that torch dispatches, by part, over three steps. Those that only change shapes do not count. A
   readback is a number, or a number of rows, that Python needs from a tensor: on CUDA it waits for the
   device. On a CPU, tensors that never leave the host count too.

Bytes per Gaussian are counted from the tensors. The networks of ``--priors random`` have the sizes of Stable
Diffusion 2.1 (``scripts/bench_recipes.py``); ``--tiny`` replaces them by small ones.

Every prior has a process of its own. With ``--base`` both trees run in turn.
"""

import argparse
import copy
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
PROMPT = "a red and yellow checkered torus"
PRIORS = {
    "exact": ["prior=shapes"],
    "learned": ["prior=shapes_sd"],
    "random": ["experiment=luciddreamer", "initializer=ball"],
}
# Methods of components by part. A part also contains what its methods call, except other parts.
METHODS = {
    "camera": ("camera", ["sample"]),
    "background": ("background", ["sample"]),
    "augmentation": ("augmentation", ["perturb", "show"]),
    "rasterizer": ("render", ["render", "render_ahead"]),
    "prior": ("prior", ["encode", "decode", "predict"]),
    "guidance": ("guidance", ["__call__"]),
    "densifier": ("observe", ["observe", "perturb"]),
    "exposure": ("exposure", ["dimming"]),
}
ORDER = (
    *("camera", "background", "augmentation", "render", "condition", "prior", "guidance", "regularizers"),
    *("backward", "observe", "readback", "optimizer", "exposure", "refinement", "callbacks", "rest"),
)
COUNTED_STEPS = 3
MOST_STEPS = 1_000_000  # until the first refinement


def main(words: list[str] | None = None) -> None:
    args = read_arguments(words)
    if args.tree is not None:
        args.out.write_text(json.dumps(measure_here(args.priors[0], args)))
        return
    trees = {"base": args.base, "here": HERE} if args.base else {"here": HERE}
    results: dict[str, list[Any]] = {name: [] for name in trees}
    for prior in args.priors:
        turns: dict[str, list[Any]] = {name: [] for name in trees}
        try:
            for _ in range(args.repeats if args.base else 1):
                for name, tree in trees.items():
                    turns[name].append(measure_there(tree, prior, args))
        except LeftOutError as error:
            print(f"{prior} is left out: {error}")
            continue
        for name, found in turns.items():
            results[name].append(middle(found))
        print(as_table({name: found[-1] for name, found in results.items()}), flush=True)
    if args.json:
        args.json.write_text(json.dumps({"machine": machine(args.device), **results}, indent=2) + "\n")
    if not results["here"]:
        raise SystemExit(1)


def read_arguments(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--priors", nargs="+", choices=list(PRIORS), help="default: all, random on CUDA only")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or auto")
    parser.add_argument("--steps", type=positive, default=40, help="steps of each of the first two passes")
    parser.add_argument("--warmup", type=positive, default=5, help="steps before them that are not timed")
    parser.add_argument("--threads", type=positive, default=1, help="threads of torch (default: 1)")
    parser.add_argument("--tiny", action="store_true", help="small networks for --priors random")
    parser.add_argument("--models", type=Path, help="folder that keeps the random networks")
    parser.add_argument("--base", type=lambda text: Path(text).resolve(), help="a checkout to compare with")
    parser.add_argument(
        "--repeats", type=positive, default=3, help="turns of each tree with --base (default: 3)"
    )
    # For the processes that measure one prior of one tree.
    parser.add_argument("--tree", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help="file for all numbers")
    parser.add_argument("settings", nargs="*", help="more settings of cadam3d train, such as steps=1000")
    # Settings come first, because the list of priors would swallow those after it.
    words = sorted(sys.argv[1:] if words is None else words, key=lambda word: not is_setting(word))
    args = parser.parse_intermixed_args(words)
    if args.base and not (args.base / "cadam3d").is_dir():
        # An installed cadam3d would be measured instead.
        parser.error(f"argument --base: expected a checkout of cadam3d, got {args.base}")
    if args.json and not args.json.absolute().parent.is_dir():
        parser.error(f"argument --json: expected a file in a folder that exists, got {args.json}")
    if args.priors is None:
        args.priors = [name for name in PRIORS if name != "random" or args.device.startswith("cuda")]
    return args


def is_setting(word: str) -> bool:
    return "=" in word and not word.startswith("-")


def positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text}")
    return int(text)


# -------------------------------------------------------------------------- processes


def measure_there(tree: Path, prior: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the result of one prior in ``tree``, measured in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        line = [sys.executable, __file__, "--tree", str(tree), "--out", str(out), "--priors", prior]
        for name in ("device", "steps", "warmup", "threads", "models"):
            value = getattr(args, name)
            line += [] if value is None else [f"--{name}", str(value)]
        line += [*(["--tiny"] if args.tiny else []), *args.settings]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines()
            raise LeftOutError(lines[-1] if lines else f"the process ended with code {done.returncode}")
        return json.loads(out.read_text())


def middle(turns: list[Any]) -> Any:
    """Return nested results with the median of every number; all else is that of the first turn."""
    first = turns[0]
    if isinstance(first, dict):
        return {key: middle([turn.get(key) for turn in turns]) for key in first}
    if all(turn == first for turn in turns):
        return first
    numbers = [turn for turn in turns if isinstance(turn, int | float)]
    return statistics.median(numbers) if len(numbers) == len(turns) else first


# -------------------------------------------------------------------------- one prior of one tree


class LeftOutError(Exception):
    """A prior cannot be measured here, because a package or something else is missing; the text says what."""


class Watch:
    """Adds up seconds by part; a part inside another one is subtracted from it."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.is_on = False
        self.seconds = defaultdict[str, float](float)
        self.calls = defaultdict[str, int](int)
        # The parts that are running, and the seconds of parts inside them.
        self.running: list[str] = []
        self.inside: list[float] = [0.0]

    def __call__(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            self.calls[part] += 1
            self.running.append(part)
            self.inside.append(0.0)
            started = self.now()
            try:
                return work(*args, **kwargs)
            finally:
                taken = self.now() - started
                self.seconds[part] += taken - self.inside.pop()
                self.inside[-1] += taken
                self.running.pop()

        return timed

    def now(self) -> float:
        """Return the CPU time of this process, or on CUDA the wall clock once the device is idle."""
        if not self.is_on:
            return 0.0
        if self.device.type == "cuda":
            import torch

            torch.cuda.synchronize(self.device)
            return time.perf_counter()
        return time.process_time()


def timed(component: Any, methods: list[str], part: str, watch: Watch) -> Any:
    """Return a copy of a component with a clock around some of its methods."""
    kind = type(component)
    around = {name: watch(part, getattr(kind, name)) for name in methods if hasattr(kind, name)}
    copied = copy.copy(component)
    object.__setattr__(copied, "__class__", type(kind.__name__, (kind,), around))
    return copied


def measure_here(prior: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run ``cadam3d train`` in this process up to its training loop, and return what the passes find."""
    sys.path.insert(0, str(args.tree))
    os.environ["TQDM_DISABLE"] = "1"
    import torch

    from cadam3d import cli, trainer
    from cadam3d.commands import train

    torch.set_num_threads(args.threads)
    build, loop = train.build_trainer, trainer.Trainer.train
    found: dict[str, Any] = {}

    def build_trainer(*arguments: Any) -> Any:
        built = build(*arguments)
        if prior == "random":
            import_module("bench_recipes").random_texts(built.prior)
        return built

    def instead(measured: Any, state: Any, embedding: Any, context: Any, *_: Any) -> None:
        found.update(three_passes(Run(measured, state, embedding, context, loop), args))
        raise SystemExit(0)

    with tempfile.TemporaryDirectory() as folder, replaced([(train, "build_trainer", build_trainer)]):
        words = [f"prompt={PROMPT}", *PRIORS[prior], *random_settings(prior, args, Path(folder))]
        words += [f"device={args.device}", *args.settings]
        line = ["cadam3d", "train", f"hydra.run.dir={folder}/run", *words]
        with replaced([(trainer.Trainer, "train", instead), (sys, "argv", line)]):
            try:
                cli.main()
            except SystemExit as ended:
                if not found:
                    raise SystemExit(ended.code or 1) from None
    return {"prior": prior, "settings": words, **found}


@dataclass(frozen=True)
class Run:
    """The arguments of the training loop that the command was about to start, and the loop."""

    trainer: Any
    state: Any
    embedding: Any
    context: Any
    loop: Callable[..., Any]

    def steps(self, count: int, after: Callable[[int], None]) -> None:
        """Do ``count`` steps with their callbacks, and call ``after`` with the number of each."""
        done = iter(range(1, count + 1))

        def stop() -> bool:
            number = next(done)
            after(number)
            return number == count

        endless = replace(self.trainer, steps=self.state.step + count + 1)
        self.loop(endless, self.state, self.embedding, self.context, stop)


def three_passes(run: Run, args: argparse.Namespace) -> dict[str, Any]:
    device = run.state.gaussians.device
    watch = Watch(device)
    whole = time_whole(run, args, device)
    embedding = timed(run.embedding, ["at"], "condition", watch)
    parts = replace(run, trainer=split(run.trainer, watch), embedding=embedding)
    with replaced(clocks_around_functions(watch)):
        return {
            "backend": run.trainer.rasterizer.prepare(device).name,
            "views": run.trainer.views,
            "size": str(getattr(run.trainer.camera, "size", "?")),
            **whole,
            **time_parts(parts, args, watch),
            **count_operations(parts, watch),
        }


def random_settings(prior: str, args: argparse.Namespace, folder: Path) -> list[str]:
    """Return the settings for networks with random weights, which are written first if that is needed."""
    if prior != "random":
        return []
    sys.path.insert(1, str(HERE / "scripts"))
    bench_recipes = import_module("bench_recipes")
    model = (args.models or folder) / "stable_diffusion"
    if not (model / "model_index.json").is_file():
        bench_recipes.stable_diffusion(model, args.tiny, weights=True)
    return [f"prior.path={model}", f"prior.cache_dir={model / 'texts'}"]


def split(trainer: Any, watch: Watch) -> Any:
    """Return the trainer with a clock around each component."""
    parts = {
        name: timed(getattr(trainer, name), methods, part, watch) for name, (part, methods) in METHODS.items()
    }
    regularizers = {
        name: timed(penalty, ["__call__"], "regularizers", watch)
        for name, penalty in trainer.regularizers.items()
    }
    return replace(trainer, regularizers=regularizers, **parts)


def clocks_around_functions(watch: Watch) -> list[tuple[Any, str, Any]]:
    """Return the functions of a step that belong to no component, with clocks around them."""
    import torch

    from cadam3d import trainer
    from cadam3d.optimizer import GaussianOptimizer

    owners = {
        torch.Tensor: {"backward": "backward"},
        GaussianOptimizer: {
            "step": "optimizer",
            "finite_gradients": "optimizer",
            "extreme_gradients": "optimizer",
            "displace": "optimizer",
        },
        trainer.Trainer: {"_refine": "refinement", "_report": "callbacks", "_tell": "callbacks"},
        trainer: {"read_numbers": "readback"},
    }
    return [
        (owner, name, watch(part, vars(owner)[name]))
        for owner, functions in owners.items()
        for name, part in functions.items()
        if name in vars(owner)
    ]


@contextmanager
def replaced(changes: list[tuple[Any, str, Any]]) -> Iterator[None]:
    """Set attributes, given as owner, name and value, and restore them afterwards."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in changes]
    for owner, name, value in changes:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)


def time_whole(run: Run, args: argparse.Namespace, device: Any) -> dict[str, Any]:
    """Return the milliseconds of untouched steps, and the peak of the memory in bytes on CUDA."""
    import torch

    marks = []

    def after(number: int) -> None:
        is_end = number in (args.warmup, args.warmup + args.steps)
        if is_end and device.type == "cuda":
            # What the device still does belongs to the steps before this line.
            torch.cuda.synchronize(device)
            if number == args.warmup:
                torch.cuda.reset_peak_memory_stats(device)
        if number >= args.warmup:
            marks.append((time.perf_counter(), time.process_time()))

    run.steps(args.warmup + args.steps, after)
    clocks = zip(*marks, strict=True)
    walls, cpus = ([later - earlier for earlier, later in pairwise(clock)] for clock in clocks)
    return {
        # On CUDA the host may be ahead of the device in one step and wait for it in the next.
        "wall_ms": 1e3 * (statistics.fmean(walls) if device.type == "cuda" else statistics.median(walls)),
        "cpu_ms": 1e3 * statistics.median(cpus),
        "peak_bytes": torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None,
    }


def time_parts(run: Run, args: argparse.Namespace, watch: Watch) -> dict[str, Any]:
    """Return the median milliseconds of each part, of a refinement, and the bytes per Gaussian."""
    rows: list[dict[str, float]] = []
    totals: list[float] = []
    watch.is_on = True

    def after(number: int) -> None:
        totals.append(watch.now())
        rows.append(dict(watch.seconds))
        watch.seconds.clear()

    # The first row also has the start of the pass.
    run.steps(args.steps + 1, after)
    for row, (earlier, later) in zip(rows[1:], pairwise(totals), strict=True):
        row["rest"] = later - earlier - sum(row.values())
    names = [name for name in ORDER if any(name in row for row in rows)]
    parts = {name: 1e3 * statistics.median(row.get(name, 0.0) for row in rows[1:]) for name in names}
    gradients = gradient_bytes(run)
    state, trainer = run.state, run.trainer
    started = watch.now()
    trainer._refine(state, next(filter(trainer.refine.refines_at, range(1, MOST_STEPS)), state.step))
    refinement = watch.now() - started
    watch.is_on = False
    n = len(state.gaussians)
    moments = [part for part in state.optimizer.state_dict().values() if isinstance(part, dict)]
    held = {
        "parameters": sum(tensor.nbytes for tensor in state.gaussians.tensors().values()) / n,
        "gradients": gradients,
        "moments": sum(tensor.nbytes for part in moments for tensor in part.values()) / n,
        "densifier": sum(rows.nbytes for rows in state.densifier.to_dict().values()) / n,
    }
    return {
        "parts_ms": parts,
        "gaussians": n,
        "refinement_ms": 1e3 * refinement,
        "bytes_per_gaussian": held,
    }


def gradient_bytes(run: Run) -> float:
    """Return the bytes per Gaussian of the gradients that the optimizer finds in one step."""
    from cadam3d.optimizer import GaussianOptimizer

    found = []
    step = GaussianOptimizer.step

    def observed(owner: Any, *args: Any) -> Any:
        gaussians = owner.gaussians
        grads = [tensor.grad for tensor in gaussians.tensors().values()]
        found.append(sum(grad.nbytes for grad in grads if grad is not None) / len(gaussians))
        return step(owner, *args)

    with replaced([(GaussianOptimizer, "step", observed)]):
        run.steps(1, lambda _: None)
    return found[-1]


def count_operations(run: Run, watch: Watch) -> dict[str, Any]:
    """Return how many operations and readbacks each part of a step dispatches, on average."""
    counter = operation_counter(watch)
    found = {}

    def after(number: int) -> None:
        # The first step also has the start of the pass, and the end of the pass follows the last one.
        counter.is_on = number <= COUNTED_STEPS
        if number == 1:
            watch.calls.clear()
        if counter.is_on:
            return
        if watch.calls["readback"]:
            # On a CPU, reading numbers together is no operation.
            counter.readbacks["readback"] = watch.calls["readback"]
        for kind in ("operations", "readbacks"):
            counts = vars(counter)[kind]
            found[kind] = {name: count / COUNTED_STEPS for name, count in counts.items()}

    with counter:
        run.steps(COUNTED_STEPS + 1, after)
    return found


def operation_counter(watch: Watch) -> Any:
    """Return a context that counts operations and readbacks by the part that runs."""
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode

    aten = torch.ops.aten
    shaping = {aten.detach, aten.alias, aten.empty, aten.empty_strided, aten.empty_like, aten._unsafe_view}
    reading = {aten._local_scalar_dense, aten.nonzero, aten.masked_select, aten.equal, aten.is_nonzero}

    def is_readback(func: Any, args: Any, kwargs: dict[str, Any]) -> bool:
        packet = func.overloadpacket
        if packet is aten._to_copy and args[0].is_cuda:
            return kwargs.get("device") is not None and torch.device(kwargs["device"]).type == "cpu"
        indices = args[1] if packet in (aten.index, aten.index_put) else ()
        has_mask = any(each is not None and each.dtype is torch.bool for each in indices)
        return has_mask or packet in reading

    class Counter(TorchDispatchMode):
        def __init__(self) -> None:
            super().__init__()
            self.is_on = False
            self.operations = defaultdict[str, int](int)
            self.readbacks = defaultdict[str, int](int)

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            part = watch.running[-1] if watch.running else "rest"
            if not self.is_on:
                pass
            elif is_readback(func, args, kwargs or {}):
                self.readbacks[part] += 1
            elif not (func.is_view or func.overloadpacket in shaping):
                self.operations[part] += 1
            return func(*args, **(kwargs or {}))

    return Counter()


# -------------------------------------------------------------------------- output


def as_table(found: dict[str, Any]) -> str:
    here = found["here"]
    trees = list(found)
    head = (
        f"{here['prior']} prior, {here['gaussians']:,.0f} Gaussians, {here['views']} views of "
        f"{here['size']} px, {here['backend']}"
    )
    columns = "".join(f"{tree + ' ms':>12}{'share':>8}{'ops':>8}{'reads':>7}" for tree in trees)
    lines = [head, f"{'part':<14}{columns}"]
    names = [name for name in ORDER if any(name in each["parts_ms"] for each in found.values())]
    for name in names:
        lines.append(f"{name:<14}" + "".join(as_cells(each, name) for each in found.values()))
    sums = "".join(
        f"{sum(each['parts_ms'].values()):>12.2f}{'':>8}{sum(each['operations'].values()):>8.0f}"
        f"{sum(each['readbacks'].values()):>7.1f}"
        for each in found.values()
    )
    lines.append(f"{'all parts':<14}{sums}")
    for label, key in (("whole, wall", "wall_ms"), ("whole, CPU", "cpu_ms"), ("refinement", "refinement_ms")):
        values = [each[key] for each in found.values()]
        lines.append(f"{label:<14}" + "".join("" if v is None else f"{v:>12.2f}{'':>23}" for v in values))
    for name in here["bytes_per_gaussian"]:
        sizes = "".join(f"{each['bytes_per_gaussian'][name]:>12.0f}{'':>23}" for each in found.values())
        lines.append(f"{name:<14}{sizes}".rstrip() + "  bytes per Gaussian")
    if here["peak_bytes"] is not None:
        lines.append(f"peak memory   {here['peak_bytes'] / 2**20:>12.0f} MiB")
    if "base" in found:
        ratios = [here[key] / found["base"][key] for key in ("wall_ms", "cpu_ms")]
        lines.append(f"here / base, whole step: wall {ratios[0]:.3f}, CPU {ratios[1]:.3f}")
    return "\n".join(lines)


def as_cells(found: dict[str, Any], name: str) -> str:
    milliseconds = found["parts_ms"].get(name, 0.0)
    share = 100 * milliseconds / sum(found["parts_ms"].values())
    operations, readbacks = found["operations"].get(name, 0), found["readbacks"].get(name, 0)
    return f"{milliseconds:>12.3f}{share:>6.1f} %{operations:>8.0f}{readbacks:>7.1f}"


def machine(device: str) -> dict[str, Any]:
    """Return the device, the versions and the commit of the measurement."""
    import torch

    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=HERE, capture_output=True, text=True, check=False)
    is_cuda = device != "cpu" and torch.cuda.is_available()
    return {
        "device": torch.cuda.get_device_name() if is_cuda else platform.processor() or platform.machine(),
        "torch": torch.__version__,
        "commit": head.stdout.strip(),
    }


if __name__ == "__main__":
    main()
