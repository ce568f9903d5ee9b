"""The metrics' web server under those who mean it ill: whoever says nothing costs few threads, not for long."""

from __future__ import annotations

import socket
import threading
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from agent.watch.metrics_server import MAX_CONNECTIONS, BoundedServer

HOST = "127.0.0.1"


def page(_environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
    start_response("200 OK", [("Content-Type", "text/plain")])
    return [b"ticks 40\n"]


@pytest.fixture
def server() -> Iterator[BoundedServer]:
    one = BoundedServer(HOST, 0, page, max_s=0.3)
    one.start()
    yield one
    one.stop()


def fetched(server: BoundedServer) -> bytes:
    with urllib.request.urlopen(f"http://{HOST}:{server.server_port}/metrics", timeout=10.0) as answer:
        return bytes(answer.read())


def test_half_open_connections_cost_few_threads_and_are_cut_off(server: BoundedServer) -> None:
    assert fetched(server) == b"ticks 40\n"
    before = threading.active_count()
    with ExitStack() as stack:
        # GIVEN many who connect and say half a line, or nothing
        idle = [
            stack.enter_context(socket.create_connection((HOST, server.server_port), timeout=10.0)) for _ in range(60)
        ]
        for number, each in enumerate(idle):
            if number % 2:
                try:
                    each.sendall(b"GET /metr")
                except ConnectionError:  # one too many: it is cut off already
                    continue
        # THEN each is hung up on: at once, or when its time is over
        for each in idle:
            assert _end(each)
        assert server.refused > 0
        assert threading.active_count() <= before + MAX_CONNECTIONS
    # AND who asks properly is answered, once those who were cut off have let go
    assert any(_answers(server) for _ in range(10_000))


def test_what_begins_slowly_and_goes_on_is_cut_off(server: BoundedServer) -> None:
    with socket.create_connection((HOST, server.server_port), timeout=10.0) as slow:
        slow.sendall(b"GET /metrics HTTP/1.0\r\n")
        with pytest.raises(ConnectionError):
            _say_without_end(slow)
    assert any(_answers(server) for _ in range(10_000))


def _answers(server: BoundedServer) -> bool:
    try:
        return fetched(server) == b"ticks 40\n"
    except OSError:
        return False


def _say_without_end(connection: socket.socket) -> None:
    """A header that does not end, until nobody listens any more."""
    while True:
        connection.sendall(b"x: y\r\n")


def _end(connection: socket.socket) -> bool:
    try:
        return connection.recv(1000) == b""
    except ConnectionResetError:
        return True
