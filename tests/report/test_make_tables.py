"""The rows, tables and figures of the docs."""

import shutil
import sys
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import make_tables
from make_tables import Drawing

from cadam3d.core.errors import UserError
from cadam3d.report.compare import compare, main_setting
from cadam3d.report.results import read

REPOSITORY = Path(__file__).parents[2]
PROMPTS = ("a cube", "a torus", "a cone", "a castle", "a tree", "a boat")


@pytest.fixture
def data(tmp_path):
    """Write rows in which cadam has half as many Gaussians as the baseline, and 1 dB more."""
    folder = tmp_path / "docs" / "data"
    folder.mkdir(parents=True)
    columns = "prompt,arm,densifier,densifier.tau_pos,outcome,grows,num_gaussians,psnr,cpu_seconds"
    lines = []
    for i, prompt in enumerate(PROMPTS):
        lines += [
            f"{prompt},none,none,,finished,False,300,{20 + i},1",
            f"{prompt},cadam,cadam,,finished,True,1000,{25 + i},3",
            f"{prompt},baseline,baseline,0.0002,finished,True,2000,{24 + i},2",
            f"{prompt},baseline,baseline,0.0004,finished,True,500,{23 + i},2",
        ]
    (folder / "mine.csv").write_text("\n".join([columns, *lines]))
    return folder


@pytest.fixture
def page(data):
    """Write a repository with one page, one table and one figure."""
    root = data.parents[1]
    (root / "docs" / "images").mkdir()
    drawings = {"mine": {"data": "mine", "kind": "settings"}, "curve": {"data": "mine", "kind": "figure"}}
    (data / "tables.yaml").write_text(yaml.safe_dump(drawings))
    marks = "".join(f"<!-- table: {name} -->\nold\n<!-- end -->\n" for name in drawings)
    (root / "docs" / "page.md").write_text(f"Text.\n{marks}More.\n")
    (root / "README.md").touch()
    return root / "docs" / "page.md"


def test_docs_and_data_agree(tmp_path):
    """Draw everything in a copy, which must change nothing."""
    shutil.copytree(REPOSITORY / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("site", "*.ipynb"))
    shutil.copy(REPOSITORY / "README.md", tmp_path)
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    make_tables.draw_all(tmp_path)
    assert [path.name for path, content in files.items() if path.read_bytes() != content] == []
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == files.keys()


def test_rows_of_a_sweep_compare_as_the_sweep_does(jobs, tmp_path):
    for i, prompt in enumerate(PROMPTS):
        where = (f"prompt={prompt}", "seed=0")
        jobs.add("cadam", *where, n=1000 + i, psnr=25.5 - i, commit="abc1234", machine="a CPU, 2 cores")
        for tau in (2e-4, 4e-4):
            jobs.add("baseline", f"densifier.tau_pos={tau}", *where, n=2000, psnr=24.123456)
    jobs.plan("cadam", ["densifier=cadam", "prompt=a cube", "seed=1"])
    file = tmp_path / "mine.csv"
    make_tables.collect(jobs.folder, file)
    lines = make_tables.with_results(make_tables.read_lines(file))
    found = []
    for results in ([line["result"] for line in lines], read(jobs.folder)):
        settings = [main_setting(results, arm) for arm in ("cadam", "baseline")]
        pair = compare(results, *settings)
        found.append((settings, pair.count, pair.difference(lambda each: each.numbers["psnr"])))
    assert found[0] == found[1]
    assert found[0][1].cells == len(PROMPTS)
    assert len(lines) == len(jobs.planned) - 1  # without the job that has not run
    assert (lines[0]["commit"], lines[0]["machine"]) == ("abc1234", "a CPU, 2 cores")
    # No folder of this machine, and none of a job.
    assert str(jobs.folder) not in file.read_text()
    assert not any(job.name in file.read_text() for job in jobs.planned)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (
            {"kind": "settings", "arms": ["cadam"]},
            "| `cadam` | 6 | 1,000 | 27.50 | +5.00 [+5.00, +5.00] | 3 |",
        ),
        (
            {"kind": "settings", "frontier": "baseline", "arms": ["baseline (tau_pos 0.0002)"]},
            "| `baseline (tau_pos 0.0002)` | 6 | 2,000 | 26.50 | +4.00 [+4.00, +4.00] | - | 2 |",
        ),
        (
            {"kind": "settings", "against": "cadam", "arms": ["none"]},
            "| `none` | 6 | 300 | 22.50 | -5.00 [-5.00, -5.00] | 1 |",
        ),
        (
            {"kind": "pairs", "pairs": [["cadam", "baseline"]]},
            "| `cadam` | `baseline (tau_pos 0.0002)` | 6 | -50.0 [-50.0, -50.0] "
            "| +1.00 [+1.00, +1.00] | +1 [+1, +1] |",
        ),
        (
            {"kind": "pivot", "by": ["prompt"], "columns": "setting", "cell": "{psnr:.1f}", "arms": ["none"]},
            "| a torus | 21.0 |",
        ),
        ({"kind": "rows", "by": ["arm", "prompt"], "where": {"prompt": ["a boat"]}}, "| cadam | a boat |"),
    ],
    ids=["settings", "frontier", "against", "pairs", "pivot", "rows"],
)
def test_a_table_shows_planted_numbers(data, more, line):
    assert line in make_tables.text_of("mine", Drawing(data="mine", **more), data, data / "x.md").splitlines()


def test_new_rows_change_the_table_and_the_figure(page):
    root, picture, rows = page.parents[1], page.parent / "images/curve.png", page.parent / "data/mine.csv"
    make_tables.draw_all(root)
    text, drawn = page.read_text(), picture.stat().st_mtime_ns
    assert text.startswith("Text.\n<!-- table: mine -->\n\n| setting |")
    assert text.endswith("![](images/curve.png)\n\n<!-- end -->\nMore.\n")
    make_tables.draw_all(root)
    assert picture.stat().st_mtime_ns == drawn
    rows.write_text(rows.read_text().replace("1000,25,", "1000,29,"))
    make_tables.draw_all(root)
    assert page.read_text() != text
    assert picture.stat().st_mtime_ns != drawn


def test_a_table_without_a_declaration_is_refused(page):
    page.write_text(page.read_text().replace("table: mine", "table: other"))
    with pytest.raises(UserError, match="mine, other"):
        make_tables.draw_all(page.parents[1])


def test_an_unknown_arm_is_named_with_those_that_exist(data):
    with pytest.raises(UserError, match="got cadma"):
        make_tables.text_of("mine", Drawing(data="mine", kind="settings", arms=["cadma"]), data, data)


def test_fits_are_compared_with_the_best_settings_of_a_strategy_at_equal_count():
    places = {"default": [(100, 20.0), (1000, 21.0), (10_000, 24.0)], "cadam": [(1000, 22.5), (90, 30.0)]}
    lines = [
        {"object": "horse", "strategy": name, "settings": i, "count": count, "psnr": psnr}
        for name, own in places.items()
        for i, (count, psnr) in enumerate(own)
    ]
    columns = {"by": ["strategy", "settings"], "columns": "object", "cell": "{above}"}
    table = make_tables.pivot_table(Drawing(data="fits", kind="pivot", frontier="default", **columns), lines)
    # The middle setting is below the line between the others, and nothing is extrapolated.
    assert [line["horse"] for line in table] == ["+0.00", "-1.00", "+0.00", "+0.50", "outside"]
