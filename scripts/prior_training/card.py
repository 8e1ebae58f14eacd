"""The model card, the list of words and the pictures that are written beside a trained model."""

import json
from pathlib import Path
from typing import Any

from prior_training import samples
from prior_training.autoencoder import GROUPS as AUTOENCODER_GROUPS
from prior_training.denoiser import IMAGES, LEVELS
from prior_training.stages import Plan, curves, prior_of
from prior_training.text import vocabulary
from prior_training.world import COLOURS, NOUNS, PATTERNS, RELATIONS, VIEWS, held_out_captions

from cadam3d.io.pretrained import INDEX

TITLES = {
    "stable_diffusion": "Stable Diffusion",
    "mvdream": "MVDream",
    "stable_diffusion_3": "Stable Diffusion 3",
}
# What chooses the prior for a format, with cameras and guidance that suit these models.
USES = {
    "stable_diffusion": "prior=shapes_sd",
    "mvdream": "prior=shapes_mvdream",
    "stable_diffusion_3": "prior=shapes_sd3",
}
# Captions of the sample pictures that the training set contains, and how many that it does not contain.
SHOWN = (
    "a blue sphere",
    "a yellow star",
    "a red striped torus",
    "a snowman",
    "an orange car",
    "a green cube on a white cylinder",
)
SHOWN_HELD_OUT = 6

START = ", from the weights of a model in the format of Stable Diffusion, whose own steps are not counted"
TEMPLATE = Path(__file__).with_name("card.md")


def write_card(plan: Plan) -> None:
    """Write README.md, vocabulary.json and samples.png into the folder of the model."""
    (plan.out / "vocabulary.json").write_text(json.dumps(vocabulary(), indent=1) + "\n", encoding="utf-8")
    _write_samples(plan)
    (plan.out / "README.md").write_text(_card(plan), encoding="utf-8")


def _write_samples(plan: Plan) -> None:
    prior = prior_of(plan)
    cameras = samples.four_cameras(plan.kind.size)
    captions = [*SHOWN, *held_out_captions()[:: len(held_out_captions()) // SHOWN_HELD_OUT][:SHOWN_HELD_OUT]]
    drawn = [
        samples.draw(prior, caption, cameras, plan.kind.latent_channels, seed=i)
        for i, caption in enumerate(captions)
    ]
    pairs = zip(drawn[::2], drawn[1::2], strict=True)
    samples.write_grid([[*left, *right] for left, right in pairs], plan.out / "samples.png")


def _card(plan: Plan) -> str:
    name = plan.kind.name
    logged = curves(plan)
    vae = _last(logged, "autoencoder", "psnr")
    denoiser = _last(logged, "denoiser", "right")
    rows = {way: " | ".join(f"{error:.3f}" for error in denoiser[way]) for way in ("right", "empty", "wrong")}
    return TEMPLATE.read_text(encoding="utf-8").format(
        format=name,
        title=TITLES[name],
        size=plan.kind.size,
        nouns=len(NOUNS),
        colours=len(COLOURS),
        patterns=len(PATTERNS),
        relations=", ".join(RELATIONS),
        line=f'cadam3d train {USES[name]} prior.path=FOLDER prompt="a red mushroom"',
        held_out_shown=SHOWN_HELD_OUT,
        images=VIEWS * plan.groups,
        groups=plan.groups,
        held_out=len(held_out_captions()),
        seed=plan.seed,
        vae_steps=vae["step"],
        steps=denoiser["step"],
        start="" if plan.start is None else START,
        processes="1 process" if plan.processes == 1 else f"{plan.processes} processes",
        vae_images=VIEWS * AUTOENCODER_GROUPS * plan.processes,
        images_per_step=IMAGES * plan.processes,
        minutes=(vae["seconds"] + denoiser["seconds"]) / 60,
        device=plan.device,
        parameters=_parameters(plan.out),
        psnr=vae["psnr"],
        object_psnr=vae["object_psnr"],
        target=plan.kind.target,
        levels=" | ".join(f"{level:g}" for level in LEVELS),
        rules="|".join("---" for _ in LEVELS),
        **rows,
    )


def _last(logged: list[dict[str, Any]], stage: str, figure: str) -> dict[str, Any]:
    return next(row for row in reversed(logged) if row["stage"] == stage and figure in row)


def _parameters(folder: Path) -> str:
    """Return the sizes of the parts of a model, in millions of numbers of two bytes."""
    index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
    files = sorted(file for file in folder.glob("*/*.safetensors") if file.parent.name in index)
    sizes = [f"{file.parent.name} {file.stat().st_size / 2e6:.2f} M" for file in files]
    total = sum(file.stat().st_size for file in files)
    return f"{', '.join(sizes)}; {total / 1e6:.1f} MB in half precision"
