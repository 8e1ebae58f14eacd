"""Measure time and memory of whole recipes, on networks of the published sizes with random weights.

    python scripts/bench_recipes.py --device cuda --steps 50 --vram low --json recipes.json
    python scripts/bench_recipes.py --estimates     # print estimates of memory, without a GPU or weights

The resulting objects are meaningless, but a step costs as much as with real weights. Random weights are saved
like a real model, so that loading is timed too (Stable Diffusion 2.1: 1.9 GB, 3.5-medium: 4.7 GB in 16 bit).
``scripts/bench_step.py --priors random`` splits a step into its parts.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

# The script measures the package that it stands beside, from any folder.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import measuring

from cadam3d.build import build_trainer, component
from cadam3d.commands.beginning import run_context
from cadam3d.core.device import resolve_device
from cadam3d.prior.base import amount
from cadam3d.settings.compose import compose
from cadam3d.trainer import Trainer

RECIPES = {"luciddreamer": "stable_diffusion", "flowdreamer": "stable_diffusion_3"}
SD_VAE = {
    "block_out_channels": (128, 256, 512, 512),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 2,
}


def stable_diffusion(folder: Path, tiny: bool, weights: bool) -> None:
    """Save the UNet and the autoencoder of Stable Diffusion 2.1 with random weights."""
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel

    unet = {"block_out_channels": (320, 640, 1280, 1280), "attention_head_dim": (5, 10, 20, 20)}
    vae = dict(SD_VAE)
    if tiny:
        unet = {"block_out_channels": (32, 32, 32, 32), "attention_head_dim": 8}
        vae |= {"block_out_channels": (32, 32, 32, 32)}
    parts = {
        "unet": lambda: UNet2DConditionModel(
            sample_size=64, cross_attention_dim=1024, use_linear_projection=True, **unet
        ),
        "vae": lambda: AutoencoderKL(latent_channels=4, scaling_factor=0.18215, **vae),
    }
    scheduler = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", prediction_type="epsilon"
    )
    save(folder, "StableDiffusionPipeline", parts, scheduler, torch.float16 if weights else None)


def stable_diffusion_3(folder: Path, tiny: bool, weights: bool) -> None:
    """Save the transformer and the autoencoder of Stable Diffusion 3.5-medium with random weights."""
    from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, SD3Transformer2DModel

    layers, heads = (2, 2) if tiny else (24, 24)
    vae = dict(SD_VAE) | ({"block_out_channels": (32, 32, 32, 32)} if tiny else {})
    parts = {
        "transformer": lambda: SD3Transformer2DModel(
            sample_size=128,
            patch_size=2,
            in_channels=16,
            out_channels=16,
            num_layers=layers,
            num_attention_heads=heads,
            attention_head_dim=64,
            caption_projection_dim=64 * heads,
            joint_attention_dim=4096,
            pooled_projection_dim=2048,
            pos_embed_max_size=384,
            qk_norm="rms_norm",
            dual_attention_layers=tuple(range(min(13, layers))),
        ),
        "vae": lambda: AutoencoderKL(
            latent_channels=16,
            scaling_factor=1.5305,
            shift_factor=0.0609,
            use_quant_conv=False,
            use_post_quant_conv=False,
            **vae,
        ),
    }
    scheduler = FlowMatchEulerDiscreteScheduler(shift=3.0)
    save(folder, "StableDiffusion3Pipeline", parts, scheduler, torch.bfloat16 if weights else None)


def save(
    folder: Path, kind: str, parts: dict[str, Callable[[], Any]], scheduler: Any, dtype: torch.dtype | None
) -> None:
    """Write a model in the layout of diffusers, one part at a time; without a dtype, it has no weights."""
    index: dict[str, Any] = {"_class_name": kind, "scheduler": ["diffusers", type(scheduler).__name__]}
    torch.manual_seed(0)
    torch.set_default_dtype(dtype or torch.float32)
    try:
        for name, make in parts.items():
            with torch.device("cpu" if dtype else "meta"):
                part = make()
            (part.save_pretrained if dtype else part.save_config)(folder / name)
            index[name] = ["diffusers", type(part).__name__]
            del part
    finally:
        torch.set_default_dtype(torch.float32)
    scheduler.save_pretrained(folder / "scheduler")
    (folder / "model_index.json").write_text(json.dumps(index))


def random_texts(prior: Any) -> None:
    """Replace the text encoders by random embeddings; they run once per prompt and are not part of a step."""
    from cadam3d.prior.texts import T5_TOKENS, TOKENS, Texts

    def embed_texts(found: Any, texts: list[str], device: torch.device) -> Texts:
        config = found.config(prior.network_part)
        joint, pooled = config.get("joint_attention_dim"), config.get("pooled_projection_dim")
        generator = torch.Generator().manual_seed(0)

        def drawn(*shape: int) -> torch.Tensor:
            numbers = torch.randn(len(texts), *shape, generator=generator)
            return numbers.to(device, prior.torch_dtype)

        tokens = drawn(TOKENS + (T5_TOKENS if joint else 0), joint or config["cross_attention_dim"])
        return Texts(tokens, None if pooled is None else drawn(pooled))

    object.__setattr__(prior, "embed_texts", embed_texts)


def measure(recipe: str, model: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Train for some steps, and return the seconds per step and the peak memory in bytes."""
    device = resolve_device(args.device)
    lines = [f"experiment={recipe}", "prompt=a corgi", f"prior.path={model}", "initializer=ball"]
    lines += [f"initializer.count={args.count}", f"steps={args.steps}", f"prior.cache_dir={model / 'texts'}"]
    lines += ["callback=[]", *([f"vram={args.vram}"] if args.vram else []), *args.settings]
    cfg = compose(lines)
    trainer = build_trainer(cfg, device)
    random_texts(trainer.prior)
    backend = trainer.rasterizer.prepare(device)
    estimate = trainer.prior.memory(cfg.prompt, cfg.negative_prompt, trainer.views, None)
    started = time.perf_counter()
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    trainer.prior.load()
    loading = time.perf_counter() - started
    state = trainer.start(cfg.prompt, component(cfg.initializer), 0, device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with tempfile.TemporaryDirectory() as folder:
        context = run_context(cfg.prompt, trainer, state, Path(folder))
        warm: Trainer = replace(trainer, steps=args.warmup)
        warm.train(state, embedding, context)
        before = measuring.now(device)
        trainer.train(state, embedding, context)
        total = measuring.now(device) - before
    peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
    return {
        "recipe": recipe,
        "vram": args.vram,
        "backend": backend.name,
        "loading_seconds": loading,
        "seconds_per_step": total / (args.steps - args.warmup),
        "num_gaussians": len(state.gaussians),
        "estimate_bytes": estimate.total,
        "peak_bytes": peak,
    }


def estimate(recipe: str, model: Path) -> None:
    """Print the estimated memory of training for each choice of ``vram``, in 16 bit, with cached texts."""
    for vram in ("low", "medium", "full"):
        lines = [f"experiment={recipe}", "initializer=ball", "prompt=x", f"prior.path={model}"]
        lines += [f"vram={vram}"]
        prior = component(compose([*lines, "prior.dtype=float16"]).prior)
        object.__setattr__(prior, "_cache_file", lambda text: model / "model_index.json")
        needed = prior.memory("x", "", 4, None)
        print(
            f"{recipe:<14}{vram:<8}{amount(needed.weights):>10} weights, "
            f"{amount(needed.working):>10} working, {amount(needed.total):>10} in all"
        )


def main() -> None:
    parser = measuring.parser_of(__doc__)
    parser.add_argument("--recipes", nargs="+", default=list(RECIPES), choices=list(RECIPES))
    parser.add_argument("--device", default="auto")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--warmup", type=int, default=3, help="steps that are not timed")
    parser.add_argument("--count", type=int, default=81920, help="initial Gaussians")
    parser.add_argument("--vram", choices=("low", "medium", "full"))
    parser.add_argument("--tiny", action="store_true", help="small networks, to test the script itself")
    parser.add_argument("--estimates", action="store_true", help="only print estimates of memory")
    parser.add_argument("--models", type=Path, help="folder that keeps the models for the next run")
    parser.add_argument("--json", type=Path)
    parser.add_argument("settings", nargs="*", help="more settings of cadam3d train")
    args = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as temporary:
        for recipe in args.recipes:
            model = (args.models or Path(temporary)) / RECIPES[recipe]
            if not (model / "model_index.json").is_file():
                globals()[RECIPES[recipe]](model, args.tiny, weights=not args.estimates)
            if args.estimates:
                estimate(recipe, model)
                continue
            results.append(measure(recipe, model, args))
            print(json.dumps(results[-1], indent=2))
    if results:
        facts = measuring.machine(resolve_device(args.device))
        measuring.write(args.json, {"machine": facts, "results": results})


if __name__ == "__main__":
    main()
