"""The script that prints what the densifiers do on learned priors: known differences give known tables."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import learned_study

PROMPTS = [f"object {i}" for i in range(6)]
# The count and the PSNR of each setting, above those of the prompt.
ARMS = {
    "none": (100.0, 0.0),
    "baseline": (1000.0, 1.0),
    "cadam": (200.0, 1.25),
    "cadam_no_snr": (250.0, 1.0),
}


@pytest.fixture
def printed(jobs, capsys) -> str:
    """What the script prints of two priors, one of which is half a decibel worse with CAdam."""
    for i, prompt in enumerate(PROMPTS):
        for prior in ("one", "two"):
            where = (f"prompt={prompt}", f"prior={prior}", "seed=0")
            for arm, (count, psnr) in ARMS.items():
                worse = 0.5 if (prior, arm) == ("two", "cadam") else 0.0
                folder = jobs.add(arm, *where, n=count, psnr=10 + i + psnr - worse, arm=arm)
                if arm == "cadam":
                    numbers = {"snr_p10": 0.1, "snr_p50": 0.2, "snr_p90": 0.4, "share_above_tau_SNR": 0.5}
                    line = {
                        "kind": "refine",
                        "step": 25,
                        "before": 100,
                        "selected": 10,
                        "statistics": numbers,
                    }
                    (folder / "metrics.jsonl").write_text(json.dumps(line) + "\n")
            jobs.add(
                "baseline", "densifier.tau_pos=0.1", *where, n=150, psnr=10.5 + i, arm="baseline", iou=0.8
            )
    learned_study.main([str(jobs.folder)])
    return capsys.readouterr().out


def test_differences_are_paired_within_cells_and_have_intervals_over_prompts(printed):
    one = "| `cadam_no_snr` over `cadam` | `one` | 6 | -0.25 [-0.25, -0.25], p = 0.031 |"
    two = "| `cadam_no_snr` over `cadam` | `two` | 6 | +0.25 [+0.25, +0.25], p = 0.031 |"
    assert one in printed
    assert two in printed
    assert f"{one} +25.0 [+25.0, +25.0], p = 0.031 |" in printed


def test_every_setting_has_its_medians_of_count_and_gain(printed):
    assert "| cadam | 6 | 200 | 13.75 | +1.25 |" in printed
    assert "| baseline (tau_pos 0.1) | 6 | 150 | 13.00 | +0.50 |" in printed


def test_the_frontier_and_the_course_of_the_snr_are_shown(printed):
    above = [line for line in printed.splitlines() if "`one`" in line and " of 6" in line]
    assert any(line.startswith("| `cadam` |") and "6 of 6" in line for line in above)
    assert "| `one` | 25 | 0.10 | 0.20 | 0.40 | 50 % | 10.0 % |" in printed
