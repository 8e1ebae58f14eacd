"""The viewer in Chromium: the pictures are ours, mouse and touch turn the object, and nothing is fetched.

These tests skip themselves without playwright or without Chromium. They share one browser.
"""

import base64
import io
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from chromium import headless, watch
from PIL import Image
from snapshots import some_gaussians

from cadam3d.core.cameras import orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.run_folder import SNAPSHOTS, snapshot_name
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.report import write_report
from cadam3d.viewer.pack import pack
from cadam3d.viewer.page import script, style, viewer_page

SIZE = 480  # pixels
DISTANCE, FOV = 2.6, 45.0
# A page with views of different options and no policy.
BARE = """<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,"><style>%s</style>
<div id="view" style="width: 240px; height: 240px"></div><div id="bar"></div><script>%s
const bytes = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0)).buffer;
const element = document.getElementById("view");
const make = (options) => new SplatView(element, options);
const failure = (promise) => promise.then(() => "loaded", (error) => error.message);
</script>"""


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with headless() as started:
        yield started


@pytest.fixture
def visit(browser, tmp_path):
    """Return a function that opens a page; the test fails if a page reports an error or requests anything."""
    problems, contexts = [], []

    def open_page(html: str, *, width=SIZE, height=SIZE, before="", **options):
        path = tmp_path / f"page{len(contexts)}.html"
        path.write_text(html, encoding="utf-8")
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        page = context.new_page()
        watch(page, problems)
        page.add_init_script(before)
        page.goto(path.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not problems


def shown(visit, packed: bytes, *, title="a cube", **options):
    """Return a page of one file that has drawn its snapshot."""
    page = visit(viewer_page(packed, title=title, background=[1, 1, 1]), **options)
    page.wait_for_selector("#loading", state="detached")
    return page


def bare(visit, packed: bytes | None = None, options="{}", **more):
    """Return a page with an element of 240 pixels, and in ``view`` a view of ``packed``."""
    page = visit(BARE % (style(), script()), **more)
    page.evaluate(f"() => {{ globalThis.view = make({options}); }}")
    if packed is not None:
        load(page, packed)
    return page


def load(page, packed: bytes) -> str:
    return page.evaluate("(text) => failure(view.load(bytes(text)))", base64.b64encode(packed).decode())


def picture(page) -> np.ndarray:
    """Return the picture that the view draws now, as floats in [0, 1]; it waits until the order is right."""
    page.wait_for_timeout(150)
    text = page.evaluate(
        """() => view.snapshot().then((blob) => new Promise((done) => {
          const reader = new FileReader();
          reader.onload = () => done(reader.result);
          reader.readAsDataURL(blob);
        }))"""
    )
    data = base64.b64decode(text.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255


def rendered(gaussians: Gaussians, azimuth: float, elevation: float, background) -> np.ndarray:
    angles = (torch.tensor([azimuth]), torch.tensor([elevation]))
    cameras = orbit(*angles, torch.tensor([DISTANCE]), torch.tensor([FOV]), SIZE, SIZE)
    with torch.no_grad():
        rgb = ReferenceRasterizer().render(gaussians, cameras, torch.tensor([background])).rgb
    return rgb[0].clamp(0, 1).numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-12))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_picture_is_that_of_our_rasterizer(visit, degree):
    gaussians = some_gaussians(400, degree=degree)
    page = shown(visit, pack(gaussians))
    page.evaluate("() => document.querySelector('footer').remove()")
    place = "([camera, background]) => { Object.assign(view, {camera, background}); }"
    views = [(30.0, 20.0, [1.0, 1.0, 1.0])]
    views += [(215.0, -40.0, [0.2, 0.4, 0.6])] if degree in (0, 3) else []
    for azimuth, elevation, background in views:
        camera = {"azimuth": azimuth, "elevation": elevation, "distance": DISTANCE, "fov": FOV}
        page.evaluate(place, [camera, background])
        drawn, expected = picture(page), rendered(gaussians, azimuth, elevation, background)
        assert psnr(drawn, expected) >= 50
        assert psnr(drawn[::-1], expected) < 30
        assert psnr(drawn[:, ::-1], expected) < 30
        if degree:
            flat = rendered(replace(gaussians, sh=gaussians.sh[:, :1]), azimuth, elevation, background)
            assert psnr(drawn, flat) < 35


