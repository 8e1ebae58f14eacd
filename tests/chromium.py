"""Headless Chromium, in which tests open pages. They skip themselves where it is absent."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
# WebGL is drawn in software, so that all machines draw the same, and nothing contacts a network.
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


def watch(page: Any, problems: list[str]) -> None:
    """Add everything that a page prints, every error and every request to another place to ``problems``."""
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: problems.append(request.url) if is_foreign(request.url) else None)


def is_foreign(url: str) -> bool:
    return not url.startswith(("file:", "blob:", "data:"))


@contextmanager
def headless() -> Iterator[Any]:
    """Run Chromium, and return playwright's browser; skip the test where it does not run."""
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    executable = next(filter(None, map(shutil.which, NAMES)), None)
    if executable is None:
        pytest.skip("no Chromium")
    with playwright.sync_playwright() as driver:
        try:
            browser = driver.chromium.launch(executable_path=executable, args=list(FLAGS))
        except playwright.Error as error:
            pytest.skip(f"Chromium does not run here: {str(error)[:200]}")
        try:
            yield browser
        finally:
            browser.close()
