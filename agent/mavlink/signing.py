"""MAVLink 2 signing of one link: stamps what we send, judges what comes in; sans-I/O.

pymavlink's own check is not used: it notes a stream's stamp before it has verified the signature, so that one
forged frame with a stamp in the future shuts the real sender out for good. Here a stamp counts only once its
signature is good, and one that lies ahead of the wall clock is never noted, so that a frame captured while a
sender's clock was wrong does no harm either. Stamps are kept over restarts (`agent.mavlink.signing_stamps`), or
frames from before could be replayed after one.

Stamps count 10 microseconds since 2015 (https://mavlink.io/en/guide/message_signing.html).
"""

from __future__ import annotations

import hashlib
import hmac
from collections import Counter
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import msgspec

STAMP_EPOCH_UNIX_S = 1_420_070_400.0
STAMPS_PER_S = 100_000
MAX_AHEAD_S = 60.0
"""A stamp further ahead of the wall clock is refused."""
MAX_BEHIND_S = 60.0
"""The first stamp of a stream that was never heard before may be this old; after that, stamps only rise."""
SIGNED = 0x01
"""The incompatibility flag of a signed frame."""
SIGNATURE_BLOCK_BYTES, SIGNATURE_BYTES, HEADER_BYTES = 13, 6, 10
MAX_STAMP = 2**48 - 1
MAX_STREAMS = 4096

StreamKey = tuple[int, int, int]
"""(system id, component id, link id)."""


class Refusal(StrEnum):
    """Why a frame is not accepted; the value is the name under which it is counted."""

    UNSIGNED = "unsigned"
    FORGED = "bad signature"
    OLD = "old stamp"
    FUTURE = "future stamp"


class Stamps(msgspec.Struct):
    """What has to outlive a restart: our last stamp, and the last of each stream by ``system/component/link``."""

    own: int = 0
    streams: dict[str, int] = {}


class LinkSigning:
    """Signing of one link with a key of 32 bytes.

    ``unix_s`` is the wall clock, kept by the owner. ``refused`` counts frames by reason.
    """

    def __init__(self, key: bytes, *, unix_s: float, link_id: int = 0, stamps: Stamps | None = None) -> None:
        if len(key) != 32:
            raise ValueError(f"MAVLink key of {len(key)} bytes, expected 32")
        self._key, self._link_id = key, link_id
        self.unix_s = unix_s
        self.refused: Counter[str] = Counter()
        kept = stamps or Stamps()
        self._streams = _parsed(kept.streams)
        self._own = kept.own

    @property
    def stamps(self) -> Stamps:
        """What to keep."""
        streams = {"/".join(map(str, key)): stamp for key, stamp in self._streams.items()}
        return Stamps(self._own, streams)

    def prepare(self, packer: Any) -> None:
        """Have a pymavlink packer sign its next frame."""
        self._own = max(_stamp(self.unix_s), self._own + 1)
        signing = packer.signing
        signing.secret_key, signing.link_id, signing.timestamp = self._key, self._link_id, self._own
        signing.sign_outgoing = True

    def accepts(self, frame: bytes) -> bool:
        """Whether a whole frame (its checksum verified) is signed, authentic and newer than all of its stream."""
        refusal = self._refusal(frame)
        if refusal is not None:
            self.refused[refusal] += 1
        return refusal is None

    def _refusal(self, frame: bytes) -> Refusal | None:
        least = HEADER_BYTES + 2 + SIGNATURE_BLOCK_BYTES
        if len(frame) < least or frame[0] != 0xFD or not frame[2] & SIGNED:
            return Refusal.UNSIGNED
        expected = hashlib.sha256(self._key + frame[:-SIGNATURE_BYTES]).digest()[:SIGNATURE_BYTES]
        if not hmac.compare_digest(expected, frame[-SIGNATURE_BYTES:]):
            return Refusal.FORGED
        block = frame[-SIGNATURE_BLOCK_BYTES:]
        key = (frame[5], frame[6], block[0])
        stamp = int.from_bytes(block[1:7], "little")
        if self._is_ahead(stamp):
            return Refusal.FUTURE
        last = self._streams.get(key)
        if last is None or self._is_ahead(last):  # the latter: noted while our own clock was wrong
            last = _stamp(self.unix_s - MAX_BEHIND_S)
        if stamp <= last or (key not in self._streams and len(self._streams) >= MAX_STREAMS):
            return Refusal.OLD
        self._streams[key] = stamp
        return None

    def _is_ahead(self, stamp: int) -> bool:
        return stamp > _stamp(self.unix_s + MAX_AHEAD_S)


def _stamp(unix_s: float) -> int:
    return min(max(int((unix_s - STAMP_EPOCH_UNIX_S) * STAMPS_PER_S), 0), MAX_STAMP)


def _parsed(streams: Mapping[str, int]) -> dict[StreamKey, int]:
    found: dict[StreamKey, int] = {}
    for text, stamp in streams.items():
        parts = text.split("/")
        if len(parts) == 3 and all(part.isdecimal() for part in parts):
            found[(int(parts[0]), int(parts[1]), int(parts[2]))] = stamp
    return found
