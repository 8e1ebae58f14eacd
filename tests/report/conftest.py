"""Sweep folders made by hand: the layout of a real sweep, all files that figures need, and known numbers."""

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import yaml
from declarations import declared
from hydra.core.override_parser.overrides_parser import OverridesParser

from cadam3d.core.chart import Chart, Curve, Level
from cadam3d.io import run_folder
from cadam3d.io.declarations import write_declarations
from cadam3d.report import write_sweep
from cadam3d.report.results import JobResult, read
from cadam3d.sweep.folder import Job, Plan, write_plan

SIZE = 12  # pixels of a picture
STEPS = (40, 80, 120)


# The chart that a densifier with a score declares. Its names are invented, because the reports know no score.
SHAKE = Chart(
    title="Shaking of the Gaussians",
    caption="How much each Gaussian shakes.",
    curves=(Curve(key="shake_median", label="median"),),
    score="shake",
    levels=(Level(label="tau_shake", value=0.1), Level(label="pure noise", value=0.229)),
)


@cache
def pair(override: str) -> tuple[str, Any]:
    """Return the key and the value of an override."""
    parsed = OverridesParser.create().parse_override(override)
    return parsed.key_or_group, parsed.value()


class Jobs:
    """Writes the folder of a sweep: its plan, and a folder per job."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.figures: list[str] | None = None
        self.line: list[str] = []
        self.paper_table = False
        self.category = ""  # of the prompts of the jobs that are added next
        self.planned: list[Job] = []

    def plan(self, arm: str, overrides: Sequence[str], name: str = "") -> Path:
        """Add a job to the plan and return its folder, which does not exist yet."""
        name = name or f"{len(self.planned)}_{overrides[0].partition('=')[2]}"
        swept = dict(map(pair, overrides))
        job = Job(arm=arm, name=name, overrides=list(overrides), swept=swept, category=self.category)
        self.planned.append(job)
        self.write_plan()
        return self.folder / name

    def write_plan(self) -> None:
        """Write ``jobs.json`` anew."""
        plan = Plan(
            cwd=str(self.folder),
            flags=[],
            threads=None,
            jobs=self.planned,
            figures=self.figures,
            line=self.line,
            paper_table=self.paper_table,
        )
        write_plan(self.folder, plan)

    def add(
        self,
        densifier: str,
        *more: str,
        n: float,
        psnr: float | None,
        outcome: str = "finished",
        arm: str = "",
        **summary: Any,
    ) -> Path:
        """Add one job that has run; ``more`` are the other overrides of its line."""
        overrides = [f"densifier={densifier}", *more]
        folder = self.plan(arm, overrides)
        folder.mkdir(parents=True)
        given = dict(line.split("=", 1) for line in overrides)
        facts = {
            "prompt": given.get("prompt", "a cube"),
            "seed": int(given.get("seed", 0)),
            "outcome": outcome,
            "num_gaussians": round(n),
            "num_gaussians_initial": 300,
            "psnr": psnr,
            "ssim": 0.9,
            "steps": 120,
            "asset_bytes": 68 * round(n),
            "asset_mib": 68 * round(n) / (1 << 20),
            "seconds": 1.5,
            "densifier": densifier,
            "grows": densifier != "none",
            "guidance": given.get("guidance", "sds"),
            "warnings": [],
            **summary,
        }
        (folder / run_folder.SUMMARY).write_text(json.dumps(declared(facts)))
        return folder

    def files(self, folder: Path, n: float, shake: float = 0.2) -> None:
        """Write what figures show beyond the summary: counts over time, histograms, pictures, charts.

        Only variants of CAdam have the score ``shake``.
        """
        settings = {"exporter": {"preview": {"size": SIZE}}}
        (folder / run_folder.CONFIG).write_text(yaml.safe_dump(settings))
        has_score = "cadam" in folder.name
        write_declarations(folder, [SHAKE] if has_score else [])
        lines, before = [{"kind": "step", "step": 1, "num_gaussians": 300}], 300.0
        histograms = []
        for i, step in enumerate(STEPS, start=1):
            after = round(300 * (n / 300) ** (i / len(STEPS)))
            lines.append({"kind": "refine", "step": step, "before": before, "after": after})
            before = after
            histograms.append(
                {
                    "step": step,
                    "score": "shake" if has_score else "norm",
                    "bins_per_decade": 10,
                    "first": math.floor(math.log10(shake) * 10) - 1,
                    "counts": [20, 60, 20],
                    "selected": [0, 5, 5],
                    "without_log": 0,
                }
            )
        write_lines(folder / run_folder.METRICS, lines)
        (folder / run_folder.CANDIDATES).mkdir()
        write_lines(folder / run_folder.HISTOGRAMS, histograms)
        rng = np.random.default_rng(int(n))
        for step in STEPS:
            noise = rng.integers(0, 255, (SIZE, 2 * SIZE, 3), dtype=np.uint8)
            imageio.imwrite(folder / run_folder.CANDIDATES / f"step_{step:06d}.png", noise)
        preview = rng.integers(0, 255, (2 * SIZE, 3 * SIZE, 3), dtype=np.uint8)
        imageio.imwrite(folder / run_folder.PREVIEW, preview)


def write_lines(path: Path, lines: Sequence[dict]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.fixture
def jobs(tmp_path) -> Jobs:
    return Jobs(tmp_path)


@pytest.fixture(scope="session")
def bench(tmp_path_factory) -> Path:
    """A whole comparison: 3 prompts, 2 seeds, 3 noise levels; the baseline at 3 thresholds, CAdam at 4."""
    jobs = Jobs(tmp_path_factory.mktemp("bench"))
    rng = np.random.default_rng(0)
    for level, loss in (("none", 0.0), ("medium", 2.0), ("strong", 6.0)):
        for p, prompt in enumerate(("a cube", "a torus", "a tower")):
            for seed in (0, 1):
                where = (f"prompt={prompt}", f"seed={seed}", f"noise={level}")
                zero = 20.0 + p - loss + 0.2 * rng.standard_normal()
                settings = [("none", (), 300.0, 0.0)]
                for tau, n in ((2e-4, 20000.0), (1e-3, 4000.0), (4e-3, 600.0)):
                    settings.append(("baseline", (f"densifier.tau_pos={tau}",), n, 4.0))
                for tau_q, n in ((0.9, 1200.0), (0.7, 2500.0)):
                    for tau_snr, share in ((0.1, 1.0), (0.3, 0.7)):
                        keys = (f"densifier.tau_Q={tau_q}", f"densifier.tau_SNR={tau_snr}")
                        settings.append(("cadam", keys, n * share, 4.5))
                for densifier, keys, n, best in settings:
                    count = round(n * (1 + 0.1 * rng.standard_normal()))
                    gain = best * (1 - 300 / max(count, 300)) * (1 - loss / 12) + 0.05 * rng.standard_normal()
                    folder = jobs.add(densifier, *keys, *where, n=count, psnr=zero + gain)
                    jobs.files(folder, count)
    jobs.line = ["grid=pareto", "prompt=a <b>cube</b>"]
    where = ("prompt=a cube", "seed=2", "noise=strong")
    jobs.add("baseline", "densifier.tau_pos=0.0002", *where, n=40000, psnr=18.0, outcome="max_gaussians")
    jobs.add(
        "cadam", "prompt=a cube", "seed=2", "noise=strong", n=0, psnr=None, outcome="failed", message="no <b>"
    )
    return jobs.folder


@pytest.fixture(scope="session")
def bench_page(bench) -> Path:
    """Return the written page of the whole comparison."""
    return write_sweep(bench)


@pytest.fixture(scope="session")
def bench_results(bench) -> list[JobResult]:
    return read(bench)
