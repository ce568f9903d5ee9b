"""Packets that an earlier daemon of this drone has taken already, so that a restart opens no door to replays.

They are dropped in front of the agent and of its flight log: a flight is repeated from what it has taken, and a
recording does not know what was before it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import msgspec

from agent.watch.saving import Saver
from transport.errors import KeyFileError, Reason, Rejected
from transport.link.off_loop import off_loop
from transport.messages.header import PacketKind, fleet_hash, unpack_header
from transport.security.key_files import OTHERS, PRIVATE, check_mode, read_text, write_text
from transport.security.replay_guard import ReplayGuard, Seen, StreamOf

LOG = logging.getLogger("fleetloc.agent")


class _SeenRecord(msgspec.Struct, frozen=True):
    sender: int
    kind: int
    boot: int
    newest: int
    window: str
    """Hexadecimal: 64 bits are more than JSON's numbers are good for."""


class EarlierPackets(Saver):
    """Keeps in ``path`` what ``state`` says was seen, and knows what was kept there before."""

    def __init__(self, path: Path, fleet: str, state: Callable[[], dict[StreamOf, Seen]]) -> None:
        """Read the file; one that is damaged is said and begun anew. Raises `KeyFileError` if others may write it."""
        super().__init__()
        self._path, self._fleet, self._state = path, fleet_hash(fleet), state
        self._before = _read(path)
        self._guard = ReplayGuard(self._before)
        self.refused = 0
        """Packets that were seen before the start."""

    def has(self, packet: bytes) -> bool:
        """Whether a signed packet was seen before the start; of one that is malformed others say so."""
        try:
            self._guard.check(unpack_header(packet, fleet=self._fleet, signed=True))
        except Rejected as rejected:
            seen = rejected.reason in (Reason.DUPLICATE, Reason.REPLAY)
            self.refused += seen
            return seen
        return False

    async def save(self) -> None:
        """Write the file anew; a disk that does not take it ends no flight."""
        kept = [
            _SeenRecord(sender, int(kind), seen.boot, seen.newest, f"{seen.window:x}")
            for (sender, kind), seen in (self._before | self._state()).items()
        ]
        try:
            await off_loop(write_text, self._path, msgspec.json.encode(kept).decode("ascii"), PRIVATE)
        except KeyFileError as error:
            LOG.warning("packets seen: %s", error)


def _read(path: Path) -> dict[StreamOf, Seen]:
    if not path.exists():
        return {}
    check_mode(path, forbidden=OTHERS, remedy=f"chmod 600 {path}")
    try:
        kept = msgspec.json.decode(read_text(path), type=list[_SeenRecord])
        return {
            (each.sender, PacketKind(each.kind)): Seen(each.boot, each.newest, int(each.window, 16)) for each in kept
        }
    except (msgspec.DecodeError, ValueError) as error:
        LOG.warning("packets seen: %s cannot be used (%s); begun anew", path, error)
        return {}
