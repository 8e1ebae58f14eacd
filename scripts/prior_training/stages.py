"""The stages of training: each leaves files, so that an interrupted training continues where it was."""

import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKL
from prior_training import autoencoder, loop
from prior_training.denoiser import Denoising, Encoded
from prior_training.formats import Format
from prior_training.text import tokenizer
from prior_training.views import Groups, file_count, load_held_out, load_views, render_views
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.multiprocessing.spawn import spawn
from tqdm import tqdm

from cadam3d.build import component
from cadam3d.io.atomic import replacing
from cadam3d.prior.base import DiffusionPrior
from cadam3d.settings.compose import compose

AUTOENCODER_RATE = 1.5e-3
VIEWS_FILE = "views.json"
# Files whose latents give the shift and the factor.
MEASURED_FILES = 4


@dataclass(frozen=True)
class Plan:
    """Where and how a model is trained."""

    out: Path  # the folder of the pipeline
    views: Path
    groups: int  # of four views
    kind: Format
    seed: int
    processes: int
    device: str
    start: Path | None  # the output folder of a model to continue from

    @property
    def work(self) -> Path:
        """Return the folder of checkpoints, latents and curves."""
        return self.out / "training"

    def own_files(self, rank: int) -> range:
        """Return the numbers of the files of views that one process reads.

        Processes share files if there are fewer files than processes.
        """
        count = file_count(self.groups)
        return range(rank % count, count, self.processes)


@dataclass(frozen=True)
class Views:
    """The views that a model was trained on."""

    folder: Path
    groups: int
    size: int  # of images, in pixels per side


def render(plan: Plan, processes: int) -> None:
    """Render the views that are missing, and note which they are for a model that continues from this one."""
    render_views(plan.views, plan.groups, plan.kind.size, plan.seed, processes)
    plan.work.mkdir(parents=True, exist_ok=True)
    noted = {"folder": str(plan.views.resolve()), "groups": plan.groups, "size": plan.kind.size}
    (plan.work / VIEWS_FILE).write_text(json.dumps(noted) + "\n", encoding="utf-8")


def views_of(out: Path) -> Views:
    """Return the views on which the model in the folder ``out`` was trained."""
    noted = json.loads((out / "training" / VIEWS_FILE).read_text(encoding="utf-8"))
    return Views(Path(noted["folder"]), noted["groups"], noted["size"])


def needed_to_continue(out: Path) -> list[Path]:
    """Return the files that a model leaves for another one, which continues from it."""
    names = ("autoencoder.pt", "latents", VIEWS_FILE)
    return [*(out / "training" / name for name in names), weights_of(out)]


def train_autoencoder(plan: Plan, budget: loop.Budget) -> None:
    """Train the autoencoder, or continue."""
    _in_processes(_train_autoencoder, plan, budget)


def trained_autoencoder(plan: Plan) -> AutoencoderKL:
    """Return the trained autoencoder."""
    vae = autoencoder.build(plan.kind.latent_channels, plan.kind.size)
    return _smooth(vae, plan.work / "autoencoder.pt").to(memory_format=torch.channels_last)


def weights_of(out: Path) -> Path:
    """Return the file with the denoiser of a finished training, in full precision."""
    return out / "training" / "denoiser.safetensors"


def continue_from(plan: Plan, start: Path) -> None:
    """Use the autoencoder of another model, with the latents of the same views."""
    plan.work.mkdir(parents=True, exist_ok=True)
    for name in ("autoencoder.pt", "latents"):
        target = plan.work / name
        if not target.exists():
            target.symlink_to((start / "training" / name).resolve())


