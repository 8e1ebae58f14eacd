"""scripts/bench_large.py on tiny scenes: the tables are complete, and no time is asserted."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from splats import backgrounds, make_cameras, make_gaussians

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import bench_large

from cadam3d.io.cache import kernels_dir, make_private
from cadam3d.rasterizer.cpu import STAGES, pass_costs
from cadam3d.rasterizer.reference import ReferenceRasterizer


@pytest.fixture(autouse=True)
def _cached_kernels(kernel_build, tmp_path, monkeypatch):
    """Let the processes of the script find the compiled kernels."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = kernels_dir(None)
    make_private(folder)
    shutil.copy2(kernel_build.path, folder)


def test_every_scene_gets_times_and_stages(tmp_path, capsys):
    words = ["--counts", "50", "--sizes", "24", "--threads", "1", "--repeats", "1"]
    bench_large.main(
        [*words, "--base", str(bench_large.measuring.HERE), "--json", str(tmp_path / "large.json")]
    )
    (row,) = json.loads((tmp_path / "large.json").read_text())["times"]
    assert list(row["ms"]) == ["base, 1 threads", "here, 1 threads"]
    assert list(row["ms"]["here, 1 threads"]["stages"]) == list(STAGES)
    shown = capsys.readouterr().out
    assert "base / here, 1 threads" in shown
    assert "| blend backward |" in shown


def test_memory_is_measured(tmp_path):
    words = ["--memory", "--counts", "300", "--sizes", "24", "--threads", "1"]
    bench_large.main([*words, "--json", str(tmp_path / "memory.json")])
    (row,) = json.loads((tmp_path / "memory.json").read_text())["memory"]
    assert row["peak_bytes"]["here"] >= 0


def test_costs_count_the_slots_of_a_pass_of_this_rasterizer_only(cpu):
    gaussians = make_gaussians(200).map(lambda tensor: tensor.requires_grad_())
    scene = gaussians, make_cameras(2, 40, 40), backgrounds(2)
    output = cpu.render(*scene)
    costs = pass_costs(output)
    assert costs.visible == output.visible.sum()
    assert costs.slots >= costs.visible
    assert costs.held_bytes > (64 + 16) * 2 * 200
    assert all(costs.seconds[stage] > 0 for stage in ("project", "order", "lists", "blend"))
    assert costs.seconds["gather"] == 0
    output.rgb.sum().backward()
    assert all(seconds > 0 for seconds in pass_costs(output).seconds.values())
    with pytest.raises(ValueError, match="rasterizer=cpu"):
        pass_costs(ReferenceRasterizer().render(*scene))
