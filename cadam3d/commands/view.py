"""``cadam3d view``: show a run or a file in a browser, and control a run that trains."""

import os
import shlex
import signal
import socket
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager

from omegaconf import DictConfig

from cadam3d import report
from cadam3d.commands.opened import find_asset, find_run, require_one
from cadam3d.core.console import show
from cadam3d.core.errors import UserError
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.lock import is_held
from cadam3d.io.run_folder import LOCK, REPORT, expanded, has_file, shown, typed_path
from cadam3d.live.server import HOST, Server
from cadam3d.live.subject import ShownFile, ShownRun
from cadam3d.settings.compose import Call
from cadam3d.settings.trust import require_contained
from cadam3d.sweep.folder import is_sweep
from cadam3d.viewer.pack import pack


def run(cfg: DictConfig, _call: Call) -> None:
    """Serve the page of ``run=`` or ``ply=`` until Ctrl-C. For a sweep, open its report instead."""
    require_one(cfg)
    if cfg.run is not None and is_sweep(folder := typed_path(str(cfg.run))):
        page = folder / REPORT
        if not has_file(page):
            line = shlex.join(["cadam3d", "eval", f"run={shown(folder)}", "trust=true"])
            require_contained(folder, line)
            report.write_sweep(folder)
        is_open = cfg.open and has_display() and webbrowser.open(page.resolve().as_uri())
        show(f"{'Opened' if is_open else 'Open this in a browser:'} {shown(page)}")
        return
    subject = _subject(cfg)
    try:
        server = Server(subject, cfg.port)
    except OSError as error:
        got = f"{cfg.port} ({error.strerror})"
        raise UserError(f"port: expected a free port, got {got}. Try: port=0") from error
    tunnel = f"ssh -L {server.server_port}:{HOST}:{server.server_port} {socket.gethostname()}"
    with _ended_by_signals(), server:
        show(server.address)
        show(f"Ctrl-C ends the server. To open the address on another machine, first type there: {tunnel}")
        sys.stdout.flush()
        if cfg.open and has_display():
            webbrowser.open(server.address)
        server.serve_forever()


def has_display() -> bool:
    """Return whether a window can appear; without one, a text browser would take over the terminal."""
    is_unix = sys.platform.startswith(("linux", "freebsd"))
    return not is_unix or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """End the block without an error at Ctrl-C and at SIGTERM, also in a background job of a shell script."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, signal.default_int_handler) for number in numbers]
    try:
        yield
    except KeyboardInterrupt:
        show("")
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


def _subject(cfg: DictConfig) -> ShownFile:
    """Return what the page shows. Raises ``UserError`` if there is nothing that can be read."""
    if cfg.ply is not None:
        file = expanded(str(cfg.ply))
        return ShownFile(file, pack(read_gaussians(file, up=cfg.ply_up)))
    run = ShownRun(find_run(str(cfg.run)))
    if run.picture() is None and not is_held(run.place / LOCK):
        # This raises the error that explains why there is no picture.
        read_gaussians(find_asset(run.place))
    return run
