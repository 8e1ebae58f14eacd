"""Pages that show Gaussians, without a browser: what is in them, and what a stranger cannot put into them."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest
import torch
from snapshots import some_gaussians

from cadam3d.exporter.html import HtmlExporter
from cadam3d.viewer.pack import pack
from cadam3d.viewer.page import script, style, viewer_page

NODE = shutil.which("node")
HOSTILE = (
    "</title><script>alert(1)</script>",
    "\"'><img src=x onerror=alert(1)>",
    "{{ 7 * 7 }} {% raw %} ${7} `",
    "</script><!--<script>\u2028\u2029\x00\udcff",
)


class Parts(HTMLParser):
    """Collects the elements of a page, the text in each, and every attribute."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict]] = []
        self.texts: dict[str, str] = {}
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag):
        while self.open and self.open.pop() != tag:
            pass

    def handle_data(self, data):
        tag = self.open[-1] if self.open else ""
        self.texts[tag] = self.texts.get(tag, "") + data


def plain(text: str) -> str:
    return text.encode(errors="replace").decode().replace("\x00", "\ufffd")


@pytest.mark.parametrize("text", HOSTILE)
def test_a_title_is_text_whatever_it_contains(text):
    honest = Parts(viewer_page(b"", title="a cube", caption="a cube"))
    page = viewer_page(b"", title=text, caption=text)
    parts = Parts(page)
    assert parts.elements == honest.elements
    assert [plain(parts.texts[tag]) for tag in ("title", "h1")] == [plain(text)] * 2
    assert plain(text) in plain(parts.texts["p"])
    page.encode()


def test_the_policy_of_a_page_allows_its_own_script_and_style_and_nothing_else():
    page = viewer_page(b"", title="a cube")
    [policy] = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'"
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        [text] = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"
    assert rules.keys() == {
        *("default-src", "script-src", "style-src", "worker-src", "img-src", "base-uri", "form-action")
    }
    assert " style=" not in page
    assert not re.search(r"\son\w+=", page)


def test_a_page_refers_to_nothing_outside_of_it():
    page = viewer_page(pack(some_gaussians(5)), title="a cube")
    assert not re.search(r"https?:|//[a-z]|@import|url\(|fetch\(|XMLHttpRequest|WebSocket|\bimport\b", page)
    assert re.findall(r'(?:src|href)="([^"]*)"', page) == ["data:,"]


def test_the_sources_can_be_embedded_in_other_pages():
    assert "</" not in script().replace("=> {", "")
    assert "</" not in style()
    assert "globalThis.SplatView" in script()


def test_a_page_contains_the_snapshot():
    data = pack(some_gaussians(20, degree=1))
    page = viewer_page(data, title="a cube")
    [text] = re.findall(r'<script type="text/plain" id="snapshot">([^<]*)</script>', page)
    assert base64.b64decode(text) == data


# --- the exporter -----------------------------------------------------------------------------------------


def exporter(**settings):
    values = {"title": "a cube", "azimuth_deg": 10.0, "elevation_deg": -5.0, "background": None}
    return HtmlExporter(**values | {"count": None, "fraction": None, "simplify": "merge"} | settings)


def never_renders(cameras, background):
    raise AssertionError("the page draws the Gaussians itself")


@pytest.mark.parametrize(("title", "shown"), [("a cube", "a cube"), (None, "3D Gaussians")])
def test_the_exporter_writes_one_page_with_a_title(tmp_path, title, shown):
    made = exporter(title=title, background=[0.25, 0.5, 1.0])
    assert made.export(some_gaussians(5), never_renders, tmp_path) == [tmp_path / "viewer.html"]
    parts = Parts((tmp_path / "viewer.html").read_text(encoding="utf-8"))
    assert parts.texts["title"] == shown
    [options] = [json.loads(found["data-options"]) for _, found in parts.elements if "data-options" in found]
    assert options == {"camera": {"azimuth": 10.0, "elevation": -5.0}, "background": [0.25, 0.5, 1.0]}


# --- the script in Node, which needs no browser -----------------------------------------------------------


