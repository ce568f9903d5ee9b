"""A web server for one page that nobody can make a burden: few connections at a time, each for a few seconds."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

MAX_CONNECTIONS = 8
"""Served at the same time; more are closed at once."""
MAX_SECONDS = 5.0
"""Of a connection, from its beginning; a slow one is cut off."""
CHECKED_EVERY_S = 0.2


class _Quiet(WSGIRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Who asks for metrics is of no interest."""


class BoundedServer(ThreadingMixIn, WSGIServer):
    """Serves a WSGI application at an address until `stop`. ``refused`` counts connections that were too many."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(
        self, host: str, port: int, application: Callable[..., Any], max_s: float = MAX_SECONDS
    ) -> None:
        """Listen; raises ``OSError``."""
        self._max_s = max_s
        self.address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        super().__init__((host, port), _Quiet)
        self.set_app(application)
        self.refused = 0
        self._began_s: dict[Any, float] = {}
        self._lock = threading.Lock()
        serve = self.serve_forever
        self._thread = threading.Thread(target=serve, args=(CHECKED_EVERY_S,), name="metrics", daemon=True)

    def server_bind(self) -> None:
        """Without asking a name server who we are, as the base class does."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]
        self.setup_environ()

    def start(self) -> None:
        """Serve on a thread."""
        self._thread.start()

    def stop(self) -> None:
        """Serve nobody any more."""
        self.shutdown()
        self.server_close()
        self._thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        """A connection: it gets a thread, if there are not too many."""
        with self._lock:
            is_free = len(self._began_s) < MAX_CONNECTIONS
            if is_free:
                self._began_s[request] = time.monotonic()
        if not is_free:
            self.refused += 1
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system has no more threads
            self.refused += 1
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        """A connection has come to its end."""
        with self._lock:
            self._began_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """From time to time: cut off who takes too long."""
        late_s = time.monotonic() - self._max_s
        with self._lock:
            slow = [request for request, began_s in self._began_s.items() if began_s < late_s]
        for request in slow:
            try:
                request.shutdown(socket.SHUT_RDWR)  # whoever waits for it wakes up, and ends it
            except OSError:
                continue

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Who hangs up in the midst of an answer is no fault of ours."""
