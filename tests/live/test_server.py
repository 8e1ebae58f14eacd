"""What the server of ``cadam3d view`` answers and what it refuses, over plain HTTP."""

import http.client
import json
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from splats import make_gaussians

from cadam3d.io import live
from cadam3d.io.jsonl import append_jsonl, write_json
from cadam3d.io.lock import locked
from cadam3d.io.ply import read_ply, write_ply
from cadam3d.live.server import Server
from cadam3d.live.subject import ShownFile, ShownRun
from cadam3d.viewer.pack import pack

PROMPT = "a <b>red</b> cube"
STATE = {
    **{"step": 3, "total_steps": 9, "num_gaussians": 5, "seconds": 0.5, "loss": 2.0},
    **{"is_paused": False, "has_ended": False, "statistics": {"snr_p50": 0.1}},
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Return the folder of a run that has finished."""
    run = tmp_path_factory.mktemp("live") / "run"
    (run / "saved").mkdir(parents=True)
    (run / "config.yaml").write_text(f"prompt: {PROMPT}\nsteps: 9\n")
    (run / "report.html").write_text("<script>alert(1)</script>")
    write_ply(run / "asset.ply", make_gaussians(20), up="-y", pad_sh=0)
    write_ply(run / "saved/step_0000004.ply", make_gaussians(4), up="-y", pad_sh=0)
    for step in (1, 5, 9):
        line = {"kind": "step", "step": step, "loss": 1 / step, "num_gaussians": 20, "seconds": step}
        append_jsonl(run / "metrics.jsonl", line)
    write_json(run / "summary.json", {"outcome": "finished", "steps": 9, "num_gaussians": 20, "seconds": 9.0})
    return run


@pytest.fixture
def run(finished, tmp_path) -> Path:
    return shutil.copytree(finished, tmp_path / "run")


@contextmanager
def serving(subject: ShownFile) -> Iterator["Browser"]:
    with Server(subject, 0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield Browser(server)
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def training(run: Path, **entries: object) -> Iterator[None]:
    """Pretend to train in ``run``."""
    with locked(run / ".lock", pytest.fail):
        live.begin(run)
        live.publish_state(run, {**STATE, **entries})
        (run / "live/snapshot.bin").write_bytes(pack(make_gaussians(5)))
        yield
        live.clear(run)


class Browser:
    """Asks a server."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.origin = f"http://127.0.0.1:{server.server_port}"

    def ask(self, method, path, body=None, *, token=None, host=None, **headers):
        """Return status, headers and content of an answer. ``path`` is what follows the token."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.server_port, timeout=20)
        token = self.server.token if token is None else token
        connection.putrequest(method, f"/{token}/{path}", skip_host=True)
        connection.putheader("Host", host or self.origin.removeprefix("http://"))
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, answer.headers, content

    def get(self, path, **options):
        """Ask, and follow a redirection as a browser does."""
        answer = self.ask("GET", path, **options)
        if answer[0] != 302:
            return answer
        _, token, path = answer[1]["Location"].split("/", 2)
        return self.ask("GET", path, **options | {"token": token})

    def send(self, text: str) -> bytes:
        """Send the bytes of a request, and return everything that the server answers until it hangs up."""
        with socket.create_connection(("127.0.0.1", self.server.server_port), timeout=20) as connection:
            connection.sendall(text.encode())
            connection.shutdown(socket.SHUT_WR)
            pieces = []
            # A server that hangs up before it has read everything may reset the connection.
            with suppress(ConnectionError):
                pieces.extend(iter(lambda: connection.recv(1 << 16), b""))
            return b"".join(pieces)

    def json(self, path):
        status, _, content = self.get(path)
        assert status == 200
        return json.loads(content)

    def post(self, path, body=b"", *, origin=None, **options):
        origin = self.origin if origin is None else origin
        return self.ask("POST", path, body, Origin=origin, **options)[0]


@pytest.fixture
def browser(run) -> Iterator[Browser]:
    with serving(ShownRun(run)) as browser:
        yield browser


# --- what is shown -----------------------------------------------------------------------------------------


def test_the_page_and_its_parts_are_served(browser):
    status, headers, content = browser.get("")
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b'src="page.js"' in content
    for part in ("page.js", "page.css", "viewer.js", "viewer.css"):
        assert browser.get(part)[0] == 200


def test_every_answer_has_the_headers_that_keep_others_out(browser):
    answers = [(path, browser.get(path)) for path in ("", "state", "picture", "asset.ply", "report", "x")]
    answers += [("", browser.ask(*request)) for request in (("GET", "report"), ("DELETE", ""), ("HEAD", ""))]
    for path, (_, headers, _) in answers:
        assert headers["Cache-Control"] == "no-store"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "unsafe-inline" not in headers["Content-Security-Policy"] or path == "report"


def test_a_finished_run_is_shown_with_its_asset_and_its_numbers(browser, run):
    state = browser.json("state")
    assert (state["status"], state["outcome"], state["step"], state["title"]) == (
        "idle",
        "finished",
        9,
        PROMPT,
    )
    assert (state["saved"], state["has_report"], state["has_asset"]) == ([4], True, True)
    assert browser.get("picture")[2] == pack(read_ply(run / "asset.ply"))
    charts = {chart["title"]: chart for chart in browser.json("charts")}
    assert charts["Loss"]["curves"][0]["points"] == [[1, 1.0], [5, 0.2], [9, 1 / 9]]
    assert browser.get("asset.ply")[2] == (run / "asset.ply").read_bytes()
    assert browser.get("saved/4")[2] == (run / "saved/step_0000004.ply").read_bytes()
    assert not (run / "live").exists()


def test_a_run_that_begins_while_the_page_is_open_becomes_live_and_ends_again(browser, run):
    before = browser.json("state")["picture"]
    with training(run, step=11):
        state = browser.json("state")
        assert (state["status"], state["step"], state["num_gaussians"]) == ("training", 11, 5)
        assert state["is_writable"]
        assert (state["has_report"], state["has_asset"]) == (False, False), "those are of the earlier run"
        assert state["picture"] != before
        assert browser.get("picture")[2] == pack(make_gaussians(5))
        assert (run / "live/watched").exists()
    assert browser.json("state")["status"] == "idle"
    assert browser.json("state")["picture"] == before


def test_a_log_that_grows_or_is_replaced_is_followed(browser, run):
    first = browser.json("state")["charts"]
    append_jsonl(
        run / "metrics.jsonl", {"kind": "refine", "step": 10, "after": 33, "statistics": {"snr_p50": 1}}
    )
    # A step counts the Gaussians before its refinement.
    append_jsonl(run / "metrics.jsonl", {"kind": "step", "step": 10, "num_gaussians": 20})
    assert browser.json("state")["charts"] != first
    assert browser.json("charts")[0]["curves"][0]["points"][-2:] == [[9, 20], [10, 33]]
    (run / "metrics.jsonl").unlink()
    append_jsonl(run / "metrics.jsonl", {"kind": "step", "step": 1, "loss": 3.0})
    browser.json("state")
    assert browser.json("charts")[1]["curves"][0]["points"] == [[1, 3.0]]


def test_a_report_is_in_a_sandbox(browser):
    _, headers, content = browser.get("report")
    assert content == b"<script>alert(1)</script>"
    assert headers["Content-Security-Policy"].startswith("sandbox allow-scripts allow-downloads;")
    assert "allow-same-origin" not in headers["Content-Security-Policy"]


def test_the_report_has_an_address_that_opens_nothing_else(browser, run):
    """Its scripts may lead the browser to another page, which then knows the address of the report."""
    status, headers, _ = browser.ask("GET", "report")
    _, token, name = headers["Location"].split("/")
    assert (status, name, token != browser.server.token) == (302, "report", True)
    assert browser.get("asset.ply", token=token)[0] == 200
    for path in ("", "state", "picture", "charts", "page.js", "saved/4"):
        assert browser.get(path, token=token)[0] == 403
    with training(run):
        process = browser.json("state")["process"].encode()
        assert browser.post("stop", process, token=token) == 403


@pytest.mark.parametrize("first", ["GET", "POST", "DELETE"])
@pytest.mark.parametrize("length", ["Content-Length: {}", "Transfer-Encoding: chunked\r\nContent-Length: {}"])
def test_the_body_of_a_request_is_not_read_as_the_next_one(browser, run, first, length):
    """A foreign page can send a body to an address, and a browser uses one connection for many requests."""
    with training(run):
        host = browser.origin.removeprefix("http://")
        process = browser.json("state")["process"]
        hidden = f"POST /{browser.server.token}/stop HTTP/1.1\r\nHost: {host}\r\nOrigin: {browser.origin}"
        hidden += f"\r\nContent-Length: {len(process)}\r\n\r\n{process}"
        head = f"{first} /{browser.server.token}/state HTTP/1.1\r\nHost: {host}\r\n"
        answer = browser.send(f"{head}{length.format(len(hidden))}\r\n\r\n{hidden}")
        assert answer.count(b"HTTP/1.") <= 1
        assert not live.is_asked(run, "stop")


def test_a_request_that_is_no_http_gets_the_headers_too(browser):
    answer = browser.send("GET / HTTP/9.9\r\n\r\n") + browser.send("BREW / HTTP/1.1\r\n\r\n")
    assert b"501" in answer
    assert b"Content-Security-Policy" in answer.partition(b"501")[2]


def test_a_single_file_is_shown_without_anything_of_a_run(run):
    file = run / "asset.ply"
    with serving(ShownFile(file, pack(read_ply(file)))) as browser:
        state = browser.json("state")
        assert (state["kind"], state["title"]) == ("file", "asset.ply")
        assert browser.get("picture")[2] == pack(read_ply(file))
        assert browser.get("report")[0] == 404
        assert browser.post("stop") == 409


def test_a_killed_run_without_an_asset_shows_its_last_snapshot(browser, run):
    with training(run):
        shutil.copytree(run / "live", run / "kept")
    (run / "asset.ply").unlink()
    (run / "kept").rename(run / "live")
    assert browser.json("state")["status"] == "idle"
    assert browser.get("picture")[2] == pack(make_gaussians(5))


def test_the_state_that_a_killed_process_has_left_is_not_that_of_the_next_one(browser, run):
    with training(run):
        state = json.loads((run / "live/state.json").read_text())
        (run / "live/state.json").write_text(json.dumps({**state, "process": "1 on another machine"}))
        assert browser.json("state")["status"] == "busy"
        assert browser.post("stop", b"1 on another machine") == 409


# --- the buttons -------------------------------------------------------------------------------------------


def test_the_buttons_ask_the_process_that_trains(browser, run):
    with training(run):
        process = browser.json("state")["process"].encode()
        for request in ("pause", "save", "stop"):
            assert browser.post(request, process) == 200
            assert live.is_asked(run, request)
        assert browser.json("state")["asked"] == ["pause", "save", "stop"]
        assert browser.post("resume", process) == 200
        assert not live.is_asked(run, "pause")


def test_a_request_for_another_process_is_refused(browser, run):
    assert browser.post("stop", b"1 on here") == 409
    with training(run):
        assert browser.post("stop", b"1 on here") == 409
        assert not live.is_asked(run, "stop")


def test_two_pages_work_at_once(run):
    subject = ShownRun(run)
    with training(run), serving(subject) as one, serving(ShownRun(run)) as other:
        process = one.json("state")["process"].encode()
        assert one.post("pause", process) == other.post("pause", process) == 200
        assert other.post("resume", process) == one.post("resume", process) == 200
        assert one.json("state")["asked"] == []


# --- what is refused ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("token", ["", "x", "..", "%2e%2e", "%00"])
def test_without_the_token_there_is_nothing(browser, run, token):
    for path in ("", "state", "picture", "report"):
        assert browser.get(path, token=token)[0] == 403
    with training(run):
        process = browser.json("state")["process"].encode()
        assert browser.post("stop", process, token=token) == 403
        assert not live.is_asked(run, "stop")


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "localhost:x"])
def test_a_foreign_name_of_this_machine_is_refused(browser, host):
    assert browser.get("state", host=host)[0] == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "", "https://127.0.0.1"])
def test_only_the_page_itself_presses_buttons(browser, run, origin):
    with training(run):
        process = browser.json("state")["process"].encode()
        assert browser.post("stop", process, origin=origin) == 403
        assert browser.get("stop")[0] == 404
        assert not live.is_asked(run, "stop")


@pytest.mark.parametrize(
    "path",
    [
        *("../../etc/passwd", "..%2f..%2fetc/passwd", "//etc/passwd", "saved/../config.yaml", "charts.json"),
        *("saved/4.ply", "saved/step_0000004.ply", "saved/-4", "saved/", "saved/9", "saved/%D9%A4"),
        *(".lock", "live", "live/state.json"),
    ],
)
def test_no_path_leads_to_a_file(browser, path):
    assert browser.get(path)[0] == 404


@pytest.mark.parametrize(
    ("name", "offered"),
    [
        ("asset.ply", "asset.ply"),
        ("report.html", "report"),
        ("saved", "saved/4"),
        ("live/snapshot.bin", "picture"),
    ],
)
def test_links_are_not_followed(browser, run, tmp_path, name, offered):
    with training(run):
        assert browser.get(offered)[0] == 200
        (run / name).rename(tmp_path / "elsewhere")
        (run / name).symlink_to(tmp_path / "elsewhere")
        assert browser.get(offered)[0] == 404
        assert browser.json("state")["status"] == "training"


def test_a_link_in_place_of_the_live_folder_is_not_written_into(browser, run, tmp_path):
    with training(run):
        (run / "live").rename(tmp_path / "elsewhere")
        (run / "live").symlink_to(tmp_path / "elsewhere")
        assert browser.json("state")["status"] == "busy"
        assert browser.post("stop", live.process_name().encode()) == 409
        assert sorted(path.name for path in (tmp_path / "elsewhere").iterdir()) == [
            "snapshot.bin",
            "state.json",
        ]


def test_the_address_is_on_loopback_and_has_a_new_token_each_time(run):
    with Server(ShownFile(run), 0) as one:
        assert one.server_address[0] == "127.0.0.1"
        assert one.address == f"http://127.0.0.1:{one.server_port}/{one.token}/"
        with Server(one.subject, 0) as other:
            assert one.token != other.token


def test_a_request_that_is_too_long_is_refused(browser):
    assert browser.post("stop", b"x" * 2000) == 413
    assert browser.ask("POST", "stop", Origin=browser.origin)[0] == 413
    assert browser.ask("DELETE", "state")[0] == 501


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1:9000", "localhost"])
def test_another_port_is_fine_because_a_tunnel_may_have_one(browser, host):
    assert browser.get("state", host=host)[0] == 200
