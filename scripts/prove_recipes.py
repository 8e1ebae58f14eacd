"""Run published recipes on the priors that come with cadam3d, and write a table and a picture.

    python scripts/prove_recipes.py --out outputs/recipes
    python scripts/prove_recipes.py --out outputs/recipes --steps 1200 --prompt "a green chair"

A recipe keeps all its settings except four: the prior, the size of images (64 pixels, which the priors were
trained on), the number of steps, and the number of points at the start, of which LucidDreamer's start makes
twenty Gaussians each. Words after the options are further settings of ``cadam3d train``.

Some recipes start from Shap-E, which is not part of cadam3d. Where it is not available, they start from a
ball, and their summaries say so. The same line again runs only what has no result yet.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

from PIL import Image, ImageDraw

# These recipes replace each point by twenty Gaussians. All start with 5,000.
REPLICATED = {"luciddreamer", "gcs_beg", "mvdream"}
GAUSSIANS, REPLICAS = 5000, 20
PRIORS = {
    "gaussiandreamer": "shapes_sd",
    "luciddreamer": "shapes_sd",
    "gcs_beg": "shapes_sd",
    "dreamgaussian": "shapes_sd",
    "mvdream": "shapes_mvdream",
}
SETTINGS = (
    "truth=shapes",
    "camera.size=64",
    "exporter=[ply,preview]",
    "exporter.preview.views=4",
    "exporter.preview.elevations_deg=[15]",
    "exporter.preview.labels=false",
    "exporter.preview.size=128",
)
HEADER = "| recipe | prior | Gaussians | PSNR (start) | IoU (start) | colour error | minutes |"
LABEL = 150  # pixels, of the names beside the pictures


def run(recipe: str, folder: Path, prompt: str, steps: int, settings: list[str]) -> dict[str, float]:
    """Train with one recipe unless there is a result, and return its figures."""
    summary = folder / "summary.json"
    if not summary.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        line = [f"experiment={recipe}", f"prior={PRIORS[recipe]}", f"prompt={prompt}", f"steps={steps}"]
        count = GAUSSIANS // REPLICAS if recipe in REPLICATED else GAUSSIANS
        own = [*line, *SETTINGS, f"initializer.count={count}", *settings, f"hydra.run.dir={folder}"]
        print("cadam3d train", *own, file=sys.stderr)
        subprocess.run([sys.executable, "-m", "cadam3d", "train", *own], check=True, stdout=sys.stderr)
    return json.loads(summary.read_text(encoding="utf-8"))


def row(recipe: str, found: dict[str, float]) -> str:
    """Return a line of the table for the summary ``found`` of a run."""
    cells = [
        f"`{recipe}`",
        f"`{PRIORS[recipe]}`",
        f"{found['num_gaussians']:,}",
        f"{found['psnr_turned']:.1f} ({found['psnr_start']:.1f}) dB",
        f"{found['iou']:.2f} ({found['iou_start']:.2f})",
        f"{found['colour_error']:.0f}",
        f"{found['seconds'] / 60:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def picture(folders: dict[str, Path], path: Path) -> None:
    """Write the previews below each other, each with the name of its recipe."""
    previews = {name: Image.open(folder / "preview.png").convert("RGB") for name, folder in folders.items()}
    width = LABEL + max(image.width for image in previews.values())
    whole = Image.new("RGB", (width, sum(image.height for image in previews.values())), "white")
    draw, top = ImageDraw.Draw(whole), 0
    for name, image in previews.items():
        whole.paste(image, (LABEL, top))
        draw.text((8, top + image.height // 2 - 6), name, fill="black")
        top += image.height
    whole.save(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the runs, the table and the picture"
    )
    parser.add_argument("--prompt", default="a red mushroom")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--recipes", nargs="+", choices=list(PRIORS), default=list(PRIORS))
    arguments, settings = parser.parse_known_args()
    settings = [word for word in settings if word != "--"]
    name = "_".join([*arguments.prompt.split(), str(arguments.steps), *settings])
    folders = {recipe: (arguments.out / name / recipe).absolute() for recipe in arguments.recipes}
    print(HEADER, "|" + "---|" * HEADER.count(" |"), sep="\n")
    for recipe, folder in folders.items():
        print(row(recipe, run(recipe, folder, arguments.prompt, arguments.steps, settings)), flush=True)
    picture(folders, arguments.out / name / "recipes.png")
    print(f"\npicture: {arguments.out / name / 'recipes.png'}")


if __name__ == "__main__":
    main()
