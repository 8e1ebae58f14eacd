"""The paper's table of a sweep: its numbers equal numbers computed by hand, and its formats agree."""

import csv
import html
import json
import math
import re

import pytest
from declarations import all_numbers, declared

from cadam3d import report
from cadam3d.io import run_folder
from cadam3d.report import paper_formats
from cadam3d.report.compare import change, mean
from cadam3d.report.paper_formats import in_latex, latex, markdown
from cadam3d.report.paper_table import ALL, FIRST, columns, paper_table
from cadam3d.report.published import ROWS, SCORES, SIZES
from cadam3d.report.results import read

# The body of the paper's table 1, as its source has it.
TEX = r"""
    \multirow{2}{*}{\textbf{SDS}} & Baseline & 30.14 & -0.125 & 0.194 & 9.908 & 1067K & 46.4MB \\
     & \textbf{CAdam} & 29.95 & -0.028 & 0.185 & 9.643 & \textbf{143K} & \textbf{6.1MB} \\
    \multirow{2}{*}{\textbf{ISM}} & Baseline & 31.10 & 0.413 & 0.225 & 6.438 & 1706K & 110.6MB \\
     & \textbf{CAdam} & 28.48 & 0.518 & 0.225 & 8.167 & \textbf{81K} & \textbf{5.3MB} \\
    \multirow{2}{*}{\textbf{VFDS}} & Baseline & 29.88 & 0.436 & 0.235 & 7.183 & 3373K & 218.8MB \\
     & \textbf{CAdam} & 29.21 & 0.486 & 0.237  & 8.891 & \textbf{82K} & \textbf{5.3MB} \\
"""
PROTOCOL = {"name": "paper", "views": 12}
# Student's t at 97.5 % with two degrees of freedom, from a printed table.
T2 = 4.3027


def scored(clip: float, protocol=PROTOCOL, sha: str = "aa") -> dict:
    """Return the entries of a summary with a CLIP score."""
    record = {"protocol": protocol, "model": "clip", "weights_sha256": sha}
    return {"clip_score": clip, "measurements": {"clip_score": record}}


@pytest.fixture
def three(jobs):
    """Two objectives, three prompts, both densifiers; the baseline of the second lacks one prompt."""
    jobs.paper_table = True
    counts = {"a cube": (1000, 100), "a | torus": (2000, 300), "a tower": (3000, 200)}
    for guidance in ("sds", "vfds"):
        for prompt, (theirs, ours) in counts.items():
            where = (f"prompt='{prompt}'", f"guidance={guidance}")
            jobs.category = "Material" if prompt == "a cube" else "Structure & 100 %"
            if not (guidance == "vfds" and prompt == "a tower"):
                jobs.add("baseline", *where, n=theirs, psnr=20 + theirs / 1000, arm="baseline")
            else:
                jobs.plan("baseline", ["densifier=baseline", *where], "waits")
            jobs.add("cadam", *where, n=ours, psnr=20 + theirs / 1000 - 0.1 * ours / 100, arm="cadam")
    return jobs.folder


def table_of(folder):
    table = paper_table(read(folder))
    assert table is not None
    return table


def cell_of(table, row, name) -> tuple[str, str]:
    """Return a number of a row as text, and half the width of its interval."""
    cell = row[len(FIRST) + [number.name for number in table.numbers].index(name)]
    text, _, half = cell.partition(" ± ")
    return text, half.replace(",", "")


def row_of(table, objective, method, source="this sweep", category=ALL):
    wanted = (category, objective, method, source)
    [row] = [row for row in table.lines if (row[0], row[1].partition(",")[0], *row[2:4]) == wanted]
    return row


def test_the_published_numbers_are_those_of_the_source():
    clean = re.sub(r"\\multirow\{2\}\{\*\}|\\textbf|[{}]|\\\\", "", TEX)
    lines = [[cell.strip() for cell in line.split("&")] for line in clean.strip().splitlines()]
    objective = ""
    for line, row in zip(lines, ROWS, strict=True):
        objective = line[0] or objective
        assert (row.objective, row.arm) == (objective, line[1].lower())
        assert [row.texts[number.name] for number in (*SCORES, *SIZES)] == line[2:]


