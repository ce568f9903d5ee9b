"""The stamps of a signed MAVLink link on disk, so that a restart of the daemon opens no door to replays."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec

from agent.errors import LogFileError
from agent.mavlink.signing import LinkSigning, Stamps
from agent.watch.saving import Saver
from transport.errors import KeyFileError
from transport.link.off_loop import off_loop
from transport.security.key_files import OTHERS, PRIVATE, check_mode, read_text, write_text

LOG = logging.getLogger("fleetloc.agent")


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


class StampKeeper(Saver):
    """Saves the stamps of a link; what came since, before a daemon was killed, could be replayed once."""

    def __init__(self, signing: LinkSigning, file: StampFile) -> None:
        super().__init__()
        self._signing, self._file = signing, file

    async def save(self) -> None:
        """Write them; a disk that does not take them ends no flight."""
        try:
            await off_loop(self._file.save, self._signing.stamps)
        except LogFileError as error:
            LOG.warning("mavlink signing: %s", error)
