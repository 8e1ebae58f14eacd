"""Split whole training steps into their parts, here and in another checkout, and count what a step costs.

    python scripts/bench_step.py                                  # the demo on the CPU, and a learned prior
    python scripts/bench_step.py --device cuda --json step.json   # also networks of full size, random weights
    python scripts/bench_step.py --priors exact --base ../cadam3d-before
    python scripts/bench_step.py --priors exact densifier=baseline initializer.count=50000

A step is that of ``cadam3d train`` with the settings on the line, callbacks included. There are three passes:

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

With ``--base`` both trees run in turn, each in processes of its own.
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
from dataclasses import replace
from functools import partial
from importlib import import_module
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


def main(words: list[str] | None = None) -> None:
    args = read_arguments(words)
    if args.base is None and args.tree is None:
        results = {"here": [measure_here(prior, args) for prior in args.priors]}
    elif args.tree is not None:
        print(json.dumps([measure_here(prior, args) for prior in args.priors]))
        return
    else:
        results = measure_in_turn(args)
    results = {tree: [found for found in each if found is not None] for tree, each in results.items()}
    print("\n\n".join(as_text(results)))
    if args.json:
        args.json.write_text(json.dumps({"machine": machine(args.device), **results}, indent=2) + "\n")


def read_arguments(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--priors", nargs="+", choices=list(PRIORS), help="default: all, random on CUDA only")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or auto")
    parser.add_argument("--steps", type=int, default=40, help="steps of each of the first two passes")
    parser.add_argument("--warmup", type=int, default=5, help="steps before them that are not timed")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default: 1)")
    parser.add_argument("--tiny", action="store_true", help="small networks for --priors random")
    parser.add_argument("--models", type=Path, help="folder that keeps the random networks")
    parser.add_argument("--base", type=lambda text: Path(text).resolve(), help="a checkout to compare with")
    parser.add_argument("--repeats", type=int, default=3, help="turns of each tree with --base (default: 3)")
    parser.add_argument("--tree", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help="file for all numbers")
    parser.add_argument("settings", nargs="*", help="more settings of cadam3d train, such as steps=1000")
    args = parser.parse_intermixed_args(words)
    if args.priors is None:
        args.priors = [name for name in PRIORS if name != "random" or args.device != "cpu"]
    return args


# -------------------------------------------------------------------------- several trees


def measure_in_turn(args: argparse.Namespace) -> dict[str, list[Any]]:
    """Measure both trees in turn, and return the medians of their turns."""
    trees = {"base": args.base, "here": HERE}
    turns: dict[str, list[list[Any]]] = {name: [] for name in trees}
    for _ in range(args.repeats):
        for name, tree in trees.items():
            turns[name].append(measure_there(tree, args))
    return {name: [middle(list(each)) for each in zip(*found, strict=True)] for name, found in turns.items()}


def measure_there(tree: Path, args: argparse.Namespace) -> list[Any]:
    """Return the results of ``tree``, measured in a process of its own."""
    line = [sys.executable, __file__, "--tree", str(tree), "--priors", *args.priors]
    for name in ("device", "steps", "warmup", "threads", "models"):
        value = getattr(args, name)
        line += [] if value is None else [f"--{name}", str(value)]
    line += [*(["--tiny"] if args.tiny else []), *(["--", *args.settings] if args.settings else [])]
    done = subprocess.run(line, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{tree}: exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def middle(turns: list[Any]) -> Any:
    """Return nested results with the median of every number; all else is that of the first turn."""
    first = turns[0]
    if isinstance(first, dict):
        return {key: middle([turn.get(key) for turn in turns]) for key in first}
    numbers = [turn for turn in turns if isinstance(turn, int | float)]
    return statistics.median(numbers) if len(numbers) == len(turns) else first


# -------------------------------------------------------------------------- one tree


class Watch:
    """Adds up seconds by part; a part inside another one is subtracted from it."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.is_on = False
        self.seconds = defaultdict[str, float](float)
        # The parts that are running, and the seconds of parts inside them.
        self.running: list[str] = []
        self.inside: list[float] = [0.0]

    def __call__(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
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


def measure_here(prior: str, args: argparse.Namespace) -> dict[str, Any] | None:
    """Measure the steps of one prior; ``None`` if something that it needs is not installed."""
    sys.path.insert(0, str(args.tree or HERE))
    os.environ["TQDM_DISABLE"] = "1"
    import torch

    from cadam3d.core.errors import UserError

    torch.set_num_threads(args.threads)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return measure(prior, args, Path(folder))
    except (UserError, ImportError) as error:
        print(f"{prior} is left out: {error}", file=sys.stderr)
        return None


def measure(prior: str, args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    import torch

    from cadam3d.commands import train
    from cadam3d.core.device import resolve_device
    from cadam3d.settings.compose import component, compose

    device = resolve_device(args.device)
    lines = [f"prompt={PROMPT}", *PRIORS[prior], *random_settings(prior, args, folder), *args.settings]
    cfg = compose(lines)
    trainer = train.build_trainer(cfg, device)
    if prior == "random":
        import_module("bench_recipes").random_texts(trainer.prior)
    backend = trainer.rasterizer.prepare(device)
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    trainer.prior.load()

    torch.set_deterministic_debug_mode("error" if device.type == "cpu" else "default")
    watch = Watch(device)
    parts = split(trainer, watch)

    def passes(measured: Any, shown: Any, work: Callable[..., Any]) -> Any:
        state = measured.start(cfg.prompt, component(cfg.initializer), cfg.seed, device)
        place = folder / str(len(list(folder.iterdir())))
        place.mkdir()
        context = train.run_context(cfg.prompt, measured, state, place)
        for callback in measured.callbacks:
            callback.on_start(context, state)

        def one() -> None:
            report, refined = measured.step(state, shown)
            watch("callbacks", measured._report)(context, state, refined, report)

        for _ in range(args.warmup):
            one()
        return work(measured, state, one)

    whole = passes(trainer, embedding, partial(time_whole, steps=args.steps, device=device))
    split_embedding = timed(embedding, ["at"], "condition", watch)
    with clocks_around_functions(watch):
        shares = passes(parts, split_embedding, partial(time_parts, args=args, watch=watch))
        counts = passes(parts, split_embedding, partial(count_operations, watch=watch))
    return {
        "prior": prior,
        "settings": lines,
        "backend": backend.name,
        "views": trainer.views,
        "size": cfg.camera.get("size"),
        **whole,
        **shares,
        **counts,
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


@contextmanager
def clocks_around_functions(watch: Watch) -> Iterator[None]:
    """Put clocks around the functions of a step that belong to no component, and remove them afterwards."""
    import torch

    from cadam3d import trainer
    from cadam3d.densifier.base import GradientSignal
    from cadam3d.optimizer import GaussianOptimizer

    owners = {
        torch.Tensor: {"backward": "backward"},
        GradientSignal: {"read": "observe"},
        GaussianOptimizer: {"step": "optimizer", "finite_gradients": "optimizer", "displace": "optimizer"},
        trainer.Trainer: {"_refine": "refinement"},
        trainer: {"read_numbers": "readback"},
    }
    replaced = []
    for owner, functions in owners.items():
        for name, part in functions.items():
            if name not in vars(owner):
                continue
            original = vars(owner)[name]
            replaced.append((owner, name, original))
            clocked = watch(part, getattr(original, "__func__", original))
            setattr(owner, name, classmethod(clocked) if isinstance(original, classmethod) else clocked)
    try:
        yield
    finally:
        for owner, name, original in replaced:
            setattr(owner, name, original)


def time_whole(
    trainer: Any, state: Any, one: Callable[[], None], *, steps: int, device: Any
) -> dict[str, Any]:
    """Return the milliseconds of untouched steps, and the peak of the memory in bytes on CUDA."""
    import torch

    is_cuda = device.type == "cuda"
    if is_cuda:
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
    walls, cpus = [], []
    for _ in range(steps):
        wall, cpu = time.perf_counter(), time.process_time()
        one()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    if is_cuda:
        # The last step is still running on the device.
        started = time.perf_counter()
        torch.cuda.synchronize(device)
        walls[-1] += time.perf_counter() - started
    return {
        "wall_ms": 1e3 * (statistics.fmean(walls) if is_cuda else statistics.median(walls)),
        "cpu_ms": 1e3 * statistics.median(cpus),
        "peak_bytes": torch.cuda.max_memory_allocated(device) if is_cuda else None,
    }


def time_parts(
    trainer: Any, state: Any, one: Callable[[], None], *, args: argparse.Namespace, watch: Watch
) -> dict[str, Any]:
    """Return the median milliseconds of each part, of a refinement, and the bytes per Gaussian."""
    rows = []
    for _ in range(args.steps):
        watch.seconds.clear()
        watch.is_on = True
        started = watch.now()
        one()
        total = watch.now() - started
        watch.is_on = False
        rows.append({**watch.seconds, "rest": total - sum(watch.seconds.values())})
    names = [name for name in ORDER if any(name in row for row in rows)]
    parts = {name: 1e3 * statistics.median(row.get(name, 0.0) for row in rows) for name in names}
    memory = count_bytes(trainer, state, one)
    watch.is_on = True
    started = watch.now()
    refined = trainer._refine(state, next(iter(trainer.refine.refinements), state.step))
    refinement = watch.now() - started
    watch.is_on = False
    return {
        "parts_ms": parts,
        "gaussians": memory.pop("gaussians"),
        "refinement_ms": None if refined is None else 1e3 * refinement,
        "bytes_per_gaussian": memory,
    }


def count_bytes(trainer: Any, state: Any, one: Callable[[], None]) -> dict[str, Any]:
    """Return the bytes per Gaussian of everything that has a row for each, from the tensors of one step."""
    from cadam3d.optimizer import GaussianOptimizer

    gradients = []
    step = GaussianOptimizer.step

    def observed(owner: Any, *args: Any) -> Any:
        grads = [tensor.grad for tensor in owner.gaussians.tensors().values()]
        gradients.append(sum(grad.nbytes for grad in grads if grad is not None))
        return step(owner, *args)

    GaussianOptimizer.step = observed
    try:
        one()
    finally:
        GaussianOptimizer.step = step
    n = len(state.gaussians)
    moments = [part for part in state.optimizer.state_dict().values() if isinstance(part, dict)]
    held = {
        "parameters": sum(tensor.nbytes for tensor in state.gaussians.tensors().values()),
        "gradients": gradients[-1],
        "moments": sum(tensor.nbytes for part in moments for tensor in part.values()),
        "densifier": sum(rows.nbytes for rows in state.densifier.to_dict().values()),
    }
    return {"gaussians": n, **{name: size / n for name, size in held.items()}}


def count_operations(trainer: Any, state: Any, one: Callable[[], None], *, watch: Watch) -> dict[str, Any]:
    """Return how many operations and readbacks each part of a step dispatches, on average."""
    counter = operation_counter(watch)
    with counter:
        for _ in range(COUNTED_STEPS):
            one()
    return {
        "operations": {name: count / COUNTED_STEPS for name, count in counter.operations.items()},
        "readbacks": {name: count / COUNTED_STEPS for name, count in counter.readbacks.items()},
    }


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
            self.operations = defaultdict[str, int](int)
            self.readbacks = defaultdict[str, int](int)

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            part = watch.running[-1] if watch.running else "rest"
            if is_readback(func, args, kwargs or {}):
                self.readbacks[part] += 1
            elif not (func.is_view or func.overloadpacket in shaping):
                self.operations[part] += 1
            return func(*args, **(kwargs or {}))

    return Counter()


# -------------------------------------------------------------------------- output


def as_text(results: dict[str, list[Any]]) -> list[str]:
    """Return one table per prior."""
    rows = range(len(results["here"]))
    return [as_table({tree: found[row] for tree, found in results.items()}) for row in rows]


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
