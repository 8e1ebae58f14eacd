"""Pictures of a file in programs that are not ours, from one camera, and their distance from our own render.

The programs come from npm, and ``package.json`` pins their versions. They are installed in the folder that
the environment variable ``CADAM3D_PROGRAMS`` names, or else beside this file:

    npm install --prefix tests/programs

Tests skip themselves where Node, Chromium, playwright or the packages are absent. Nothing here uses a
network: the pages are served on loopback, and a request for any other address fails the test.
"""

import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import numpy as np
import pytest
import torch
from chromium import headless
from PIL import Image

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.frames import file_to_world, world_to_file
from cadam3d.rasterizer.cpu import CpuRasterizer

HERE = Path(__file__).parent
PAGES = HERE / "pages"
# Chromium's software driver for Vulkan; splat-transform renders with it through libvulkan1.
VULKAN_DRIVERS = (
    "/usr/lib/chromium/vk_swiftshader_icd.json",
    "/usr/lib64/chromium-browser/vk_swiftshader_icd.json",
    "/opt/google/chrome/vk_swiftshader_icd.json",
)
PATIENCE_S = 120  # for one picture; a busy machine with two cores needs up to 30

Picture = np.ndarray  # [h w 3], uint8


@dataclass(frozen=True)
class View:
    """One camera that every program gets, on a sphere around the origin, in front of white."""

    azimuth_deg: float = 25.0
    elevation_deg: float = 15.0
    distance: float = 2.6
    fov_y_deg: float = 45.0
    size: int = 480  # pixels

    def cameras(self) -> Cameras:
        """Return the camera in world axes."""
        numbers = (self.azimuth_deg, self.elevation_deg, self.distance, self.fov_y_deg)
        return orbit(*(torch.tensor([number]) for number in numbers), self.size, self.size)

    @property
    def eye(self) -> tuple[float, float, float]:
        """Return its position in a program with +y up, where the object's front faces +z."""
        x, y, z = self.cameras().positions[0].tolist()
        return y, z, x


def ours(gaussians: Gaussians, view: View) -> Picture:
    """Return our own picture, which the others must equal."""
    with torch.no_grad():
        output = CpuRasterizer(cache_dir=None).render(gaussians, view.cameras(), torch.ones(1, 3))
    return (255 * output.rgb[0].clamp(0, 1)).round().byte().numpy()


def turned(gaussians: Gaussians, written: str, shown: str) -> Gaussians:
    """Return the object as a program shows it that takes the up axis ``written`` for ``shown``."""
    return file_to_world(world_to_file(gaussians, written), shown)


def psnr(first: Picture, second: Picture) -> float:
    """Return the peak signal-to-noise ratio of two pictures in dB, over all pixels."""
    error = np.square(first.astype(np.float64) - second.astype(np.float64)).mean()
    return float("inf") if error == 0 else float(10 * np.log10(255**2 / error))


def packages() -> Path:
    """Return the folder ``node_modules``; skip the test if a package of the pinned version is absent."""
    folder = Path(os.environ.get("CADAM3D_PROGRAMS", HERE)) / "node_modules"
    for name, version in pinned().items():
        found = folder / name / "package.json"
        if not found.is_file():
            pytest.skip(f"no {found}: npm install --prefix tests/programs")
        if f'"version": "{version}"' not in found.read_text(encoding="utf-8"):
            pytest.skip(f"{found} is not version {version}: npm install --prefix tests/programs")
    return folder


def pinned() -> dict[str, str]:
    """Return the versions of the programs, by package."""
    return json.loads((HERE / "package.json").read_text(encoding="utf-8"))["dependencies"]


class RefusedError(AssertionError):
    """A program did not open a file; the text is its message."""


