"""Server: serves a page to browsers on this machine, and the data that the page requests.

Only requests with the token of the address are answered. The answers are a fixed list; no path from a request
leads to a file. ``SECURITY.md`` has all promises.
"""

import hmac
import os
import secrets
import socketserver
import sys
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO

from cadam3d.io.jsonl import to_json
from cadam3d.io.reading import signature
from cadam3d.live.subject import OFFERED, ShownFile
from cadam3d.viewer import page as viewer

HOST = "127.0.0.1"
# The names by which a browser on this machine calls it. Any other name may belong to a foreign page that was
# made to lead here (DNS rebinding).
OWN_NAMES = ("127.0.0.1", "localhost")
REPORT = "report"  # the name of the report in an address
REQUESTS = ("pause", "resume", "save", "stop")
LONGEST_BODY = 1000  # bytes of a request
PIECE = 1 << 20  # bytes of a file that are sent at once
IDLE_SECONDS = 30.0  # after these, an open connection is closed
FOLDER = Path(__file__).parent
HTML, TEXT, SCRIPT, STYLE = (f"text/{kind}; charset=utf-8" for kind in ("html", "plain", "javascript", "css"))
JSON, BYTES = "application/json", "application/octet-stream"

HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
POLICY = (
    "default-src 'none'; script-src 'self'; worker-src blob:; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The report is a page by the author of the run. In a sandbox it belongs to no origin, so it can neither read
# what this server answers nor press a button. It can lead the browser to another page and tell that page its
# own address, so it has an address with a token of its own, which admits to nothing else of the page.
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; worker-src blob:; img-src data: blob:; media-src data:; font-src data:; "
    "frame-ancestors 'none'"
)


def _own(name: str) -> bytes:
    return (FOLDER / name).read_bytes()


def _json(value: Any) -> bytes:
    # The names of folders, and text in YAML, may hold characters that UTF-8 does not have.
    return to_json(value).encode(errors="replace")


# What is the same for every page: the name in the address, the type, and the content.
FIXED: dict[str, tuple[str, Callable[[], bytes]]] = {
    "": (HTML, lambda: _own("page.html")),
    "page.js": (SCRIPT, lambda: _own("page.js")),
    "page.css": (STYLE, lambda: _own("page.css")),
    "viewer.js": (SCRIPT, lambda: viewer.script().encode()),
    "viewer.css": (STYLE, lambda: viewer.style().encode()),
}
# What depends on the run or the file. None means that there is nothing yet.
CURRENT: dict[str, tuple[str, Callable[[ShownFile], bytes | None]]] = {
    "state": (JSON, lambda subject: _json(subject.state())),
    "charts": (JSON, lambda subject: _json(subject.charts())),
    "picture": (BYTES, lambda subject: subject.picture()),
}


