"""The published recipes: each has the published numbers and trains with a pipeline of its real classes."""

import sys

import pytest

from cadam3d import cli
from cadam3d.build import component
from cadam3d.core.schedule import as_schedule
from cadam3d.io.jsonl import read_json
from cadam3d.settings.compose import compose

pytestmark = pytest.mark.slow

LUCID = {"views": 4, "tau_pos": 7.5e-4, "stats": "last", "calls": (200, 2900)}
FLOW = LUCID | {"steps": 5000, "calls": (200, 1400), "scale": 40, "weight": 0.1, "reduction": "sum"}
FLOW |= {"t": {0: (0.02, 0.98), 750: (0.02, 0.74), 1500: (0.02, 0.5), 4999: (0.02, 0.5)}, "disparity": 0.1}
RECIPES = {
    "gaussiandreamer": {
        "steps": 1200,
        "views": 4,
        "scale": 101,
        "weight": 1,
        "reduction": "sum_per_view",
        "t": {0: (0.02, 0.98), 500: (0.02, 0.98), 501: (0.02, 0.55)},
        "clip": {0: 1.5, 500: 1.75, 1000: 2.0, 1199: 2.0},
        "tau_pos": 2e-4,
        "stats": "sum_vector",
        "calls": (400, 800),
    },
    "luciddreamer": LUCID
    | {
        "steps": 5000,
        "scale": 7.5,
        "weight": 0.1,
        "reduction": "sum",
        "t": {0: (0.02, 0.98), 750: (0.02, 0.74), 1500: (0.02, 0.5)},
        "delta": {0: 0.1, 1500: 0.08},
        "initial_noise": 0.002,
        "noise_offset": 0.1,
        "disparity": 0.2,
    },
    "flowdreamer": FLOW,
    "flowdreamer_near": FLOW,
    "flowdreamer_ucm": FLOW,
    "gcs_beg": LUCID
    | {
        "steps": 5000,
        "scale": 7.5,
        "weight": 0.1,
        "reduction": "sum_per_view",
        "t": {0: (0.5, 0.98), 750: (0.26, 0.74), 1500: (0.02, 0.5)},
        "delta": {0: 0.1, 1500: 0.08},
        "noise_offset": 0.1,
        "disparity": 0.2,
    },
    "dreamgaussian": {
        "steps": 500,
        "views": 1,
        "scale": 100,
        "weight": 1,
        "reduction": "sum_per_view",
        "t": {0: (0.98, 0.98), 10: (0.98, 0.98), 250: (0.5, 0.5), 490: (0.02, 0.02), 499: (0.02, 0.02)},
        "tau_pos": 0.01,
        "stats": "last",
        "calls": (50, 500),
    },
    "mvdream": {
        "steps": 1200,
        "views": 4,
        "scale": 50,
        "weight": 1,
        "reduction": "sum_per_view",
        "t": {0: (0.98, 0.98), 480: (0.5, 0.74), 960: (0.02, 0.5), 1199: (0.02, 0.5)},
        "tau_pos": 2e-4,
        "stats": "sum_norm",
        "calls": (400, 800),
    },
}
PIPELINES = {
    "flowdreamer": "stable_diffusion_3",
    "flowdreamer_near": "stable_diffusion_3",
    "flowdreamer_ucm": "stable_diffusion_3",
    "mvdream": "mvdream",
}


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_has_the_published_numbers(recipe):
    wanted = RECIPES[recipe]
    cfg = compose(["prompt=x", f"experiment={recipe}", "densifier=baseline"])
    guidance, refine, densifier = (component(cfg[name]) for name in ("guidance", "refine", "densifier"))
    assert (cfg.steps, cfg.views) == (wanted["steps"], wanted["views"])
    assert (guidance.scale, guidance.weight) == (wanted["scale"], wanted["weight"])
    assert guidance.reduction == wanted["reduction"]
    for step, window in wanted["t"].items():
        low, high = as_schedule(guidance.t_min)(step), as_schedule(guidance.t_max)(step)
        assert (low, high) == pytest.approx(window)
    for name in ("initial_noise", "noise_offset"):
        assert getattr(guidance, name, None) == wanted.get(name)
    for name in ("clip", "delta"):
        for step, value in wanted.get(name, {}).items():
            assert as_schedule(getattr(guidance, name))(step) == pytest.approx(value)
    if "disparity" in wanted:
        assert component(cfg.augmentation).disparity == wanted["disparity"]
        weights = {name: node.weight for name, node in cfg.regularizer.items()}
        assert weights == {"squared_variation": 1, "disparity_variation": 1, "mean_scale": 0.5}
    calls = [step for step in range(1, cfg.steps + 1) if refine.refines_at(step)]
    assert (calls[0], calls[-1]) == wanted["calls"]
    assert (densifier.tau_pos, densifier.views) == (wanted["tau_pos"], wanted["stats"])


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_command_line_can_replace_every_group_of_a_recipe(recipe):
    """No value of a recipe remains in a group that the command line replaces, such as the densifier."""
    others = ["prior=shapes", "guidance=sds", "camera=orbit", "initializer=ball", "densifier=none"]
    others += ["optimizer=adam", "refine=default", "augmentation=none", "background=white", "exposure=none"]
    cfg = compose(["prompt=x", f"experiment={recipe}", *others])
    plain = compose(["prompt=x", f"steps={cfg.steps}", *others])
    for group in (line.partition("=")[0] for line in others):
        assert cfg[group] == plain[group]


@pytest.mark.parametrize(
    ("recipe", "densifier"),
    [*((recipe, "cadam") for recipe in RECIPES), ("luciddreamer", "baseline"), ("flowdreamer", "baseline")],
)
def test_a_recipe_trains_through_a_real_pipeline(recipe, densifier, pipelines, tmp_path, monkeypatch):
    folder = pipelines(PIPELINES.get(recipe, "stable_diffusion"))
    lines = [f"experiment={recipe}", "prompt=a corgi", f"prior.path={folder}", f"densifier={densifier}"]
    lines += ["steps=2", "initializer=ball", "initializer.count=50", "initializer.scale=0.05"]
    lines += ["camera.size=16", "prior.size=32"]
    lines += [
        "exporter=[ply]",
        "metric=[size]",
        "callback=[metrics]",
        f"prior.cache_dir={tmp_path / 'texts'}",
    ]
    lines += ["refine.start=0", "refine.interval=1", "refine.end=3", f"hydra.run.dir={tmp_path}"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["cadam3d", "train", *lines])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    summary = read_json(tmp_path / "summary.json")
    assert (summary["outcome"], summary["steps"], summary["skipped_steps"]) == ("finished", 2, 0)
    assert summary["memory_estimate_gib"] > 0
    assert (tmp_path / "asset.ply").is_file()
