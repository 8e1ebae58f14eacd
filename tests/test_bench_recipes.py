"""The benchmark of whole recipes: its models load, and its steps are timed."""

import argparse
import importlib.util
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")
SCRIPT = Path(__file__).parent.parent / "scripts" / "bench_recipes.py"


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("bench_recipes", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_estimates_need_no_weights(bench, tmp_path, capsys):
    bench.stable_diffusion(tmp_path, tiny=True, weights=False)
    assert not list(tmp_path.rglob("*.safetensors"))
    bench.estimate("luciddreamer", tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines] == ["low", "medium", "full"]


def test_a_recipe_is_timed_on_random_networks(bench, tmp_path):
    bench.stable_diffusion_3(tmp_path, tiny=True, weights=True)
    args = argparse.Namespace(device="cpu", steps=3, warmup=1, count=20, vram="low")
    args.settings = ["camera.size=16", "prior.size=32", "rasterizer=reference"]
    found = bench.measure("flowdreamer", tmp_path, args)
    assert found["seconds_per_step"] > 0
    assert found["estimate_bytes"] > 0
    assert found["peak_bytes"] is None or torch.cuda.is_available()
