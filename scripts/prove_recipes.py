"""Run every published recipe on the priors that come with cadam3d, and write a table and a picture.

    python scripts/prove_recipes.py --out outputs/recipes
    python scripts/prove_recipes.py --out outputs/recipes --steps 1200 --prompt "a green chair"

A recipe keeps all its settings except four: the prior, the size of images (64 pixels, which the priors were
trained on), the number of steps, and the number of points at the start, of which LucidDreamer's start makes
twenty Gaussians each. Words after the options are further settings of ``cadam3d train``.

Some recipes start from Shap-E, which is not part of cadam3d. Where it is not available, they start from a
ball, and their summaries say so. The same line again runs only what has no result yet.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import measuring
from PIL import Image, ImageDraw

GAUSSIANS = 5000  # at the start of every recipe


@dataclass(frozen=True)
class Recipe:
    """What is not published about a run with a recipe."""

    prior: str
    replicas: int = 1  # Gaussians that the start makes of each point

    def settings(self, name: str, prompt: str, steps: int) -> list[str]:
        """Return the settings of a run with the recipe ``name``."""
        count = GAUSSIANS // self.replicas
        choice = [f"experiment={name}", f"prior={self.prior}", f"prompt={prompt}", f"steps={steps}"]
        return [*choice, *SETTINGS, f"initializer.count={count}"]


RECIPES = {
    "gaussiandreamer": Recipe("shapes_sd"),
    "luciddreamer": Recipe("shapes_sd", replicas=20),
    "gcs_beg": Recipe("shapes_sd", replicas=20),
    "dreamgaussian": Recipe("shapes_sd"),
    "flowdreamer": Recipe("shapes_sd3", replicas=20),
    "flowdreamer_near": Recipe("shapes_sd3", replicas=20),
    "flowdreamer_ucm": Recipe("shapes_sd3", replicas=20),
    "mvdream": Recipe("shapes_mvdream", replicas=20),
}
SETTINGS = (
    "truth=shapes",
    "camera.size=64",
    "exporter=[ply,preview]",
    "exporter.preview.views=4",
    "exporter.preview.elevations_deg=[15]",
    "exporter.preview.labels=false",
    "exporter.preview.size=128",
    # White stems show on grey, and from this far, objects larger than the unit ball are visible as a whole.
    "exporter.preview.background=[0.5,0.5,0.5]",
    "exporter.preview.distance=4.5",
)
# What each column of the table shows, of the name of a recipe and the summary of its run.
COLUMNS: dict[str, Callable[[str, dict[str, Any]], str]] = {
    "recipe": lambda name, found: f"`{name}`",
    "prior": lambda name, found: f"`{RECIPES[name].prior}`",
    "Gaussians": lambda name, found: f"{found['num_gaussians']:,}",
    "PSNR (start)": lambda name, found: f"{found['psnr_turned']:.1f} ({found['psnr_start']:.1f}) dB",
    "IoU (start)": lambda name, found: f"{found['iou']:.2f} ({found['iou_start']:.2f})",
    "colour error": lambda name, found: f"{found['colour_error']:.0f}",
    "minutes": lambda name, found: f"{found['seconds'] / 60:.1f}",
}
LABEL = 150  # pixels, of the names beside the pictures


def picture(previews: Mapping[str, Path], path: Path) -> None:
    """Write pictures below each other, each with the name of its recipe."""
    images = {name: Image.open(preview).convert("RGB") for name, preview in previews.items()}
    width = LABEL + max(image.width for image in images.values())
    whole = Image.new("RGB", (width, sum(image.height for image in images.values())), "white")
    draw, top = ImageDraw.Draw(whole), 0
    for name, image in images.items():
        whole.paste(image, (LABEL, top))
        draw.text((8, top + image.height // 2 - 6), name, fill="black")
        top += image.height
    whole.save(path)


def main(line: Sequence[str] | None = None) -> None:
    parser = measuring.parser_of(__doc__)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the runs, the table and the picture"
    )
    parser.add_argument("--prompt", default="a red mushroom")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--recipes", nargs="+", choices=list(RECIPES), default=list(RECIPES))
    arguments, settings = parser.parse_known_args(line)
    out = arguments.out / measuring.folder_name(f"{arguments.prompt} {arguments.steps}", settings)
    lines = [measuring.header(COLUMNS)]
    print(lines[0])
    for name in arguments.recipes:
        own = RECIPES[name].settings(name, arguments.prompt, arguments.steps)
        found = measuring.trained(out / name, [*own, *settings])
        lines.append(measuring.line_of([show(name, found) for show in COLUMNS.values()]))
        print(lines[-1], flush=True)
    (out / "recipes.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    picture({name: out / name / "preview.png" for name in arguments.recipes}, out / "recipes.png")
    print(f"\ntable and picture: {out / 'recipes.md'}, {out / 'recipes.png'}")


if __name__ == "__main__":
    main()
