"""Ports of this machine: taken ones, and some that are free."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

HOST = "127.0.0.1"
LOWEST, HIGHEST = 20_000, 32_000


@contextmanager
def bound(kind: int) -> Iterator[int]:
    """A port that is taken."""
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind((HOST, 0))
        if kind == socket.SOCK_STREAM:
            taken.listen()
        yield taken.getsockname()[1]


@contextmanager
def bound_in_a_row(kind: int, count: int) -> Iterator[int]:
    """The first of ports that are taken, each the next one's predecessor, below those the system gives out itself."""
    here = LOWEST + os.getpid() % ((HIGHEST - LOWEST) // 2)  # two processes that look at once do not meet
    for first in range(here, HIGHEST - count, count):
        with ExitStack() as stack:
            try:
                for port in range(first, first + count):
                    stack.enter_context(socket.socket(socket.AF_INET, kind)).bind((HOST, port))
            except OSError:
                continue
            yield first
            return
    raise AssertionError(f"no {count} free ports in a row between {LOWEST} and {HIGHEST}")


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """One that was free a moment ago."""
    return free_ports(kind, 1)[0]


def free_ports(kind: int, count: int) -> list[int]:
    """Different ones, that were free a moment ago."""
    with ExitStack() as stack:
        return [stack.enter_context(bound(kind)) for _ in range(count)]
