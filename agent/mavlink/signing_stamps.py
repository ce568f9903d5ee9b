"""The stamps of a signed MAVLink link on disk, so that a restart of the daemon opens no door to replays."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import msgspec

from agent.errors import LogFileError
from agent.mavlink.signing import LinkSigning, Stamps
from agent.watch.observers import DaemonState, Observer
from transport.errors import KeyFileError
from transport.link.off_loop import off_loop
from transport.security.key_files import OTHERS, PRIVATE, check_mode, read_text, write_text

LOG = logging.getLogger("fleetloc.agent")
SAVE_EVERY_S = 10
"""A daemon that is killed forgets at most this much: its last frames could be replayed once."""


class StampFile:
    """The stamps of one agent's link, beside its keys."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> Stamps:
        """What was kept, nothing at the first start; raises `KeyFileError`."""
        if not self.path.exists():
            return Stamps()
        check_mode(self.path, forbidden=OTHERS, remedy=f"chmod 600 {self.path}")
        try:
            return msgspec.json.decode(read_text(self.path), type=Stamps)
        except msgspec.DecodeError as error:
            raise KeyFileError(f"{self.path}: not the stamps of a MAVLink link ({error}); remove the file") from None

    def save(self, stamps: Stamps) -> None:
        """Keep stamps; raises `LogFileError`."""
        try:
            write_text(self.path, msgspec.json.encode(stamps).decode("ascii"), PRIVATE)
        except KeyFileError as error:
            raise LogFileError(str(error)) from None


class StampKeeper(Observer):
    """Saves the stamps of a link every ten seconds and at the end, off the daemon's loop."""

    def __init__(self, signing: LinkSigning, file: StampFile) -> None:
        self._signing, self._file = signing, file
        self._seconds = 0
        self._saving: asyncio.Task[None] | None = None

    def on_second(self, state: DaemonState) -> None:
        """Save every tenth time."""
        self._seconds += 1
        if self._seconds % SAVE_EVERY_S == 0 and (self._saving is None or self._saving.done()):
            self._saving = asyncio.get_running_loop().create_task(self._save())

    async def close(self, state: DaemonState) -> None:
        """Save for the next start."""
        if self._saving is not None:
            await self._saving
        await self._save()

    async def _save(self) -> None:
        try:
            await off_loop(self._file.save, self._signing.stamps)
        except LogFileError as error:  # a full disk does not end a flight
            LOG.warning("mavlink signing: %s", error)
