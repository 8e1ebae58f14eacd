"""The page of a run is self-contained, complete, and safe against whatever a user typed."""

import ast
import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from declarations import declared

from cadam3d import report
from cadam3d.build import component
from cadam3d.core.chart import Chart, Curve
from cadam3d.core.palette import css
from cadam3d.io.declarations import write_declarations
from cadam3d.report import run_page, write_report
from cadam3d.report.pages import TEMPLATES
from cadam3d.settings.compose import compose

SUMMARY = {
    "prompt": "a red torus",
    "outcome": "finished",
    "steps": 300,
    "steps_asked": 300,
    "seconds": 75.0,
    "num_gaussians_initial": 2000,
    "num_gaussians": 1234,
    "asset_bytes": 84_400,
    "bytes_per_gaussian": 68.4,
    "psnr": 24.517,
    "ssim": 0.913,
    "densifier": "cadam",
    "seed": 3,
}
VOID = {"meta", "img", "br", "path", "circle", "rect", "use"}


def step(number, **more):
    return {
        "kind": "step",
        "step": number,
        "loss": 1.0 / number,
        "num_gaussians": 2000,
        "seconds": 0.1,
        **more,
    }


def refine(number, **more):
    counts = {
        "before": 2000,
        "after": 2080,
        "selected": 100,
        "cloned": 60,
        "split": 40,
        "pruned": 20,
        "reset": 0,
    }
    return {"kind": "refine", "step": number, **counts, **more}


