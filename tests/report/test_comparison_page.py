"""The examples of docs/sweeps.md run, and the page names every figure that a sweep can have."""

import re
from pathlib import Path

import pytest

from cadam3d.report.sweep_page import KINDS

PAGE = (Path(__file__).parent.parent.parent / "docs" / "sweeps.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda text: text.splitlines()[-1])
def test_the_examples_run(example, bench, tmp_path, monkeypatch):
    (tmp_path / "multirun").mkdir()
    (tmp_path / "multirun/mine").symlink_to(bench)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "sweeps.md", "exec"), {})


@pytest.mark.parametrize("name", KINDS)
def test_every_figure_is_explained(name):
    assert f"`{name}`" in PAGE
