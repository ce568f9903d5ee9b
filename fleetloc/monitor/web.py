"""The web page: one page, and the pictures as server-sent events; the standard library's server in threads.

It only ever shows: no request changes anything. A page of another site that a browser has open cannot read it,
since answers carry no permission for that and requests under a foreign host name are refused (DNS rebinding).
"""

from __future__ import annotations

import base64
import hashlib
import ipaddress
import re
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from threading import Condition, Lock, Thread

from fleetloc.errors import EnvironmentFault

MAX_VIEWERS = 16
WRITE_TIMEOUT_S = 5.0
"""A browser that takes nothing for so long is let go."""
KEEP_ALIVE_S = 2.0


class Board:
    """Where the newest picture hangs; any thread may wait for the next one."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._number = 0
        self._picture = b"{}"
        self.closed = False

    def show(self, picture: bytes) -> None:
        """Hang up a picture in place of the last."""
        with self._changed:
            self._number, self._picture = self._number + 1, picture
            self._changed.notify_all()

    def close(self) -> None:
        """No picture comes after."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def latest(self) -> bytes:
        """The picture that hangs now."""
        with self._changed:
            return self._picture

    def after(self, number: int, timeout_s: float) -> tuple[int, bytes | None]:
        """The newest picture's number and, if it is not ``number``, the picture; waits for one at most so long."""
        with self._changed:
            self._changed.wait_for(lambda: self._number != number or self.closed, timeout_s)
            return self._number, self._picture if self._number != number else None


def page() -> tuple[bytes, str]:
    """The page in one piece, and the policy that lets a browser run exactly its own script and style."""
    folder = resources.files("fleetloc.monitor") / "static"
    style, script, html = ((folder / f"page.{kind}").read_text("utf-8") for kind in ("css", "js", "html"))
    whole = html.replace("/*STYLE*/", style).replace("/*SCRIPT*/", script)
    policy = f"default-src 'none'; connect-src 'self'; style-src {_hash(whole, 'style')}; "
    policy += f"script-src {_hash(whole, 'script')}; img-src data:; base-uri 'none'; frame-ancestors 'none'"
    return whole.encode(), policy


def _hash(html: str, tag: str) -> str:
    match = re.search(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
    assert match is not None
    return f"'sha256-{base64.b64encode(hashlib.sha256(match[1].encode()).digest()).decode()}'"


class WebServer:
    """Serves a `Board` at ``host:port``; ``tracks`` gives, from any thread, where drones have been, as JSON."""

    def __init__(self, host: str, port: int, board: Board, tracks: Callable[[], bytes]) -> None:
        """Listen; raises `EnvironmentFault`."""
        self._board = board
        handler = type("Handler", (_Handler,), {"board": board, "tracks": staticmethod(tracks), "site": _Site(host)})
        try:
            self._server = _Server((host, port), handler)
        except OSError as error:
            where = f"monitor.host, monitor.port {host}:{port}"
            raise EnvironmentFault(f"{where}: cannot be listened on: {error.strerror or error}") from error
        self._thread = Thread(target=self._server.serve_forever, name="web", daemon=True)

    @property
    def url(self) -> str:
        """Where the page is."""
        host, port = self._server.server_address[:2]
        shown = f"[{host!s}]" if ":" in str(host) else str(host)
        return f"http://{shown}:{port}/"

    def start(self) -> None:
        """Serve from a thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop; blocks for a moment."""
        self._board.close()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away in mid-sentence is none of our business."""


class _Site:
    """What all requests share."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.page, self.policy = page()
        self._viewers = 0
        self._lock = Lock()

    def is_ours(self, host_header: str) -> bool:
        """Whether a request means us: by address, which no foreign name can be made to be, or by our own name."""
        host = host_header.rpartition(":")[0] if re.search(r":\d+$", host_header) else host_header
        try:
            ipaddress.ip_address(host.strip("[]"))
        except ValueError:
            return host in ("localhost", self.host)
        return True

    def enter(self) -> bool:
        """Count a viewer in; false if there are too many."""
        with self._lock:
            entered = self._viewers < MAX_VIEWERS
            self._viewers += entered
        return entered

    def leave(self) -> None:
        """Count a viewer out."""
        with self._lock:
            self._viewers -= 1


class _Handler(BaseHTTPRequestHandler):
    board: Board
    tracks: Callable[[], bytes]
    site: _Site
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "fleetloc", ""
    timeout = WRITE_TIMEOUT_S

    def do_GET(self) -> None:
        """The page, the picture of this moment, or all that come."""
        if not self.site.is_ours(self.headers.get("Host", "")):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "expected the address of this machine as Host")
        elif self.path == "/":
            self._answer("text/html; charset=utf-8", self.site.page)
        elif self.path == "/picture.json":
            self._answer("application/json", self.board.latest())
        elif self.path == "/events":
            self._stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND, "expected /, /picture.json or /events")

    def _answer(self, kind: str, body: bytes) -> None:
        self._begin(kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _begin(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", self.site.policy)
        self.send_header("X-Content-Type-Options", "nosniff")

    def _stream(self) -> None:
        if not self.site.enter():
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} pages are open already")
            return
        try:
            self._begin("text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            self._event(b"tracks", type(self).tracks())
            number = -1
            while not self.board.closed:
                number, picture = self.board.after(number, KEEP_ALIVE_S)
                if picture is None:
                    self.wfile.write(b": still here\n\n")
                else:
                    self._event(b"picture", picture)
        finally:
            self.site.leave()

    def _event(self, name: bytes, data: bytes) -> None:
        self.wfile.write(b"event: " + name + b"\ndata: " + data + b"\n\n")
        self.wfile.flush()

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not logged."""