class Server(ThreadingHTTPServer):
    """Shows a run or a file to browsers of this machine, under an address with a random token."""

    daemon_threads = True
    # On Windows, another program could then use the same port.
    allow_reuse_address = os.name != "nt"

    def __init__(self, subject: ShownFile, port: int) -> None:
        """Listen on ``port``, or on any free one if it is 0. Raises ``OSError`` if that is impossible."""
        self.subject, self.token, self.report_token = subject, *(secrets.token_urlsafe(18) for _ in range(2))
        super().__init__((HOST, port), Handler)

    def server_bind(self) -> None:
        """Bind without looking up the name of this machine, which can take seconds without a network."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, int(self.server_address[1])

    @property
    def address(self) -> str:
        """Return the address of the page."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a traceback, unless the browser has only closed the connection."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    # A connection ends with its answer, so what is left of a request is never read as the next one.
    protocol_version = "HTTP/1.0"
    server_version, sys_version = "cadam3d", ""
    timeout = IDLE_SECONDS
    server: Server

    def do_GET(self) -> None:
        """Answer with the page, a part of it, or a file that it offers."""
        if (name := self._admitted()) is None:
            return
        subject = self.server.subject
        if name == REPORT and self.token == self.server.token:
            self._redirect(f"/{self.server.report_token}/{REPORT}")
        elif name in FIXED:
            kind, content = FIXED[name]
            self._send(content(), kind)
        elif name in CURRENT:
            kind, make = CURRENT[name]
            with subject.turns:
                found = make(subject)
            self._refuse(HTTPStatus.NOT_FOUND, "There is nothing yet.") if found is None else self._send(
                found, kind
            )
        elif (file := subject.offered(name)) is not None:
            with file:
                self._send_file(file, name)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "There is no such page.")

    do_HEAD = do_GET

    def do_POST(self) -> None:
        """Pass a request of the page on to the run that trains."""
        if (name := self._admitted()) is None:
            return
        length = self.headers.get("Content-Length", "")
        # A page of another origin can make a browser send a request, but it cannot choose this header.
        if self.headers.get("Origin") != f"http://{self.headers['Host']}":
            self._refuse(HTTPStatus.FORBIDDEN, "Only the page itself may send this request.")
        elif name not in REQUESTS:
            self._refuse(HTTPStatus.NOT_FOUND, "There is no such request.")
        elif not length.isdecimal() or len(length) > 9 or int(length) > LONGEST_BODY:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "This request has no plausible length.")
        else:
            process = self.rfile.read(int(length)).decode("utf-8", "replace")
            with self.server.subject.turns:
                is_done = self.server.subject.ask(name, process)
            if is_done:
                self._send(b"", TEXT)
            else:
                self._refuse(
                    HTTPStatus.CONFLICT, "The run no longer trains, or its folder cannot be written."
                )

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing, because the address of a request has the token."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that the library refuses, such as one with an unknown method."""
        self._refuse(HTTPStatus(code), message or explain or "This request cannot be answered.")

    def _admitted(self) -> str | None:
        """Return the part of the path after the token; None if the request was refused.

        With the token of the report, only the report and the files to which it links are left.
        """
        host, _, port = self.headers.get("Host", "").partition(":")
        parts = self.path.partition("?")[0].split("/", 2)
        self.token = parts[1] if parts[0] == "" and len(parts) > 1 else ""
        tokens = (self.server.token, self.server.report_token)
        known = [hmac.compare_digest(self.token.encode(), token.encode()) for token in tokens]
        if host not in OWN_NAMES or not (port.isdecimal() or not port):
            self._refuse(HTTPStatus.FORBIDDEN, "This name does not belong to this server.")
        elif not any(known):
            self._refuse(HTTPStatus.FORBIDDEN, "Open the whole address that cadam3d view has printed.")
        elif len(parts) == 2:
            self._redirect(f"/{self.token}/")
        elif known[1] and (self.command == "POST" or parts[2] not in (REPORT, *OFFERED)):
            self._refuse(HTTPStatus.FORBIDDEN, "The report has no access to this.")
        else:
            return parts[2]
        return None

    def _redirect(self, address: str) -> None:
        self._begin(HTTPStatus.FOUND, TEXT, 0, POLICY, {"Location": address})

    def _send(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._begin(status, kind, len(content), POLICY)
        if self.command != "HEAD":
            self.wfile.write(content)

    def _send_file(self, file: BinaryIO, name: str) -> None:
        is_report = name == REPORT
        size = signature(file)[2]
        policy = REPORT_POLICY if is_report else POLICY
        self._begin(HTTPStatus.OK, HTML if is_report else BYTES, size, policy)
        while self.command != "HEAD" and (piece := file.read(min(size, PIECE))):
            self.wfile.write(piece)
            size -= len(piece)

    def _begin(
        self, status: HTTPStatus, kind: str, length: int, policy: str, more: Mapping[str, str] | None = None
    ) -> None:
        self.send_response(status)
        for header, value in (HEADERS | dict(more or {})).items():
            self.send_header(header, value)
        self.send_header("Content-Security-Policy", policy)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.end_headers()

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self._send(f"{text}\n".encode(), TEXT, status)
