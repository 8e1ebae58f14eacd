"""The pages on a phone, 375 CSS pixels wide: text is legible, and no page scrolls sideways as a whole."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from cadam3d import report
from cadam3d.report.charts import WIDTH
from cadam3d.report.style import inline, styled, svg_of
from cadam3d.report.sweep_page import KINDS

PHONE = 375  # CSS pixels
LEGIBLE = 9  # CSS pixels
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CSS = (Path(report.__file__).parent / "templates" / "page.css").read_text(encoding="utf-8")
# Shows a page in a frame as wide as a phone, and then writes what it measures into the title.
FRAME = """<iframe id="phone" style="width: %dpx; height: 2000px"></iframe><script>
const frame = document.getElementById("phone");
frame.onload = () => {
  const page = frame.contentDocument;
  const texts = [...page.querySelectorAll("svg text")].filter((text) => text.getClientRects().length);
  const sizes = texts.map((text) => {
    const scale = text.getScreenCTM();
    return parseFloat(frame.contentWindow.getComputedStyle(text).fontSize) * Math.hypot(scale.a, scale.b);
  });
  document.title = [page.documentElement.scrollWidth, sizes.length, Math.min(...sizes)].join(" ");
};
frame.srcdoc = %s;
</script>"""


@pytest.mark.parametrize("name", KINDS)
def test_the_text_of_a_figure_is_legible_at_its_own_width(bench_results, name):
    with styled():
        figure = KINDS[name].draw(bench_results)
        if figure is None:
            pytest.skip("the results have no such figure")
        svg = svg_of(figure, name, dpi=100)
    sizes = [float(size) for size in re.findall(r"font(?:-size)?: (?:[a-z0-9 ]+ )?([\d.]+)px", svg)]
    # One unit of the drawing is one point, which is 4/3 of a pixel.
    assert min(sizes) * 4 / 3 >= LEGIBLE
    assert 'style="--width: ' in inline(svg)


def test_the_text_of_a_chart_is_legible_on_a_phone():
    [phone] = re.findall(r"@media \(max-width: 560px\) \{(.*)\}", CSS, re.DOTALL)
    [size] = map(float, re.findall(r"svg text \{ font-size: (\d+)px !important", phone))
    [width] = map(float, re.findall(r"\.charts svg \{ min-width: (\d+)px", phone))
    assert width <= PHONE
    assert size * width / WIDTH >= LEGIBLE


def measured(page: Path, folder: Path) -> tuple[float, int, float]:
    """Return the width of a page on a phone, and the number and the smallest size of texts in drawings."""
    content = json.dumps(page.read_text(encoding="utf-8")).replace("</", "<\\/")
    frame = folder / "frame.html"
    frame.write_text(FRAME % (PHONE, content), encoding="utf-8")
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'browser'}"]
    command = [str(BROWSER), *flags, "--virtual-time-budget=5000", "--dump-dom", frame.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    found = re.search(r"<title>([\d.]+) (\d+) ([\d.]+)</title>", done.stdout)
    if found is None:
        pytest.skip(f"the browser does not run here: {done.stderr[-200:]}")
    return float(found.group(1)), int(found.group(2)), float(found.group(3))


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_of_a_sweep_fits_a_phone(bench_page, tmp_path):
    width, texts, smallest = measured(bench_page, tmp_path)
    assert width <= PHONE
    assert texts > 50
    assert smallest >= LEGIBLE


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_of_a_run_fits_a_phone(tmp_path):
    metrics = [
        {"kind": "step", "step": i, "loss": 1e-4 * i, "num_gaussians": 2000 + i, "seconds": 0.1}
        for i in range(1, 3000, 100)
    ]
    summary = {"prompt": "a very long " + "word" * 30, "outcome": "finished", "note": "x" * 200}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in metrics))
    (tmp_path / "config.yaml").write_text("y" * 500)
    width, texts, smallest = measured(report.write_report(tmp_path), tmp_path)
    assert width <= PHONE
    assert texts > 10
    assert smallest >= LEGIBLE
