"""The report stands alone, says what happened, and believes nothing that a user typed."""

import base64
import re
from html.parser import HTMLParser
from importlib import resources

import pytest

from cadam3d.core.checks import UserError
from cadam3d.report import run as report
from cadam3d.report.run import write_report

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
VOID = {"meta", "img", "br", "path", "circle", "rect"}


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


def make(folder, summary=SUMMARY, metrics=(), config_text="steps: 300\n") -> Page:
    path = write_report(folder, summary=summary, metrics=list(metrics), config_text=config_text)
    assert path == folder / "report.html"
    return Page(path.read_text(encoding="utf-8"))


def chart_titles(folder) -> list[str]:
    return re.findall(r"<h3>([^<]*)</h3>", (folder / "report.html").read_text(encoding="utf-8"))


def test_the_numbers_that_people_ask_for_are_there(tmp_path):
    text = make(tmp_path).text
    for expected in ("a red torus", "finished", "1,234", "from 2,000", "24.52 dB", "SSIM 0.913", "82.4 KiB"):
        assert expected in text
    assert "1 min 15 s" in text
    assert "4.0 steps per second" in text
    assert "steps: 300" in text  # the configuration


@pytest.mark.parametrize("where", ["prompt", "outcome", "densifier", "warnings", "key", "config", "metric"])
def test_nothing_that_a_user_typed_becomes_markup(tmp_path, where):
    nasty = '<script>alert(1)</script><img src=x onerror="x">&amp;\'"'
    summary = dict(SUMMARY)
    if where in ("prompt", "outcome", "densifier"):
        summary[where] = nasty
    elif where == "warnings":
        summary[where] = [nasty]
    elif where == "key":
        summary[nasty] = nasty
    metrics = [step(1, **{nasty: 1.0}), refine(1, **{nasty: nasty})] if where == "metric" else []
    (tmp_path / "preview.png").write_bytes(b"png")
    page = make(tmp_path, summary, metrics, config_text=nasty if where == "config" else "")
    assert "script" not in page.tags
    assert page.tags.count("img") == 1
    assert not any(name.startswith("on") for _, name, _ in page.attributes)
    assert "alert(1)" in page.text


def test_the_page_stands_alone(tmp_path):
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
    assert "url(" not in html


def test_a_large_video_is_linked_not_embedded(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "EMBED_BYTES", 10)
    (tmp_path / "turntable.mp4").write_bytes(b"x" * 11)
    assert make(tmp_path).sources() == ["turntable.mp4"]
    (tmp_path / "turntable.mp4").write_bytes(b"x" * 10)
    assert make(tmp_path).sources()[0].startswith("data:video/mp4")


def test_only_files_that_exist_are_linked(tmp_path):
    (tmp_path / "asset.ply").write_bytes(b"ply")
    page = make(tmp_path)
    assert [value for tag, name, value in page.attributes if (tag, name) == ("a", "href")] == ["asset.ply"]


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
    growth = ["Gaussians", "Loss", "What each refinement did", "Opacity resets", "Who may grow"]
    assert chart_titles(tmp_path) == growth


STATISTICS = {
    "snr_p10": 0.1,
    "snr_p50": 0.4,
    "snr_p90": 1.3,
    "share_above_tau_SNR": 0.2,
    "drift_threshold": 1e-3,
    "drift_median": 2e-4,
    "age_median": 90.0,
}


@pytest.mark.parametrize("nested", [True, False])
def test_what_the_densifier_logs_is_drawn_nested_or_flat(tmp_path, nested):
    lines = [refine(n, **({"statistics": STATISTICS} if nested else STATISTICS)) for n in (100, 150)]
    make(tmp_path, metrics=lines)
    for title in ("Signal to noise of the gradients", "Who may grow", "Drift", "Median age"):
        assert title in chart_titles(tmp_path)


def test_the_baseline_is_drawn_from_its_own_statistics(tmp_path):
    statistics = {"tau_pos": 2e-4, "gradient_p10": 1e-5, "gradient_p50": 1e-4, "gradient_p90": 1e-3}
    page = make(tmp_path, metrics=[refine(n, statistics=statistics) for n in (100, 150)])
    assert "Screen-space gradients" in chart_titles(tmp_path)
    assert "tau_pos" in page.text
    assert "Signal to noise of the gradients" not in chart_titles(tmp_path)


def test_a_refinement_is_a_jump_at_its_step(tmp_path):
    make(tmp_path, metrics=[step(50), refine(100), step(100), {**step(150), "num_gaussians": 2080}])
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    hints = re.findall(r"<title>([\d.]+k) at step (\d+)</title>", html)
    assert hints == [("2k", "50"), ("2k", "100"), ("2k", "100"), ("2.08k", "100"), ("2.08k", "150")]


def test_each_refinement_is_a_row_of_the_table(tmp_path):
    page = make(tmp_path, metrics=[refine(100), refine(150, statistics={"snr_p50": 0.4}), step(200)])
    assert "All 2 refinements and resets" in page.text
    assert page.tags.count("tr") == 3
    assert "snr_p50" in page.text


def test_other_logged_numbers_get_a_chart_each(tmp_path):
    make(tmp_path, metrics=[step(1, t=0.5, grad_norm=3.0), step(2, t=0.4, grad_norm=None)])
    assert chart_titles(tmp_path)[-2:] == ["t", "grad_norm"]


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
def test_the_outcome_is_marked_by_how_bad_it_is(tmp_path, outcome, mood):
    page = make(tmp_path, {**SUMMARY, "outcome": outcome})
    assert ("span", "class", f"outcome {mood}") in page.attributes
    assert outcome.replace("_", " ") in page.text


def test_warnings_are_shown(tmp_path):
    assert "ffmpeg is missing" in make(tmp_path, {**SUMMARY, "warnings": ["ffmpeg is missing"]}).text


def test_light_and_dark_define_the_same_colours():
    css = (resources.files("cadam3d.report") / "page.css").read_text(encoding="utf-8")
    light, dark = css.split("@media (prefers-color-scheme: dark)")
    dark = dark[: dark.index("}")]
    assert set(re.findall(r"(--[\w-]+):", light)) == set(re.findall(r"(--[\w-]+):", dark))
    assert set(re.findall(r"var\((--[\w-]+)\)", css)) <= set(re.findall(r"(--[\w-]+):", css))


def test_a_folder_that_cannot_be_written_is_a_user_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"):
        write_report(tmp_path / "file", summary=SUMMARY, metrics=[], config_text="")