class Page(HTMLParser):
    """Tags, attributes and text of a page; fails if an element is not closed where it should be."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open, self.tags, self.attributes, self.texts = [], [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *attr) for attr in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def sources(self) -> list[str]:
        return [value for _, name, value in self.attributes if name == "src"]


def make(folder, summary=SUMMARY, metrics=(), config_text="steps: 300\n", charts=()) -> Page:
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in metrics))
    (folder / "config.yaml").write_text(config_text)
    write_declarations(folder, charts)
    path = write_report(folder)
    assert path == folder / "report.html"
    return Page(path.read_text(encoding="utf-8"))


def chart_titles(folder) -> list[str]:
    return re.findall(r"<h3>([^<]*)</h3>", (folder / "report.html").read_text(encoding="utf-8"))


def test_the_most_important_numbers_are_shown(tmp_path):
    text = make(tmp_path, declared(SUMMARY)).text
    for expected in ("a red torus", "finished", "1,234", "24.52 dB", "0.08 MiB"):
        assert expected in text
    assert "0:01:15" in text
    assert "steps: 300" in text  # the configuration


@pytest.mark.parametrize("where", ["prompt", "densifier", "warnings", "key", "config", "metric", "chart"])
def test_nothing_that_a_user_typed_becomes_markup(tmp_path, where):
    nasty = '<script>alert(1)</script><img src=x onerror="x">&amp;\'"'
    summary = dict(SUMMARY)
    if where in ("prompt", "densifier"):
        summary[where] = nasty
    elif where == "warnings":
        summary[where] = [nasty]
    elif where == "key":
        summary[nasty] = nasty
    metrics = [step(1, **{nasty: 1.0}), refine(1, **{nasty: 2.0})] if where == "metric" else []
    charts = []
    if where == "chart":
        metrics = [step(1), refine(1, **{nasty: 1.0}), refine(2, **{nasty: 2.0})]
        curves = (Curve(key=nasty, label=nasty), Curve(key="selected", label=nasty, is_threshold=True))
        charts = [Chart(title=nasty, caption=nasty, curves=curves, band=(nasty, "before"), band_label=nasty)]
    (tmp_path / "preview.png").write_bytes(b"png")
    page = make(tmp_path, summary, metrics, nasty if where == "config" else "", charts)
    assert "script" not in page.tags
    assert page.tags.count("img") == 1
    assert not any(name.startswith("on") for _, name, _ in page.attributes)
    assert "alert(1)" in page.text


def test_the_page_is_self_contained(tmp_path):
    (tmp_path / "preview.png").write_bytes(b"picture")
    (tmp_path / "turntable.mp4").write_bytes(b"video")
    page = make(tmp_path, metrics=[step(1), refine(1), step(2)])
    encoded = [source.split(",")[1] for source in page.sources()]
    assert sorted(base64.b64decode(code) for code in encoded) == [b"picture", b"video"]
    assert all(source.startswith("data:") for source in page.sources())
    assert "link" not in page.tags
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "http" not in html
    assert "@import" not in html
    assert not re.findall(r"url\((?!#)", html)  # only references within the page


def test_a_large_video_is_linked_not_embedded(tmp_path, monkeypatch):
    monkeypatch.setattr(run_page, "EMBED_BYTES", 10)
    (tmp_path / "turntable.mp4").write_bytes(b"x" * 11)
    assert make(tmp_path).sources() == ["turntable.mp4"]
    (tmp_path / "turntable.mp4").write_bytes(b"x" * 10)
    assert make(tmp_path).sources()[0].startswith("data:video/mp4")


@pytest.mark.parametrize(
    "summary",
    [{}, {"prompt": None}, {"num_gaussians": None, "psnr": float("nan"), "seconds": 0.0, "steps": 0}],
)
@pytest.mark.parametrize("metrics", [[], [{}], [{"kind": "step"}], [{"kind": "refine", "statistics": None}]])
def test_whatever_is_missing_is_left_out(tmp_path, summary, metrics):
    page = make(tmp_path, summary, metrics, config_text="")
    assert "nan" not in page.text.lower()
    assert "None" not in page.text


def test_each_chart_appears_when_its_numbers_do(tmp_path):
    make(tmp_path)
    assert chart_titles(tmp_path) == []
    make(tmp_path, metrics=[step(1), step(2)])
    assert chart_titles(tmp_path) == ["Gaussians", "Loss"]
    make(tmp_path, metrics=[step(1), refine(2), refine(4, reset=7)])
    assert chart_titles(tmp_path) == [
        *("Gaussians", "Loss", "Refinements", "Opacity resets"),
    ]


# A densifier and an objective that exist only here: the reports know no statistic by name.
WOBBLE = Chart(
    title="Wobble of the Gaussians",
    caption="How much they wobble.",
    curves=(Curve(key="wobble_p50", label="median"), Curve(key="tau_W", label="tau_W", is_threshold=True)),
    band=("wobble_p10", "wobble_p90"),
    band_label="10 to 90 %",
)
HEAT = Chart(title="Heat of the objective", caption="How hot it is.", curves=(Curve(key="heat"),))
STATISTICS = {"wobble_p10": 0.1, "wobble_p50": 0.4, "wobble_p90": 1.3, "tau_W": 0.5}


@pytest.mark.parametrize("nested", [True, False])
def test_a_declared_chart_is_drawn_from_nested_or_flat_statistics(tmp_path, nested):
    lines = [refine(n, **({"statistics": STATISTICS} if nested else STATISTICS)) for n in (100, 150)]
    page = make(tmp_path, metrics=lines, charts=[WOBBLE])
    assert "Wobble of the Gaussians" in chart_titles(tmp_path)
    for expected in ("How much they wobble.", "median", "tau_W", "10 to 90 %"):
        assert expected in page.text


def test_a_declared_chart_of_the_objective_is_drawn_from_its_log(tmp_path):
    make(tmp_path, metrics=[step(1, heat=3.0), step(2, heat=4.0)], charts=[WOBBLE, HEAT])
    assert chart_titles(tmp_path) == ["Gaussians", "Loss", "Heat of the objective"]
    assert "<h2>Objective</h2>" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h2>Densifier</h2>" not in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("densifier", ["cadam", "baseline"])
def test_the_reports_know_no_statistic_and_no_score_by_name(densifier):
    made = component(compose([f"densifier={densifier}", "prompt=any"]).densifier)
    state = made.init_state(3, torch.device("cpu"))
    # The level of noise is a setting of sweeps that has the same name as a score.
    names = {*made.statistics(state, 1), *made.scores(state)} - {"noise"}
    assert len(names) > 3
    texts = {
        node.value
        for path in Path(report.__file__).parent.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant)
    }
    assert not names & texts


def test_each_refinement_is_a_row_of_the_table(tmp_path):
    page = make(tmp_path, metrics=[refine(100), refine(150, statistics={"wobble": 0.4}), step(200)])
    assert "All 2 refinements and resets" in page.text
    assert page.tags.count("tr") == 3
    assert "wobble" in page.text


@pytest.mark.parametrize(
    ("outcome", "mood"),
    [
        ("finished", "good"),
        ("interrupted", "warn"),
        ("out_of_memory", "warn"),
        ("vanished", "bad"),
        ("failed", "bad"),
    ],
)
def test_the_colour_of_the_outcome_follows_its_severity(tmp_path, outcome, mood):
    page = make(tmp_path, {**SUMMARY, "outcome": outcome})
    assert ("span", "class", f"outcome {mood}") in page.attributes
    assert outcome.replace("_", " ") in page.text


@pytest.mark.parametrize("style", [css(), (TEMPLATES / "page.css").read_text(encoding="utf-8")])
def test_light_and_dark_define_the_same_colours(style):
    light, dark = style.split("@media (prefers-color-scheme: dark)")
    light, dark = light[light.index(":root") :], dark[: dark.index("}")]
    assert set(re.findall(r"(--[\w-]+):", light)) == set(re.findall(r"(--[\w-]+):", dark)) != set()


def test_a_page_stays_small_and_its_identifiers_differ(tmp_path):
    metrics = [step(n, t=0.5) for n in range(1, 2000, 10)] + [refine(n) for n in range(50, 2000, 50)]
    make(tmp_path, metrics=metrics)
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(html) < 250_000
    ids = re.findall(r' id="([^"]*)"', html)
    assert len(ids) == len(set(ids)) > 0