@pytest.mark.slow
def test_a_mouse_turns_zooms_and_moves_the_object(visit):
    page = shown(visit, pack(some_gaussians(100)))
    first, before = picture(page), page.evaluate("() => view.camera")
    page.mouse.move(200, 150)
    page.mouse.down()
    page.mouse.move(300, 170, steps=4)
    page.mouse.up()
    turned = page.evaluate("() => view.camera")
    # To the right, the camera goes to the left around the object; downwards, it rises.
    assert turned["azimuth"] == pytest.approx((before["azimuth"] - 40) % 360)
    assert turned["elevation"] == pytest.approx(before["elevation"] + 8)
    assert psnr(first, picture(page)) < 30
    page.mouse.wheel(0, -200)
    page.wait_for_function("() => view.camera.distance < 2.5")
    for hold in ("Shift", None):
        page.evaluate("() => { view.camera = {target: [0, 0, 0]}; }")
        if hold:
            page.keyboard.down(hold)
        page.mouse.down(button="left" if hold else "right")
        page.mouse.move(300, 70, steps=2)
        page.mouse.up(button="left" if hold else "right")
        page.mouse.move(300, 170)
        if hold:
            page.keyboard.up(hold)
        # Moved up, the object is above the centre of the picture, so the camera looks at a point below it.
        moved = page.evaluate("() => view.camera")
        assert moved["target"][2] < -0.2
        assert moved["azimuth"] == turned["azimuth"]
    page.keyboard.press("r")
    assert page.evaluate("() => view.camera") == before


@pytest.mark.slow
def test_keys_turn_zoom_rotate_and_choose_layers(visit):
    page = shown(visit, pack(some_gaussians(50), {"snr": torch.arange(50.0)}))
    before = page.evaluate("() => view.camera")
    for key in ("ArrowLeft", "ArrowUp", "+", "4"):
        page.keyboard.press(key)
    after = page.evaluate("() => ({...view.camera, layer: view.layer, legend: view.legend()})")
    assert after["azimuth"] < before["azimuth"]
    assert after["elevation"] > before["elevation"]
    assert after["distance"] < before["distance"]
    assert (after["layer"], after["legend"]["isLog"]) == ("snr", False)
    assert page.locator("select").input_value() == "snr"
    page.keyboard.press("Space")
    azimuth = page.evaluate("() => view.camera.azimuth")
    page.wait_for_function("(azimuth) => Math.abs(view.camera.azimuth - azimuth) > 0.5", arg=azimuth)
    assert page.locator("button[aria-pressed=true]", has_text="Rotate").count() == 1
    page.keyboard.press("r")
    assert not page.evaluate("() => view.rotating")


@pytest.mark.slow
def test_fingers_turn_zoom_and_move_the_object_on_a_phone(visit):
    options = {"has_touch": True, "is_mobile": True, "device_scale_factor": 3}
    page = shown(visit, pack(some_gaussians(50)), width=390, height=844, **options)
    session = page.context.new_cdp_session(page)

    def touch(kind, *points):
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    before = page.evaluate("() => view.camera")
    touch("touchStart", (100, 300))
    touch("touchMove", (150, 300))
    touch("touchEnd")
    turned = page.evaluate("() => view.camera")
    assert turned["azimuth"] == pytest.approx((before["azimuth"] - 20) % 360)
    touch("touchStart", (100, 300), (200, 300))
    touch("touchMove", (50, 300), (250, 300))
    touch("touchEnd")
    pinched = page.evaluate("() => view.camera")
    assert pinched["distance"] == pytest.approx(before["distance"] / 2, rel=0.02)
    assert pinched["azimuth"] == turned["azimuth"]
    touch("touchStart", (100, 300), (200, 300))
    touch("touchMove", (100, 400), (200, 400))
    touch("touchEnd")
    assert page.evaluate("() => view.camera.target[2]") > 0.1
    # No more pixels than a picture needs.
    assert page.evaluate("() => document.querySelector('canvas').width") <= 2 * 390


