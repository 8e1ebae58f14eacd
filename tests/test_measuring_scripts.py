"""The scripts that measure priors and recipes: what is trained, once each, and what the tables say of it."""

import json
import sys
from pathlib import Path

import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import bench_priors
import measuring
import prove_recipes

from cadam3d.settings.compose import compose

GOOD = {"psnr_start": 12.0, "psnr_turned": 18.0, "iou_start": 0.3, "iou": 0.8, "colour_error": 4.0}
REST = {"num_gaussians": 5000, "turn_deg": 90.0, "seconds": 60.0}


@pytest.fixture
def trained(monkeypatch):
    """Replace training: each run writes a summary and a picture, and its settings are kept."""
    lines = []

    def train(line, stdout):
        settings = line[4:]
        folder = Path(settings[-1].removeprefix("hydra.run.dir="))
        folder.mkdir(parents=True)
        prompt = next(word[7:] for word in settings if word.startswith("prompt="))
        (folder / "summary.json").write_text(json.dumps(GOOD | REST | {"prompt": prompt}))
        Image.new("RGB", (40, 10)).save(folder / "preview.png")
        lines.append(settings[:-1])
        return 0

    monkeypatch.setattr(measuring.subprocess, "call", train)
    return lines


def test_every_prompt_is_trained_once_with_lines_that_compose(trained, tmp_path, capsys):
    words = ["--prior", "shapes_sd", "steps=7", "--out", str(tmp_path)]
    bench_priors.main(words)
    assert len(trained) == len(bench_priors.PROMPTS)
    assert all("steps=7" in settings for settings in trained)
    assert compose(trained[0]).steps == 7
    first = capsys.readouterr().out
    bench_priors.main(words)
    assert len(trained) == len(bench_priors.PROMPTS)
    assert capsys.readouterr().out == first
    assert "median gain +6.00 dB; right colour 10, right outline 10, both 10 of 10" in first
    # Other settings are other runs.
    bench_priors.main([*words, "views=3"])
    assert len(trained) == 2 * len(bench_priors.PROMPTS)


def test_a_run_without_a_summary_is_trained_again(trained, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "asset.ply").touch()
    assert measuring.trained(tmp_path / "run", ["prompt=cube"])["prompt"] == "cube"
    assert not (tmp_path / "run" / "asset.ply").exists()


def test_every_recipe_is_run_on_a_prior_of_the_package(trained, tmp_path, capsys):
    prove_recipes.main(["--out", str(tmp_path), "--steps", "50", "seed=3"])
    recipes = dict(zip(prove_recipes.RECIPES, trained, strict=True))
    for name, settings in recipes.items():
        run = compose(settings)
        assert run.prior.path == f"package:{prove_recipes.RECIPES[name].prior}"
        assert (run.steps, run.seed, run.camera.size) == (50, 3, 64)
        replicas = run.initializer.get("replicate", 1)
        assert replicas * run.initializer.count == prove_recipes.GAUSSIANS, name
    (out,) = tmp_path.iterdir()
    table = (out / "recipes.md").read_text().splitlines()
    assert len(table) == 2 + len(recipes)
    assert Image.open(out / "recipes.png").size == (prove_recipes.LABEL + 40, 10 * len(recipes))
