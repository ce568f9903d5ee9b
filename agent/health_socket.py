"""A daemon's answer to "how are you": one line of JSON to whoever connects to its UNIX socket."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

from agent.errors import LinkError
from agent.observers import DaemonState, Observer


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
