"""The three passes over a training loop: whole steps, their parts, and the operations of each part."""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from measuring import peak_bytes
from step_bench.clocks import ORDER, Watch, clocks_around_functions, replaced, split, timed

COUNTED_STEPS = 3
MOST_STEPS = 1_000_000  # until the first refinement


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


def time_whole(run: Run, args: argparse.Namespace, device: Any) -> dict[str, Any]:
    """Return the milliseconds of untouched steps, and the peak of the memory in bytes."""
    import torch

    marks = []

    def after(number: int) -> None:
        is_end = number in (args.warmup, args.warmup + args.steps)
        if is_end and device.type == "cuda":
            # The work that the device has not finished belongs to the steps up to here.
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
        "peak_bytes": torch.cuda.max_memory_allocated(device) if device.type == "cuda" else peak_bytes(),
    }


def time_parts(run: Run, args: argparse.Namespace, watch: Watch) -> dict[str, Any]:
    """Return the median milliseconds of each part, and those of a refinement."""
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
    state, trainer = run.state, run.trainer
    started = watch.now()
    trainer._refine(state, next(filter(trainer.refine.refines_at, range(1, MOST_STEPS)), state.step))
    refinement = watch.now() - started
    watch.is_on = False
    return {"parts_ms": parts, "gaussians": len(state.gaussians), "refinement_ms": 1e3 * refinement}


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
