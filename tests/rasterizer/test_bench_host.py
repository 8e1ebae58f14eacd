"""The script that measures the host time of the CUDA rasterizer runs, on tiny sizes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d.compiled.build import find_compiler

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "bench_host.py"
TINY = ("--count=10", "--size=9", "--views=2", "--steps=2", "--repeats=1")

pytestmark = pytest.mark.slow


def test_both_trees_and_both_ways_are_measured():
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    command = [sys.executable, str(SCRIPT), *TINY, "--base", str(ROOT), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found.keys() == {"base, exact", "base, ahead", "here, exact", "here, ahead"}
    for name, numbers in found.items():
        assert numbers["forward_us"] > 0
        assert numbers["backward_us"] > 0
        assert numbers["waits"] == ("exact" in name), "only one way waits for the device"
        assert 8 < numbers["launches"] < 40
        assert numbers["allocations"] < 20