def encode_views(plan: Plan) -> tuple[float, float]:
    """Encode all views that are not encoded yet, and return the shift and the factor of latents."""
    jobs = [f"views_{i:04d}" for i in range(file_count(plan.groups))] + ["held_out"]
    missing = [name for name in jobs if not _latents_file(plan, name).is_file()]
    (plan.work / "latents").mkdir(parents=True, exist_ok=True)
    if plan.processes == 1:
        for number, name in enumerate(tqdm(missing, desc="latents", unit="file")):
            _encode(plan, name, number)
    elif missing:
        with ProcessPoolExecutor(plan.processes, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
            done = pool.map(_encode, [plan] * len(missing), missing, range(len(missing)))
            list(tqdm(done, total=len(missing), desc="latents", unit="file"))
    measured = [_latents(plan, name) for name in jobs[:MEASURED_FILES]]
    return plan.kind.scaling(torch.cat(measured))


def train_denoiser(plan: Plan, budget: loop.Budget, scaling: tuple[float, float]) -> None:
    """Train the denoiser with its text encoders, or continue."""
    _in_processes(_train_denoiser, plan, budget, scaling)


def trained_denoiser(plan: Plan, tokens: int) -> nn.ModuleDict:
    """Return the trained denoiser and its text encoders."""
    return _smooth(plan.kind.build(tokens), plan.work / "denoiser.pt")


def write_pipeline(plan: Plan, scaling: tuple[float, float]) -> None:
    """Write the folder of the pipeline."""
    vae = trained_autoencoder(plan)
    vae.register_to_config(
        scaling_factor=scaling[1], shift_factor=scaling[0] if scaling[0] else None, sample_size=plan.kind.size
    )
    read = tokenizer(plan.work / "tokenizer")
    model = trained_denoiser(plan, len(read))
    # For a model that continues from this one.
    save_file(model.state_dict(), weights_of(plan.out))
    plan.kind.save(plan.out, model, vae, read)


def curves(plan: Plan) -> list[dict[str, Any]]:
    """Return the logged losses and figures of all stages, also of the model that training started from."""
    folders = [plan.work] if plan.start is None else [plan.start / "training", plan.work]
    return [
        json.loads(line) for folder in folders for line in (folder / "curves.jsonl").read_text().splitlines()
    ]


def prior_of(plan: Plan) -> DiffusionPrior:
    """Return the prior that reads the written folder, as ``cadam3d train`` makes it."""
    typed = [
        f"prior={plan.kind.name}",
        f"prior.path={plan.out.resolve()}",
        f"prior.size={plan.kind.size}",
        f"prior.cache_dir={(plan.work / 'cache').resolve()}",
        f"prompting={plan.kind.prompting}",
    ]
    return component(compose([*typed, "prompt=cube"]).prior, DiffusionPrior, "prior")


def _smooth(model: nn.Module, checkpoint: Path) -> Any:
    kept = torch.load(checkpoint, map_location="cpu", weights_only=True)
    for parameter, smooth in zip(model.parameters(), kept["smooth"], strict=True):
        parameter.data.copy_(smooth)
    return model.eval()


def _train_autoencoder(rank: int, plan: Plan, budget: loop.Budget) -> None:
    workers = loop.Workers.join(rank, plan.processes, plan.device, plan.work / "rendezvous")
    torch.manual_seed(plan.seed)
    vae = autoencoder.build(plan.kind.latent_channels, plan.kind.size)
    vae = vae.to(workers.device, memory_format=torch.channels_last)
    views = load_views(plan.views, plan.own_files(rank))
    work = autoencoder.Reconstruction(vae, views, load_held_out(plan.views), workers.device)
    stage = loop.Stage("autoencoder", vae, work.loss, work.figures, AUTOENCODER_RATE, budget, plan.seed)
    loop.run(stage, workers, plan.work)
    workers.leave()


def _train_denoiser(rank: int, plan: Plan, budget: loop.Budget, scaling: tuple[float, float]) -> None:
    workers = loop.Workers.join(rank, plan.processes, plan.device, plan.work / "rendezvous")
    torch.manual_seed(plan.seed)
    read = tokenizer(plan.work / f"tokenizer_{rank}") if rank else tokenizer(plan.work / "tokenizer")
    model = plan.kind.build(len(read))
    if plan.start is not None:
        plan.kind.start(model, load_file(weights_of(plan.start)))
    model = model.to(workers.device)

    def encoded(views: Groups, latents: Tensor) -> Encoded:
        shift, factor = scaling
        return Encoded.of(views, (latents - shift) * factor, plan.kind, read)

    numbers = plan.own_files(rank)
    latents = torch.cat([_latents(plan, f"views_{i:04d}") for i in numbers])
    work = Denoising(
        plan.kind,
        model,
        encoded(load_views(plan.views, numbers, with_images=False), latents),
        encoded(load_held_out(plan.views), _latents(plan, "held_out")),
        workers.device,
    )
    stage = loop.Stage("denoiser", model, work.loss, work.figures, plan.kind.rate, budget, plan.seed)
    loop.run(stage, workers, plan.work)
    workers.leave()


def _encode(plan: Plan, name: str, number: int) -> None:
    vae = trained_autoencoder(plan).to(plan.device)
    views = load_held_out(plan.views) if name == "held_out" else load_views(plan.views, [int(name[-4:])])
    latents = autoencoder.encode(vae, views, plan.seed + 1000 + number, torch.device(plan.device))
    with replacing(_latents_file(plan, name)) as temporary:
        torch.save(latents, temporary)


def _latents_file(plan: Plan, name: str) -> Path:
    return plan.work / "latents" / f"{name}.pt"


def _latents(plan: Plan, name: str) -> Tensor:
    return torch.load(_latents_file(plan, name), weights_only=True)


def _in_processes(function: Callable[..., None], plan: Plan, *rest: Any) -> None:
    plan.work.mkdir(parents=True, exist_ok=True)
    (plan.work / "rendezvous").unlink(missing_ok=True)
    if plan.processes == 1:
        function(0, plan, *rest)
    else:
        spawn(function, (plan, *rest), nprocs=plan.processes)
