"""``sweep`` and ``evaluate`` do what the commands do, return their numbers, and leave the program alone."""

import csv
import os
import signal

import hydra
import pytest
from omegaconf import OmegaConf

import cadam3d
from cadam3d import cli
from cadam3d.io.lock import INHERITED
from cadam3d.sweep import process

SMALL = ("prior=shapes", "rasterizer=auto", "steps=2", "views=1", "camera.size=8", "initializer.count=20")
SMALL += ("refine.start=0", "refine.end=9", "refine.interval=1", "exporter=[ply]", "metric=[fidelity,size]")
SMALL += ("metric.fidelity.views=1", "callback=[]")
LINE = ("prompt=a red cube,a blue ball", "densifier=baseline,none", *SMALL)


def run_here(_plan, row, _stop, lock) -> int:
    """Run the job of a sweep in this process, which has loaded torch already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(INHERITED, str(lock))
        return cli.dispatch(["train", *row.overrides, f"hydra.run.dir={row.folder}"])


@pytest.fixture(scope="module")
def table() -> cadam3d.ResultTable:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "_wait", run_here)
        return cadam3d.sweep(*LINE, folder="table")


def test_the_rows_are_those_of_the_file_and_the_command_line_finds_the_jobs_done(table, type_line):
    assert [row["arm"] for row in table.rows] == ["baseline", "none"] * 2
    with (table.folder / "sweep.csv").open(encoding="utf-8", newline="") as file:
        written = list(csv.DictReader(file))
    rows = [{name: "" if value is None else str(value) for name, value in row.items()} for row in table.rows]
    assert written == rows
    assert table.report.is_file()
    line = (*LINE, f"hydra.sweep.dir={table.folder}", "dry_run=true")
    assert type_line("sweep", *line).out.startswith(f"4 jobs in {table.folder}, 4 with a result")


def test_two_arms_are_compared_within_cells(table):
    found = {line["number"]: line for line in table.compare("baseline", "none")}
    psnr = {(row["prompt"], row["arm"]): row["psnr"] for row in table.rows}
    gains = [psnr[prompt, "baseline"] - psnr[prompt, "none"] for prompt in ("a red cube", "a blue ball")]
    assert found["PSNR (dB)"]["value"] == pytest.approx(sum(gains) / 2)
    assert (found["PSNR (dB)"]["cells"], found["PSNR (dB)"]["prompts"]) == (2, 2)
    with pytest.raises(cadam3d.UserError, match="arms: expected two of baseline, none"):
        table.compare("baseline", "cadam")


def test_a_sweep_and_a_run_are_evaluated(table):
    again = cadam3d.evaluate(table, "metric=[fidelity,size]", "metric.fidelity.views=1")
    assert [row["psnr"] for row in again.rows] == [row["psnr"] for row in table.rows]
    assert (table.folder / "eval.json").is_file()
    run = cadam3d.Run(table.folder / table.rows[0]["folder"])
    [row] = cadam3d.evaluate(run, "metric=[size]").rows
    assert row.items() >= {"arm": "baseline", "prompt": "a red cube", "seed": 0}.items()
    assert row["psnr"] == run.summary["psnr"]


def test_an_interrupted_sweep_continues_and_the_program_of_the_caller_stays_as_it_was(
    process_state, monkeypatch, capfd
):
    def interrupted(*_) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        return 130

    line = ("prompt=a red cube", "densifier=baseline,none", *SMALL)
    monkeypatch.setattr("cadam3d.report.write_sweep", lambda folder: folder / "report.html")
    OmegaConf.register_new_resolver("slug", lambda text: f"my {text}", replace=True)
    with hydra.initialize(config_path=None, job_name="mine", version_base="1.2"):
        before = process_state()
        monkeypatch.setattr(process, "_wait", interrupted)
        with pytest.raises(KeyboardInterrupt, match=r"cadam3d\.sweep\('hydra.sweep.dir=halt', "):
            cadam3d.sweep(*line, folder="halt")
        assert process_state() == before
        assert [row["outcome"] for row in cadam3d.ResultTable("halt").rows] == ["interrupted", "unfinished"]
        monkeypatch.setattr(process, "_wait", run_here)
        table = cadam3d.sweep(*line, folder="halt")
        assert process_state() == before
    OmegaConf.clear_resolver("slug")
    assert [row["outcome"] for row in table.rows] == ["finished"] * 2
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("prompt=a cube",), r'nothing to sweep over\. Try: "densifier=baseline,cadam"'),
        (("prompt=a cube", "seed=0,1", "dry_run=true"), "a sweep that runs"),
        (("prompt=a cube", "seed=0,1", "stesp=3"), "stesp: no such setting"),
    ],
)
def test_what_a_sweep_cannot_do_is_refused(words, message):
    with pytest.raises(cadam3d.UserError, match=message):
        cadam3d.sweep(*words)
    with pytest.raises(cadam3d.UserError, match="run: expected the folder of a run"):
        cadam3d.ResultTable("nowhere")