@pytest.mark.slow
def test_a_page_fits_a_phone_whatever_its_title_and_its_layers_are_called(visit):
    layers = {"x" * 200: torch.arange(20.0), "</select><script>": torch.logspace(-9, 9, 20)}
    title = "</script><script>alert(1)</script> " + "word" * 60
    page = shown(visit, pack(some_gaussians(20), layers), title=title, width=390, height=844)
    page.keyboard.press("5")
    assert page.evaluate("() => view.layers") == ["rgb", "depth", "opacity", *layers]
    assert page.evaluate("() => view.legend().isLog")
    assert page.title() == title
    wide = """() => [...document.querySelectorAll("*")].filter((part) => !part.closest("select")
      && part.getBoundingClientRect().right > 390.5).map((part) => part.outerHTML.slice(0, 80))"""
    assert page.evaluate(wide) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") == 390
    # The picture keeps most of the screen.
    assert page.evaluate("() => document.querySelector('canvas').clientHeight") > 500


@pytest.mark.slow
def test_new_snapshots_replace_old_ones_and_keep_the_camera(visit):
    counting = """for (const [name, change] of [["createTexture", 1], ["deleteTexture", -1]]) {
      const original = WebGL2RenderingContext.prototype[name];
      WebGL2RenderingContext.prototype[name] = function (...all) {
        globalThis.textures = (globalThis.textures ?? 0) + change;
        return original.apply(this, all);
      };
    }"""
    page = bare(visit, pack(some_gaussians(10)), before=counting)
    page.evaluate("() => { view.camera = {azimuth: 77, distance: 2.2}; view.show('snr'); }")
    counts = [3, 0, 5000, 1, 128, 129, 0, 2, 4096, 4097]
    textures = set()
    for i, count in enumerate(counts * 2):
        layers = {"snr": torch.arange(float(count))} if i % 2 else {}
        assert load(page, pack(some_gaussians(count, degree=i % 4), layers)) == "loaded"
        state = page.evaluate("() => [view.count, view.camera.azimuth, view.camera.distance, view.layer]")
        assert state == [count, 77, 2.2, "snr"]
        textures.add(page.evaluate("() => textures"))
    assert max(textures) - min(textures) <= 1  # that of a layer
    last = picture(page)
    assert (last < 0.9).any()
    # The newest of several at once is shown, and all promises are kept.
    texts = [base64.b64encode(pack(some_gaussians(n))).decode() for n in (7, 8, 9)]
    page.evaluate("(texts) => Promise.all(texts.map((text) => view.load(bytes(text))))", texts)
    assert page.evaluate("() => view.count") == 9
    page.evaluate("() => view.destroy()")
    assert page.evaluate("() => element.childElementCount") == 0


@pytest.mark.slow
def test_a_layer_colours_each_gaussian_by_its_value(visit):
    gaussians = Gaussians(
        means=torch.tensor([[0.0, -0.5, 0], [0, 0, 0], [0, 0.5, 0]]),
        log_scales=torch.full((3, 3), -2.0),
        quats=torch.eye(4)[:1].repeat(3, 1),
        opacity_logits=torch.full((3,), 20.0),
        sh=torch.zeros(3, 1, 3),
    )
    page = bare(visit, pack(gaussians, {"snr": torch.tensor([1.0, 3.0, torch.nan])}))
    page.evaluate(
        "() => { view.camera = {azimuth: 0, elevation: 0, distance: 3, fov: 40}; view.show('snr'); }"
    )
    drawn = picture(page)
    scale = 120 / math.tan(math.radians(20)) / 3
    colors = [drawn[120, round(120 + scale * y)] for y in (-0.5, 0, 0.5)]
    # On a white background, which shows through by a hundredth.
    assert np.allclose(colors[0], [0.22, 0.13, 0.44], atol=0.03)
    assert np.allclose(colors[1], [0.99, 0.91, 0.35], atol=0.03)
    assert np.allclose(colors[2], [0.55, 0.55, 0.55], atol=0.03)
    assert page.evaluate("() => view.legend()") == {
        "low": pytest.approx(1.02),
        "high": pytest.approx(2.98),
        "isLog": False,
    }
    page.evaluate("() => view.show('depth')")
    assert page.evaluate("() => view.legend()") == {
        "low": pytest.approx(2),
        "high": pytest.approx(4),
        "isLog": False,
    }
    page.evaluate("() => view.show('rgb')")
    assert page.evaluate("() => view.legend()") is None
    assert np.allclose(picture(page)[120, 120], 0.5, atol=0.01)


