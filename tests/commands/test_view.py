"""``cadam3d view`` as its users see it: a process that trains, and a browser or HTTP before its page."""

import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from chromium import headless
from splats import make_gaussians

from cadam3d.io.ply import read_ply, write_ply
from cadam3d.live.server import Server
from cadam3d.live.subject import ShownRun

PYTHON = (sys.executable, "-m", "cadam3d")
SMALL = ("prompt=a red cube", "prior=tiny", "rasterizer=reference", "camera.size=8", "views=1")
SMALL += (
    "initializer.count=40",
    "exporter=[ply]",
    "metric=[]",
    "hydra.run.dir=run",
    "callback.live.seconds=0.1",
)
ENDLESS = 1_000_000  # steps
PATIENCE = 60  # seconds, for a machine that is busy

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs signals")


@contextmanager
def process(folder: Path, *words: str) -> Iterator[subprocess.Popen]:
    """Run ``cadam3d`` in another process, and end it."""
    # The tests import the package from here, and so do its processes.
    root = str(Path(__file__).parents[2])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    started = subprocess.Popen(
        [*PYTHON, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=(folder / f"{words[0]}.err").open("w"),
        text=True,
    )
    with started:
        try:
            yield started
        finally:
            started.kill()


def until(is_done: Callable[[], object]) -> None:
    """Wait for something that another process does."""
    end = time.monotonic() + PATIENCE
    while not is_done():
        assert time.monotonic() < end, "this takes too long"
        time.sleep(0.1)


class Page:
    """Does what the page does, without a browser."""

    def __init__(self, address: str) -> None:
        self.url = urlsplit(address)

    def ask(self, name: str, body: str | None = None) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection(self.url.netloc, timeout=PATIENCE)
        headers = {} if body is None else {"Origin": f"http://{self.url.netloc}"}
        connection.request("GET" if body is None else "POST", self.url.path + name, body, headers)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, content

    @property
    def state(self) -> dict:
        return json.loads(self.ask("state")[1])

    def press(self, button: str) -> None:
        assert self.ask(button, self.state["process"])[0] == 200

    def picture(self) -> bytes:
        return self.ask("picture")[1]


@contextmanager
def viewed(folder: Path) -> Iterator[str]:
    """Serve the page of a run from this process, and return its address."""
    with Server(ShownRun(folder), 0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield server.address
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.slow
def test_a_run_that_trains_is_shown_paused_resumed_saved_and_stopped(tmp_path):
    with process(tmp_path, "train", *SMALL, f"steps={ENDLESS}") as training:
        until((tmp_path / "run/live/state.json").exists)
        with viewed(tmp_path / "run") as address:
            page = Page(address)
            until(lambda: page.state["picture"])
            first = page.picture()
            until(lambda: page.state["picture"] and page.picture() != first)
            assert page.state["status"] == "training"

            page.press("pause")
            until(lambda: page.state["status"] == "paused")
            paused = page.state
            page.press("save")
            until(lambda: page.state["saved"] and not page.state["asked"].count("save"))
            assert (page.state["saved"], page.state["step"]) == ([paused["step"]], paused["step"])
            saved = tmp_path / f"run/saved/step_{paused['step']:07d}.ply"
            assert len(read_ply(saved)) == paused["num_gaussians"]
            page.press("resume")
            until(lambda: page.state["status"] == "training" and page.state["step"] > paused["step"])
            # The time of the pause is not time of training.
            assert page.state["seconds"] < paused["seconds"] + PATIENCE
            page.press("stop")
            assert training.wait(PATIENCE) == 0
            state = page.state
            assert (state["status"], state["outcome"]) == ("idle", "interrupted")
            assert page.picture() != first
    messages = (tmp_path / "train.err").read_text()
    assert "rm run/live/pause" in messages
    assert not (tmp_path / "run/live").exists()


def test_a_single_file_is_served_and_a_port_that_is_in_use_is_named(tmp_path, type_line, monkeypatch):
    write_ply(tmp_path / "thing.ply", make_gaussians(5), up="-y", pad_sh=0)
    # Ctrl-C ends the server without an error.
    monkeypatch.setattr(
        "cadam3d.live.server.Server.serve_forever", lambda self: signal.raise_signal(signal.SIGINT)
    )
    code, out, err = type_line("view", "ply=thing.ply", "open=false")
    assert (code, err) == (0, "")
    assert re.match(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/\nCtrl-C ends the server\.", out)
    assert re.search(r"ssh -L (\d+):127\.0\.0\.1:\1 ", out)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        message = type_line("view", "ply=thing.ply", "open=false", f"port={port}").message
    assert message.startswith(f"port: expected a free port, got {port} (")


@pytest.fixture
def browser() -> Iterator:
    """Return a page of a real browser, or skip the test."""
    with headless() as started:
        yield started.new_page(viewport={"width": 1100, "height": 700})


@pytest.mark.slow
def test_the_page_in_a_browser_follows_the_run_and_its_buttons_work(tmp_path, browser):
    problems = []
    browser.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    browser.on("pageerror", lambda error: problems.append(str(error)))
    with process(tmp_path, "train", *SMALL, f"steps={ENDLESS}") as training:
        until((tmp_path / "run/live/state.json").exists)
        with viewed(tmp_path / "run") as address:
            browser.goto(address)
            browser.wait_for_selector("#charts figure:nth-of-type(3)", timeout=60_000)
            browser.wait_for_selector("#controls option[value=age]", state="attached", timeout=60_000)
            canvas = browser.locator("#view canvas")
            first = canvas.screenshot()
            until(lambda: canvas.screenshot() != first)
            names = browser.eval_on_selector_all("#controls option", "options => options.map(o => o.value)")
            assert {"rgb", "depth", "opacity", "snr", "age", "selected"} <= set(names)
            assert browser.inner_text("#title") == "a red cube"

            browser.click("text=Pause")
            browser.wait_for_selector("text=Resume", timeout=60_000)
            browser.click("text=Save now")
            browser.wait_for_selector("#files a[download]", timeout=60_000)
            assert list((tmp_path / "run/saved").glob("*.ply"))
            browser.set_viewport_size({"width": 390, "height": 800})
            assert browser.evaluate("document.documentElement.scrollWidth") <= 390
            browser.click("text=Resume")
            browser.wait_for_selector("text=Pause", timeout=60_000)
            browser.click("text=Stop")
            assert training.wait(PATIENCE) == 0
            browser.wait_for_selector("text=not running", timeout=60_000)
            assert browser.is_disabled("#pause")
            assert not problems
        browser.wait_for_selector("text=The connection is lost", timeout=60_000)