def test_means_and_intervals_equal_those_computed_by_hand(three):
    table = table_of(three)
    baseline, cadam = row_of(table, "SDS", "baseline"), row_of(table, "SDS", "cadam")
    text, half = cell_of(table, baseline, "num_gaussians")
    assert text == "2,000"
    # The standard deviation of 1000, 2000 and 3000 is 1000.
    assert float(half) == pytest.approx(T2 * 1000 / math.sqrt(3), abs=1)
    assert cell_of(table, cadam, "num_gaussians")[0] == "200"
    assert cell_of(table, baseline, "psnr")[0] == "22.00"
    assert cell_of(table, cadam, "psnr")[0] == "21.80"


def test_differences_are_paired_by_prompt(three):
    table = table_of(three)
    row = row_of(table, "SDS", "cadam - baseline")
    # PSNR differs by -0.1, -0.3 and -0.2 dB, with a standard deviation of 0.1 dB.
    text, half = cell_of(table, row, "psnr")
    assert text == "-0.20"
    assert float(half) == pytest.approx(T2 * 0.1 / math.sqrt(3), abs=0.006)
    # 600 of 6,000 Gaussians remain. The residuals 100 - 100, 300 - 200 and 200 - 300 have a deviation of 100.
    text, half = cell_of(table, row, "num_gaussians")
    assert text == "-90.0 %"
    assert float(half) == pytest.approx(100 * T2 * 100 / math.sqrt(3) / 2000, abs=0.06)


def test_missing_jobs_are_counted_and_left_out_of_pairs(three):
    table = table_of(three)
    difference = row_of(table, "VFDS", "cadam - baseline")
    assert [row_of(table, "VFDS", arm)[4] for arm in ("baseline", "cadam")] == ["2 of 3", "3"]
    assert difference[4] == "2 of 3"
    assert cell_of(table, difference, "num_gaussians")[0] == "-86.7 %"


def test_differences_of_a_number_use_the_seeds_in_which_both_have_it(jobs):
    jobs.paper_table = True
    for seed, (theirs, ours) in enumerate([(30.0, 31.0), (10.0, None)]):
        where = ("prompt=cube", "guidance=sds", f"seed={seed}")
        jobs.add("baseline", *where, n=100, psnr=20, arm="baseline", **scored(theirs))
        jobs.add("cadam", *where, n=50, psnr=20, arm="cadam", **({} if ours is None else scored(ours)))
    table = table_of(jobs.folder)
    row = row_of(table, "SDS", "cadam - baseline")
    assert cell_of(table, row, "clip_score")[0] == "+1.00"


def test_a_truth_that_eval_compares_with_does_not_replace_that_of_training(three):
    before = read(three)[0]
    numbers = json.loads((before.folder / run_folder.SUMMARY).read_text())
    evaluation = declared(numbers | {"psnr": 90.0, "clip_score": 30.0})
    (before.folder / run_folder.EVALUATION).write_text(json.dumps(evaluation))
    after = read(three)[0]
    assert after.numbers["psnr"] == before.numbers["psnr"]
    assert after.numbers["clip_score"] == 30.0


def test_seeds_are_averaged_within_a_prompt_first(jobs):
    jobs.paper_table = True
    for prompt, seeds in (("a cube", (10, 20, 60)), ("a torus", (90,))):
        for seed, psnr in enumerate(seeds):
            jobs.add("cadam", f"prompt={prompt}", f"seed={seed}", n=100, psnr=psnr, arm="cadam")
    table = table_of(jobs.folder)
    assert cell_of(table, row_of(table, "SDS", "cadam"), "psnr")[0] == "60.00"


