"""Asking a daemon how it is, over its UNIX socket (`agent.watch.health_socket`).

A container engine asks every few seconds, so this imports nothing that takes time to load.
"""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

from agent.errors import LinkError

ANSWER_LIMIT_BYTES = 1 << 20
STALE_AFTER_S = 5.0
"""The state is noted once a second; an older one is that of a daemon which does not get on."""


def ask(path: Path, timeout_s: float) -> dict[str, Any]:
    """The state of the daemon behind a socket; raises `LinkError` naming the socket if it does not answer."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(timeout_s)
            connection.connect(str(path))
            answer = connection.makefile("rb").readline(ANSWER_LIMIT_BYTES)
        state: dict[str, Any] = json.loads(answer)
    except OSError as error:
        raise LinkError(f"health socket {path}: no answer: {error.strerror or error}") from error
    except ValueError as error:
        raise LinkError(f"health socket {path}: expected a line of JSON, found {answer[:40]!r}") from error
    return state