@dataclass(frozen=True)
class SplatTransform:
    """PlayCanvas's command-line program, which shares SuperSplat's readers and has a renderer of its own."""

    script: Path
    environment: dict[str, str]

    @classmethod
    def find(cls) -> "SplatTransform":
        """Return the program; skip the test where it cannot render."""
        if shutil.which("node") is None:
            pytest.skip("no node")
        script = packages() / "@playcanvas/splat-transform/bin/cli.mjs"
        driver = next((path for path in VULKAN_DRIVERS if Path(path).is_file()), None)
        if driver is None:
            pytest.skip("no SwiftShader driver for Vulkan, which is part of Debian's chromium")
        program = cls(script, {**os.environ, "VK_ICD_FILENAMES": driver})
        if "[0]" not in program.run("--list-gpus").stdout:
            pytest.skip("splat-transform finds no graphics adapter: apt-get install libvulkan1")
        return program

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run one command line."""
        return subprocess.run(
            ["node", str(self.script), *words],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def picture(self, path: Path, view: View) -> Picture:
        """Return its picture of a file. Raises ``RefusedError`` with its message if it does not open it."""
        target = path.with_name(path.name + ".webp")
        words = {
            "--camera-pos": ",".join(map(str, view.eye)),
            "--camera-target": "0,0,0",
            "--camera-fov": str(view.fov_y_deg),
            "--resolution": f"{view.size}x{view.size}",
            "--background": "1,1,1",
        }
        options = [word for pair in words.items() for word in pair]
        done = self.run("-q", "-w", str(path), *options, str(target))
        if done.returncode != 0 or not target.is_file():
            raise RefusedError(done.stderr)
        return np.asarray(Image.open(target).convert("RGB"))


@dataclass
class Browser:
    """Headless Chromium, and a server on loopback for the packages, our pages and the files to show."""

    chromium: object  # playwright's browser
    origin: str
    folders: dict[str, Path] = field(default_factory=dict)

    @classmethod
    @contextmanager
    def start(cls) -> Iterator["Browser"]:
        """Start the browser and the server; skip the test where something is absent."""
        folders = {"pages": PAGES, "packages": packages()}
        with _serve(folders) as origin, headless() as chromium:
            yield cls(chromium, origin, folders)

    def picture(self, page: str, path: Path, view: View, **options: str) -> Picture:
        """Return the picture of a file on one of our pages, such as ``"spark.html"``.

        Raises ``RefusedError`` with the program's message if it does not open the file.
        """
        self.folders["files"] = path.parent
        numbers = {"eye": ",".join(map(str, view.eye)), "fov": str(view.fov_y_deg), "size": str(view.size)}
        query = urlencode({"file": f"/files/{path.name}", **numbers, **options})
        with self.open(f"{self.origin}/pages/{page}?{query}", view.size, view.size) as opened:
            opened.wait_for_function("window.result !== undefined", timeout=1000 * PATIENCE_S)
            if (result := opened.evaluate("window.result")) != "drawn":
                raise RefusedError(result)
            return _settled(opened)

    @contextmanager
    def open(self, address: str, width: int, height: int) -> Iterator[object]:
        """Open a page in a fresh context, and check at the end that it requested nothing from elsewhere."""
        context = self.chromium.new_context(viewport={"width": width, "height": height})
        requests: list[str] = []
        try:
            page = context.new_page()
            page.on("request", lambda request: requests.append(request.url))
            page.goto(address, wait_until="load", timeout=1000 * PATIENCE_S)
            yield page
        finally:
            context.close()
        local = (self.origin + "/", "data:", "blob:")
        assert not [url for url in requests if not url.startswith(local)]


def _settled(page: object) -> Picture:
    """Return the picture of a page after it has stopped changing."""
    last, deadline = b"", time.monotonic() + PATIENCE_S
    while (now := page.screenshot()) != last:
        assert time.monotonic() < deadline, "the picture keeps changing"
        last = now
        page.wait_for_timeout(300)
    return np.asarray(Image.open(BytesIO(now)).convert("RGB"))


@contextmanager
def _serve(folders: dict[str, Path]) -> Iterator[str]:
    """Serve the folders on loopback under their names, and return the address."""

    class Handler(SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            name, _, rest = urlsplit(path).path.lstrip("/").partition("/")
            self.directory = str(folders.get(name, HERE / "absent"))
            return super().translate_path("/" + rest)

        def log_message(self, *words: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
