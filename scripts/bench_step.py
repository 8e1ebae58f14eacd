"""Split whole training steps into their parts, here and in another checkout, and count what a step costs.

    python scripts/bench_step.py                                  # the demo on the CPU, and a learned prior
    python scripts/bench_step.py --device cuda --json step.json   # also networks of full size, random weights
    python scripts/bench_step.py --priors exact --base ../cadam3d-before
    python scripts/bench_step.py --priors exact densifier=baseline initializer.count=50000
    python scripts/bench_step.py --priors mesh prior.path=chair.glb

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

The networks of ``--priors random`` have the sizes of Stable
Diffusion 2.1 (``scripts/bench_recipes.py``); ``--tiny`` replaces them by small ones. On a CPU, add smaller
images too (``--priors random --tiny camera.size=64 prior.size=64``): at 512 pixels, a step takes minutes.

Every prior has a process of its own. With ``--base`` both trees run in turn.
"""

import argparse
import json
import os
import sys
import tempfile
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import measuring
from step_bench.clocks import ORDER, replaced
from step_bench.passes import Run, three_passes

PROMPT = "a red and yellow checkered torus"
PRIORS = {
    "exact": ["prior=shapes"],
    "learned": ["prior=shapes_sd"],
    "mesh": ["prior=mesh"],
    "random": ["experiment=luciddreamer", "initializer=ball"],
}


def main(words: list[str] | None = None) -> None:
    args = read_arguments(words)
    if args.out is not None:
        args.out.write_text(json.dumps(measure_here(args.priors[0], args)))
        return
    trees = measuring.find_trees(args.base)
    results: dict[str, list[Any]] = {name: [] for name in trees}
    for prior in args.priors:
        works = {name: partial(measure_there, tree, prior, args) for name, tree in trees.items()}
        turns = measuring.in_turns(works, args.repeats if args.base else 1)
        found = {name: measuring.median(each) for name, each in turns.items()}
        for name, each in found.items():
            results[name].append(each)
        print(as_table(found), flush=True)
    measuring.write(args.json, {"machine": measuring.machine(args.device), **results})


def read_arguments(words: list[str] | None) -> argparse.Namespace:
    parser = measuring.parser_of(__doc__)
    parser.add_argument(
        "--priors", nargs="+", choices=list(PRIORS), help="default: exact and learned, random on CUDA"
    )
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or auto")
    number: dict[str, Any] = {"type": measuring.positive}
    parser.add_argument("--steps", **number, default=40, help="steps of each of the first two passes")
    parser.add_argument("--warmup", **number, default=5, help="steps before them that are not timed")
    parser.add_argument("--threads", **number, default=1, help="threads of torch (default: 1)")
    parser.add_argument("--tiny", action="store_true", help="small networks for --priors random")
    parser.add_argument("--models", type=Path, help="folder that keeps the random networks")
    measuring.add_base(parser)
    parser.add_argument("--repeats", **number, default=3, help="turns of each tree with --base (default: 3)")
    # For the processes that measure one prior of one tree.
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=measuring.new_file, help="file for all numbers")
    parser.add_argument("settings", nargs="*", help="more settings of cadam3d train, such as steps=1000")
    # Settings come first, because the list of priors would swallow those after it.
    words = sorted(
        sys.argv[1:] if words is None else words, key=lambda word: "=" not in word or word.startswith("-")
    )
    args = parser.parse_intermixed_args(words)
    if args.priors is None:
        args.priors = ["exact", "learned", *(["random"] if args.device.startswith("cuda") else [])]
    return args


def measure_there(tree: Path, prior: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the result of one prior in ``tree``, measured in a process of its own."""
    words = ["--priors", prior, *(["--tiny"] if args.tiny else []), *args.settings]
    for name in ("device", "steps", "warmup", "threads", "models"):
        value = getattr(args, name)
        words += [] if value is None else [f"--{name}", str(value)]
    return measuring.in_checkout(__file__, tree, words)


def measure_here(prior: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run ``cadam3d train`` in this process up to its training loop, and return what the passes find."""
    os.environ["TQDM_DISABLE"] = "1"
    import torch

    from cadam3d import cli, trainer
    from cadam3d.commands import train

    torch.set_num_threads(args.threads)
    build, loop = train.build_trainer, trainer.Trainer.train
    found: dict[str, Any] = {}

    def build_trainer(*arguments: Any, **named: Any) -> Any:
        built = build(*arguments, **named)
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


def random_settings(prior: str, args: argparse.Namespace, folder: Path) -> list[str]:
    """Return the settings for networks with random weights, which are written first if that is needed."""
    if prior != "random":
        return []
    bench_recipes = import_module("bench_recipes")
    model = (args.models or folder) / "stable_diffusion"
    if not (model / "model_index.json").is_file():
        bench_recipes.stable_diffusion(model, args.tiny, weights=True)
    return [f"prior.path={model}", f"prior.cache_dir={model / 'texts'}"]


def as_table(found: dict[str, Any]) -> str:
    """Return a table of the parts of a step, and below it the numbers of the whole step."""
    here, rows = found["here"], []
    for name in ORDER:
        if any(name in each["parts_ms"] for each in found.values()):
            rows.append(
                {"part": name} | {k: v for tree, each in found.items() for k, v in cells(tree, each, name)}
            )
    lines = [
        f"{here['prior']} prior, {here['gaussians']:,.0f} Gaussians, "
        f"{here['views']} views of {here['size']} px, {here['backend']}",
        f"\n{measuring.table(rows)}\n",
    ]
    for tree, each in found.items():
        peak = f"; peak memory {each['peak_bytes'] / 2**20:.0f} MiB"
        lines.append(
            f"{tree}: whole step {each['wall_ms']:.2f} ms by the clock, {each['cpu_ms']:.2f} ms of CPU time; "
            f"refinement {each['refinement_ms']:.2f} ms{peak}"
        )
    if "base" in found:
        ratios = [here[key] / found["base"][key] for key in ("wall_ms", "cpu_ms")]
        lines.append(f"here / base, whole step: wall {ratios[0]:.3f}, CPU {ratios[1]:.3f}")
    return "\n".join(lines)


def cells(tree: str, found: dict[str, Any], name: str) -> list[tuple[str, str]]:
    """Return the columns of one part in one checkout."""
    milliseconds = found["parts_ms"].get(name, 0.0)
    share = milliseconds / sum(found["parts_ms"].values())
    counts = [found[kind].get(name, 0) for kind in ("operations", "readbacks")]
    values = (f"{milliseconds:.3f}", f"{share:.1%}", f"{counts[0]:.0f}", f"{counts[1]:.1f}")
    return list(
        zip((f"{tree} {title}" for title in ("ms", "share", "operations", "readbacks")), values, strict=True)
    )


if __name__ == "__main__":
    main()