def in_node(program: str, *inputs: bytes) -> object:
    """Return what ``program`` prints as JSON; it has ``SplatView`` and the ``inputs`` as array buffers."""
    buffers = json.dumps([base64.b64encode(data).decode() for data in inputs])
    read = '(text) => Uint8Array.from(Buffer.from(text, "base64")).buffer'
    text = f"{script()}\nconst inputs = {buffers}.map({read});\n{program}"
    done = subprocess.run(
        [str(NODE), "-"], input=text, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.skipif(NODE is None, reason="needs Node")
def test_the_script_sorts_exactly_with_the_farthest_first():
    """The depths include equal ones, which keep the reverse order of rows, negative ones, zeros and NaN."""
    draw = torch.Generator().manual_seed(0)
    points = torch.randn(5000, 3, generator=draw)
    points[100:200] = points[0]
    points[200:210] *= 1e30
    points[210:220] *= 1e-30
    axis = torch.tensor([0.6, 0.0, -0.8])
    program = f"""const sorter = SplatView.makeSorter();
      sorter.load(new Float32Array(inputs[0]));
      const order = sorter.sort({axis.tolist()});
      const again = sorter.sort([0, 0, 1], order);
      sorter.load(new Float32Array([0, 0, 1, 0, 0, NaN, 0, 0, -1, 0, 0, 0]));
      console.log(JSON.stringify([[...sorter.sort({axis.tolist()}, again)].sort(), again.length]));
      """
    kept, length = in_node(program, points.numpy().tobytes())
    assert (kept, length) == ([0, 1, 2, 3], 5000)
    program = f"""const sorter = SplatView.makeSorter();
      sorter.load(new Float32Array(inputs[0]));
      console.log(JSON.stringify([...sorter.sort({axis.double().tolist()})]));"""
    order = torch.tensor(in_node(program, points.numpy().tobytes()))
    depths = (axis.double() * points.double()).sum(dim=1).float()
    assert torch.equal(order, depths.argsort(stable=True).flip(0))


@pytest.mark.skipif(NODE is None, reason="needs Node")
def test_the_script_reads_what_pack_writes():
    layers = {"snr": torch.logspace(-4, 4, 30), "größe": torch.arange(30.0)}
    program = """const read = SplatView.parse(inputs[0]);
      console.log(JSON.stringify({...read, records: read.records.length, rest: read.rest.length,
        layers: read.layers.map((layer) => ({...layer, levels: [...layer.levels]}))}));"""
    read = in_node(program, pack(some_gaussians(30, degree=2), layers))
    assert (read["count"], read["degree"], read["radius"]) == (30, 2, 1)
    assert (read["records"], read["rest"]) == (30 * 8, 30 * 8)
    assert [layer["name"] for layer in read["layers"]] == list(layers)
    assert [layer["isLog"] for layer in read["layers"]] == [True, False]
    assert read["layers"][1]["levels"][0] == 1
    assert read["layers"][1]["levels"][-1] == 255


@pytest.mark.skipif(NODE is None, reason="needs Node")
def test_the_script_refuses_every_snapshot_that_is_cut_or_claims_another_size():
    good = pack(some_gaussians(20, degree=1), {"snr": torch.arange(20.0)})
    bad = [good[:length] for length in range(0, len(good), 7)]
    bad += [good + b"\0", b"PK" + good[2:], b""]
    for offset in (8, 12, 16, 20):
        for value in (2, 255, 2**31, 2**32 - 1):
            bad.append(good[:offset] + value.to_bytes(4, "little") + good[offset + 4 :])
    bad.append(good[: 64 + 12] + (2**32 - 1).to_bytes(4, "little") + good[64 + 16 :])
    bad.append(good[:60] + b"\0\0\xc0\x7f" + good[64:])
    program = """console.log(JSON.stringify(inputs.map((data) => {
      try { SplatView.parse(data); return "accepted"; } catch (error) { return error.message; } })));"""
    messages = in_node(program, good, *bad)
    assert messages[0] == "accepted"
    assert all(message.startswith("This is not a snapshot that can be drawn: ") for message in messages[1:])