def test_published_rows_keep_their_text_and_never_share_a_cell(three):
    table = table_of(three)
    published = row_of(table, "VFDS", "cadam", "published")
    shown = [cell_of(table, published, name)[0] for name in ("num_gaussians", "asset_mib", "psnr")]
    assert shown == ["82K", "5.3MB", "-"]
    assert not any(row[3] == "published" for row in table.lines if row[0] != ALL)
    assert any("another protocol" in note for note in table.notes)


def test_each_category_has_its_own_part(three):
    table = table_of(three)
    assert list(dict.fromkeys(row[0] for row in table.lines)) == [ALL, "Material", "Structure & 100 %"]
    material = row_of(table, "SDS", "baseline", category="Material")
    assert cell_of(table, material, "num_gaussians") == ("1,000", "")
    assert row_of(table, "SDS", "baseline", category="Structure & 100 %")[4] == "2"


def test_all_formats_show_the_same_cells(three):
    table = table_of(three)
    lines = [line.replace("\\|", "/") for line in markdown(table).splitlines() if line.startswith("| ")]
    shown = [[cell.replace("\\", "").strip() for cell in line[2:-2].split(" | ")] for line in lines]
    assert [shown[0], *shown[2:]] == [table.titles, *table.lines]
    paper_formats.write(three)
    with (three / run_folder.PAPER_TABLE_CSV).open(encoding="utf-8") as file:
        assert list(csv.reader(file)) == [table.titles, *table.lines]
    body = [line for line in latex(table).splitlines() if line.endswith(r"\\")]
    assert body == [" & ".join(map(in_latex, line)) + r" \\" for line in (table.titles, *table.lines)]


def test_the_latex_is_balanced_and_escapes_what_users_type(three):
    text = latex(table_of(three))
    assert r"Structure \& 100 \% &" in text
    code = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    bare = re.sub(r"\\[&%$#_{}\\]", "", code)
    depth = 0
    for character in bare:
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth >= 0
    assert depth == 0
    assert bare.count("$") % 2 == 0
    assert not set("%#^~|_±↑↓") & set(bare)
    begun, ended = re.findall(r"\\begin\{(\w+)\}", code), re.findall(r"\\end\{(\w+)\}", code)
    assert sorted(begun) == sorted(ended)
    for tabular in re.findall(r"\\begin\{tabular\}\{(\w+)\}\n(.*?)\\end\{tabular\}", code, re.DOTALL):
        rows = [line for line in tabular[1].splitlines() if line.endswith(r"\\")]
        assert {len(re.findall(r"(?<!\\)&", line)) + 1 for line in rows} == {len(tabular[0])}


def test_the_page_of_the_sweep_shows_the_table_with_escaped_text(three):
    plan = json.loads((three / run_folder.JOBS).read_text())
    plan["jobs"][0]["category"] = "<b>"
    (three / run_folder.JOBS).write_text(json.dumps({**plan, "figures": ["no such"]}))
    page = report.write_sweep(three).read_text(encoding="utf-8")
    assert "&lt;b&gt;</td>" in page
    for row in table_of(three).lines:
        assert all(html.escape(cell) in page for cell in row)


def test_columns_are_the_numbers_that_every_row_has(jobs):
    for arm in ("baseline", "cadam"):
        more = {"iou": 0.5} if arm == "cadam" else {}
        jobs.add(arm, n=100, psnr=20, arm=arm, ssim_turned=0.8, psnr_turned=21.0, **scored(30.0), **more)
    results = read(jobs.folder)
    assert [number.name for number in columns(results)] == [
        "clip_score",
        "psnr_turned",
        "num_gaussians",
        "asset_mib",
    ]
    assert all(heading in table_of(jobs.folder).titles for heading in ("CLIP score ↑", "Gaussians ↓"))
    for number in (*SCORES, *SIZES):
        declared_number = all_numbers()[number.name]
        assert (number.heading, number.digits) == (declared_number.heading, declared_number.digits)


