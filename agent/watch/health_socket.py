"""A daemon's answer to "how are you": one line of JSON to whoever connects to its UNIX socket."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

from agent.errors import OPENING_FAULTS, LinkError, cause_of
from agent.watch.observers import DaemonState, Observer

PROBE_TIMEOUT_S = 1.0


class HealthSocket(Observer):
    """Serves the state of the last second at ``path``; who may connect is a matter of the folder's permissions.

    A socket that a killed daemon left is taken over, one that is served is not.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._server: asyncio.Server | None = None
        self._file = (0, 0)
        self._state: dict[str, object] = {"state": "init", "reasons": []}
        self._noted_s = time.monotonic()

    async def open(self) -> None:
        """Listen; raises `LinkError` naming the socket."""
        try:
            if await self._is_served():
                raise LinkError(f"health socket {self._path}: another daemon listens there; expected one for each")
            self._server = await asyncio.start_unix_server(self._answer, self._path)
            self._file = self._file_there()
        except LinkError:
            raise
        except OPENING_FAULTS as error:
            raise LinkError(f"health socket {self._path}: cannot be opened: {cause_of(error)}") from error

    async def _is_served(self) -> bool:
        """Whether somebody listens at the path; raises `OSError` where that cannot be asked."""
        try:
            async with asyncio.timeout(PROBE_TIMEOUT_S):
                _, writer = await asyncio.open_unix_connection(self._path)
        except (FileNotFoundError, ConnectionRefusedError):
            return False
        except (BlockingIOError, TimeoutError):  # so many ask already
            return True
        writer.close()
        return True

    def _file_there(self) -> tuple[int, int]:
        """Which file is at the path; raises `OSError` if there is none."""
        status = self._path.stat()
        return status.st_dev, status.st_ino

    def on_second(self, state: DaemonState) -> None:
        self._state, self._noted_s = state.as_dict(), time.monotonic()

    async def close(self, state: DaemonState) -> None:
        if self._server is None:
            return
        try:
            if self._file_there() == self._file:  # before the server closes: until then no other file has its number
                self._path.unlink()
        except FileNotFoundError:  # somebody has tidied up
            return
        finally:
            self._server.close()

    async def _answer(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answer = self._state | {"age_s": time.monotonic() - self._noted_s}
        writer.write(json.dumps(answer).encode() + b"\n")
        try:
            await writer.drain()
        except ConnectionError:  # who asked has gone
            return
        finally:
            writer.close()