def test_damaged_snapshots_show_a_message_and_the_next_good_one_removes_it(visit):
    good = pack(some_gaussians(20, degree=1), {"snr": torch.arange(20.0)})
    page = bare(visit, good)
    draw = np.random.default_rng(0)
    for _ in range(30):
        broken = bytearray(good)
        for at in draw.integers(0, len(good), 20):
            broken[at] = draw.integers(0, 256)
        # Flipped bits inside the Gaussians are other Gaussians, and everything else is a message.
        assert load(page, bytes(broken)) == "loaded" or page.locator("[role=alert]").count() == 1
    assert load(page, good[:-1]).startswith("This is not a snapshot that can be drawn: it has")
    assert "it has" in page.locator("[role=alert]").inner_text()
    assert load(page, good) == "loaded"
    assert page.locator("[role=alert]").count() == 0


def test_without_webgl2_a_message_says_so(visit):
    page = visit(
        viewer_page(pack(some_gaussians(5)), title="a cube"),
        before="HTMLCanvasElement.prototype.getContext = () => null;",
    )
    assert "WebGL2" in page.locator("[role=alert]").inner_text()
    assert page.locator("#loading").count() == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "refusal",
    [
        "globalThis.Worker = class { constructor() { throw new Error('refused'); } };",
        """globalThis.Worker = class {
          postMessage() { setTimeout(() => this.onerror?.(new Event("error")), 20); }
          terminate() {}
        };""",
    ],
)
def test_the_picture_is_the_same_where_workers_are_refused(visit, refusal):
    packed = pack(some_gaussians(300))
    usual, other = (picture(bare(visit, packed, before=before)) for before in ("", refusal))
    assert np.array_equal(usual, other)
    assert (usual < 0.5).any()


@pytest.mark.slow
def test_the_picture_returns_after_a_reset_of_the_graphics_card(visit):
    page = bare(visit, pack(some_gaussians(300), {"snr": torch.arange(300.0)}))
    page.evaluate("() => view.show('snr')")
    before = picture(page)
    page.evaluate("""async () => {
      const gl = document.querySelector("canvas").getContext("webgl2").getExtension("WEBGL_lose_context");
      gl.loseContext();
      await new Promise((done) => setTimeout(done, 100));
      gl.restoreContext();
      await new Promise((done) => setTimeout(done, 200));
    }""")
    assert np.array_equal(picture(page), before)


@pytest.mark.slow
def test_an_embedded_view_leaves_the_wheel_to_the_page_until_it_is_used(visit):
    page = bare(visit, pack(some_gaussians(20)), "{embedded: true}")
    page.evaluate("() => { document.body.style.height = '3000px'; }")
    before = page.evaluate("() => view.camera.distance")
    page.mouse.move(100, 100)
    page.mouse.wheel(0, 100)
    page.wait_for_function("() => scrollY > 50")
    assert page.evaluate("() => view.camera.distance") == before
    page.evaluate("() => scrollTo(0, 0)")
    page.mouse.click(100, 100)
    page.mouse.wheel(0, 100)
    page.wait_for_function("(before) => view.camera.distance > before", arg=before)
    assert page.evaluate("() => scrollY") == 0


@pytest.mark.slow
def test_the_slider_of_a_report_shows_the_steps_of_the_training(visit, tmp_path):
    counts = {0: 30, 50: 60, 100: 45}
    for step, count in counts.items():
        path = tmp_path / SNAPSHOTS / snapshot_name(step)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(pack(some_gaussians(count)))
    (tmp_path / "summary.json").write_text('{"prompt": "a cube", "steps": 100}')
    page = visit(write_report(tmp_path).read_text(encoding="utf-8"), width=900, height=900)
    page.wait_for_function("() => view.count === 45")
    page.get_by_label("Step of the training").fill("1")
    page.wait_for_function("() => view.count === 60")
    assert page.locator("#shown").text_content() == "step 50"
    # From the middle, the rest is played up to the finished object.
    page.get_by_role("button", name="Play").click()
    page.wait_for_function("() => view.count === 45")
    page.wait_for_function("() => document.getElementById('play').textContent === 'Play'")
