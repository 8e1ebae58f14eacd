"""Sweep folders made by hand: jobs with every file that figures are made of, and numbers that are known."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import yaml

from cadam3d.report.rows import Row, read

SIZE = 12  # pixels of a picture
STEPS = (40, 80, 120)


class Jobs:
    """Writes job folders as a sweep leaves them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.number = 0

    def add(
        self, arm: str, *more: str, n: float, psnr: float | None, outcome: str = "finished", **summary: Any
    ) -> Path:
        """One job of ``arm``; ``more`` are the other overrides of its line."""
        overrides = [f"densifier={arm}", *more]
        folder = self.folder / f"{self.number}_{arm}"
        self.number += 1
        (folder / ".hydra").mkdir(parents=True)
        (folder / ".hydra/overrides.yaml").write_text(yaml.safe_dump(overrides))
        told = dict(line.split("=") for line in overrides)
        facts = {
            **{"prompt": told.get("prompt", "a cube"), "seed": int(told.get("seed", 0)), "outcome": outcome},
            **{"num_gaussians": n, "num_gaussians_initial": 300, "psnr": psnr, "ssim": 0.9, "steps": 120},
            **{
                "asset_bytes": 68 * n,
                "seconds": 1.5,
                "densifier": arm,
                "guidance": told.get("guidance", "sds"),
            },
            **summary,
        }
        (folder / "summary.json").write_text(json.dumps(facts))
        return folder

    def files(self, folder: Path, n: float, snr: float = 0.2) -> None:
        """What figures show beyond the summary: counts over time, histograms, pictures, settings."""
        settings = {"tau_SNR": 0.1, "beta1": 0.9, "beta2": 0.999}
        preview = {"exporter": {"preview": {"size": SIZE}}, "densifier": settings}
        (folder / "config.yaml").write_text(yaml.safe_dump(preview))
        lines, before = [{"kind": "step", "step": 1, "num_gaussians": 300}], 300.0
        histograms = []
        for i, step in enumerate(STEPS, start=1):
            after = round(300 * (n / 300) ** (i / len(STEPS)))
            lines.append({"kind": "refine", "step": step, "before": before, "after": after})
            before = after
            counts = [20, 60, 20]
            first = math.floor(math.log10(snr) * 10) - 1
            histograms.append(
                {
                    **{
                        "step": step,
                        "score": "snr" if "cadam" in folder.name else "norm",
                        "bins_per_decade": 10,
                        "first": first,
                    },
                    **{"counts": counts, "selected": [0, 5, 5], "without_log": 0},
                }
            )
        write_lines(folder / "metrics.jsonl", lines)
        (folder / "candidates").mkdir()
        write_lines(folder / "candidates/histograms.jsonl", histograms)
        rng = np.random.default_rng(int(n))
        for step in STEPS:
            noise = rng.integers(0, 255, (SIZE, 2 * SIZE, 3), dtype=np.uint8)
            imageio.imwrite(folder / f"candidates/step_{step:06d}.png", noise)
        imageio.imwrite(folder / "preview.png", rng.integers(0, 255, (2 * SIZE, 3 * SIZE, 3), dtype=np.uint8))


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
                for arm, keys, n, best in settings:
                    count = round(n * (1 + 0.1 * rng.standard_normal()))
                    gain = best * (1 - 300 / max(count, 300)) * (1 - loss / 12) + 0.05 * rng.standard_normal()
                    folder = jobs.add(arm, *keys, *where, n=count, psnr=zero + gain)
                    jobs.files(folder, count)
    jobs.add(
        "baseline", "prompt=a cube", "seed=2", "noise=strong", n=40000, psnr=18.0, outcome="max_gaussians"
    )
    jobs.add(
        "cadam", "prompt=a cube", "seed=2", "noise=strong", n=0, psnr=None, outcome="failed", message="no <b>"
    )
    return jobs.folder


@pytest.fixture(scope="session")
def bench_rows(bench) -> list[Row]:
    return read(bench)
