"""Ports of this machine: taken ones, and some that are free."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

HOST = "127.0.0.1"


@contextmanager
def bound(kind: int) -> Iterator[int]:
    """A port that is taken."""
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind((HOST, 0))
        if kind == socket.SOCK_STREAM:
            taken.listen()
        yield taken.getsockname()[1]


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """One that was free a moment ago."""
    return free_ports(kind, 1)[0]


def free_ports(kind: int, count: int) -> list[int]:
    """Different ones, that were free a moment ago."""
    with ExitStack() as stack:
        return [stack.enter_context(bound(kind)) for _ in range(count)]