@pytest.mark.parametrize(
    "other",
    [
        scored(30, {"name": "t3bench", "views": 12}),
        scored(30, {**PROTOCOL, "views": 8}),
        scored(30, sha="bb"),
        {"clip_score": 30.0, "measurements": {}},
    ],
)
def test_numbers_of_different_methods_are_not_put_into_one_table(jobs, other):
    jobs.add("baseline", n=100, psnr=20, arm="baseline", **scored(31.0))
    folder = jobs.add("cadam", n=10, psnr=20, arm="cadam", **scored(30.0))
    assert table_of(jobs.folder).numbers[0].name == "clip_score"
    summary = json.loads((folder / run_folder.SUMMARY).read_text())
    (folder / run_folder.SUMMARY).write_text(json.dumps({**summary, **other}))
    table = table_of(jobs.folder)
    names = [number.name for number in table.numbers]
    assert "clip_score" not in names
    assert "num_gaussians" in names
    assert any("clip_score" in note for note in table.notes)
    assert "31.00" not in markdown(table) + latex(table)


def test_scores_of_one_table_belong_to_one_protocol(jobs):
    for arm in ("baseline", "cadam"):
        both = scored(30.0)
        both["niqe"] = 5.0
        both["measurements"]["niqe"] = {"protocol": {"name": "t3bench", "views": 12}, "weights_sha256": "cc"}
        jobs.add(arm, n=100, psnr=20, arm=arm, **both)
    table = table_of(jobs.folder)
    assert "clip_score" in [number.name for number in table.numbers]
    assert "niqe" not in [number.name for number in table.numbers]
    assert any("niqe" in note for note in table.notes)


def test_settings_that_come_with_prompts_do_not_split_the_rows(jobs):
    for prompt, negative in (("a cube", "blurry"), ("a torus", "ugly")):
        jobs.add("cadam", f"prompt={prompt}", f"negative_prompt={negative}", n=10, psnr=20, arm="cadam")
    rows = [row for row in table_of(jobs.folder).lines if row[3] == "this sweep"]
    assert [(row[1], row[4]) for row in rows] == [("SDS", "2")]


def test_eval_replaces_the_numbers_of_training(jobs):
    jobs.paper_table = True
    folder = jobs.add("cadam", n=10, psnr=20, arm="cadam", **scored(30.0))
    evaluation = declared({"num_gaussians": 10, **scored(25.0, {"name": "t3bench"})})
    (folder / run_folder.EVALUATION).write_text(json.dumps(evaluation))
    table = table_of(jobs.folder)
    assert cell_of(table, row_of(table, "SDS", "cadam"), "clip_score")[0] == "25.00"
    assert any("protocol=t3bench" in note for note in table.notes)
    # An evaluation of another asset does not count.
    (folder / run_folder.EVALUATION).write_text(json.dumps({**evaluation, "num_gaussians": 11}))
    table = table_of(jobs.folder)
    assert cell_of(table, row_of(table, "SDS", "cadam"), "clip_score")[0] == "30.00"


def test_a_sweep_has_a_table_only_if_its_grid_asks_for_it(jobs):
    jobs.add("cadam", n=10, psnr=20, arm="cadam")
    assert paper_formats.write(jobs.folder) == ""
    assert not (jobs.folder / run_folder.PAPER_TABLE_CSV).exists()


def test_recipes_are_objectives(jobs):
    jobs.paper_table = True
    recipes = {"gaussiandreamer": "sds_gaussiandreamer", "flowdreamer": "vfds_flowdreamer"}
    for recipe, objective in recipes.items():
        jobs.add("cadam", f"experiment={recipe}", n=10, psnr=20, arm="cadam", guidance=objective)
    labels = [row[1] for row in table_of(jobs.folder).lines if row[3] == "this sweep"]
    assert labels == ["SDS, gaussiandreamer", "VFDS, flowdreamer"]


def test_a_single_prompt_has_no_interval_and_no_pair_no_difference():
    assert mean({"a": 3.0}) is not None
    assert mean({"a": 3.0}).half is None  # pyright: ignore[reportOptionalMemberAccess]
    assert mean({}) is None
    assert change({}, {}) is None
    assert change({"a": 1.0}, {"a": 0.0}) is None
