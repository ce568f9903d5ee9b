"""A daemon's answer to "how are you": one line of JSON to whoever connects to its UNIX socket."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from pathlib import Path
from typing import Any

from agent.errors import LinkError
from agent.observers import DaemonState, Observer

ANSWER_LIMIT_BYTES = 1 << 20
STALE_AFTER_S = 5.0
"""The state is noted once a second; an older one is that of a daemon which does not get on."""


class HealthSocket(Observer):
    """Serves the state of the last second at ``path``; who may connect is a matter of the folder's permissions."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._server: asyncio.Server | None = None
        self._state: dict[str, object] = {"state": "init", "reasons": []}
        self._noted_s = time.monotonic()

    async def open(self) -> None:
        """Listen; raises `LinkError` naming the socket."""
        try:
            self._server = await asyncio.start_unix_server(self._answer, self._path)
        except OSError as error:
            raise LinkError(f"health socket {self._path}: cannot be opened: {error.strerror}") from error

    def on_second(self, state: DaemonState) -> None:
        self._state, self._noted_s = state.as_dict(), time.monotonic()

    async def close(self, state: DaemonState) -> None:
        if self._server is not None:
            self._server.close()
            self._path.unlink(missing_ok=True)

    async def _answer(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answer = self._state | {"age_s": time.monotonic() - self._noted_s}
        writer.write(json.dumps(answer).encode() + b"\n")
        try:
            await writer.drain()
        except ConnectionError:  # who asked has gone
            return
        finally:
            writer.close()


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
