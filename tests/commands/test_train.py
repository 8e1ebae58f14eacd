"""The numbers in the summary of a run are those of the files on disk."""

import json
import shlex
import sys
from pathlib import Path

import pytest

from cadam3d import cli
from cadam3d.io.ply import read_ply
from cadam3d.settings.line import continuing

SMALL = ["prompt=a red cube", "prior=tiny", "rasterizer=auto", "camera.size=8", "steps=1", "views=1"]
SMALL += ["initializer.count=7", "metric=[size]", "callback=[]"]
PREVIEW = ["exporter.preview.size=8", "exporter.preview.views=1", "exporter.preview.labels=false"]


@pytest.fixture
def train(monkeypatch, tmp_path):
    """Train one step in this process and return the run folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> Path:
        monkeypatch.setattr(sys, "argv", ["cadam3d", "train", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert not ended.value.code
        return tmp_path / "run"

    return run


def check_sizes(folder: Path) -> None:
    """Compare the summary with the files on disk."""
    summary = json.loads((folder / "summary.json").read_text())
    asset = folder / "asset.ply"
    if not asset.is_file():
        assert not summary.keys() & {"asset_bytes", "asset_mib", "bytes_per_gaussian"}
        return
    size, count = asset.stat().st_size, len(read_ply(asset))
    assert summary["num_gaussians"] == count
    assert summary["asset_bytes"] == size
    assert summary["asset_mib"] == size / 2**20
    assert summary["bytes_per_gaussian"] == size / count


# The least SH degree of the file, its up axis, the SH degree of the asset, and the exporters.
SETTINGS = [
    (0, "-y", 0, "[ply]"),
    (3, "+z", 2, "[preview,ply]"),
    (1, "+y", 3, "[ply]"),
    (None, None, 0, "[preview]"),
]


@pytest.mark.parametrize(("pad_sh", "up", "degree", "exporters"), SETTINGS)
def test_the_sizes_in_the_summary_are_those_on_disk(pad_sh, up, degree, exporters, train):
    words = [*SMALL, "hydra.run.dir=run", f"exporter={exporters}", f"initializer.sh_degree={degree}"]
    words += PREVIEW if "preview" in exporters else []
    words += [f"exporter.ply.pad_sh={pad_sh}", f"exporter.ply.up={up}"] if "ply" in exporters else []
    folder = train(*words)
    assert (folder / "asset.ply").is_file() == ("ply" in exporters)
    check_sizes(folder)


def test_without_metrics_the_summary_still_has_the_bytes_of_the_asset(train):
    folder = train(*SMALL, "hydra.run.dir=run", "exporter=[ply]", "exporter.ply.pad_sh=3", "metric=[]")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["asset_bytes"] == (folder / "asset.ply").stat().st_size


def test_the_file_of_an_earlier_attempt_is_not_measured(train):
    folder = train(*SMALL, "hydra.run.dir=run", "exporter=[ply]", "callback=[checkpoint]")
    train("resume=run", "steps=2", "exporter=[]")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["steps"] == 2
    assert (folder / "asset.ply").is_file()
    assert "asset_bytes" not in summary
    assert "asset_mib" not in summary


def test_the_line_that_continues_a_run_names_the_folder_of_its_yaml_files(train, tmp_path):
    (tmp_path / "my own/densifier").mkdir(parents=True)
    (tmp_path / "my own/densifier/mine.yaml").write_text("_target_: cadam3d.densifier.none.NoGrowth\n")
    line = ("--config-dir", "my own", "densifier=mine", "hydra.run.dir=run", "exporter=[]")
    folder = train(*SMALL, *line, "callback=[checkpoint]")
    program, command, *words = shlex.split(continuing(folder))
    assert (program, command) == ("cadam3d", "train")
    assert not (folder / "asset.ply").exists()
    train(*words, "exporter=[ply]")
    assert (folder / "asset.ply").is_file()
