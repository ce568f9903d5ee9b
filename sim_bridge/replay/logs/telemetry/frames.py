"""MAVLink frames found in a telemetry log by their headers; only the wanted ones are decoded.

A ``.tlog`` repeats: 8 bytes big-endian Unix microseconds, one frame as it was on the wire (MAVLink 1, 2, signed).
Decoding every message with the codec's own parser takes ten times as long as all else of a replay, so frames
are cut out by length and checksum first. Signatures cannot be verified without the key and are not.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from itertools import accumulate
from typing import NamedTuple, Protocol

from agent.mavlink.codec import Message, mavlink

CHUNK_BYTES = 1 << 18
STAMP_BYTES = 8
V1, V2 = 0xFE, 0xFD
SIGNED, SIGNATURE_BYTES = 0x01, 13
LONGEST_RECORD_BYTES = STAMP_BYTES + 10 + 255 + 2 + SIGNATURE_BYTES
_HEADER_V1_BYTES, _HEADER_V2_BYTES, _CHECKSUM_BYTES = 6, 10, 2
_SHORTEST_RECORD_BYTES = STAMP_BYTES + _HEADER_V1_BYTES + _CHECKSUM_BYTES
_MAGIC = re.compile(b"[\xfd\xfe]")
_EXTRA = {message_id: bytes((kind.crc_extra,)) for message_id, kind in mavlink.mavlink_map.items()}


class Readable(Protocol):
    """A binary file, as far as it is needed here."""

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes, none at the end."""


class Frame(NamedTuple):
    """A frame with a correct checksum."""

    stamp_us: int
    system_id: int
    component_id: int
    message_id: int
    payload: bytes
    """As sent: MAVLink 2 cuts trailing zeros."""


class FrameReader:
    """The wanted frames of a log, in order, in memory that does not grow with it.

    ``skipped`` and ``notes`` count what else was there.
    """

    def __init__(self, file: Readable, wanted: frozenset[int], skipped: Counter[str], notes: Counter[str]) -> None:
        self._file = file
        self._wanted = wanted
        self._skipped = skipped
        self._notes = notes
        self.frames = 0
        """With a correct checksum, wanted or not."""

    def __iter__(self) -> Iterator[Frame]:
        data, at, final = b"", 0, False
        while not final:
            block = self._file.read(CHUNK_BYTES)
            final = not block
            data, at = data[at:] + block, 0
            # A record that may reach beyond what was read waits for the rest.
            limit = len(data) if final else len(data) - 2 * LONGEST_RECORD_BYTES
            while at < limit:
                length, frame = self._record(data, at)
                if length:
                    at += length
                    if frame is not None:
                        yield frame
                else:
                    start, at = at, self._resync(data, at, limit)
                    cut = final and at == limit and at - start < LONGEST_RECORD_BYTES
                    self._skipped["bytes of a cut last record" if cut else "garbage bytes"] += at - start

    def _record(self, data: bytes, at: int) -> tuple[int, Frame | None]:
        """Length of the record at ``at``, 0 if there is none, and its frame if it is good and wanted."""
        start = at + STAMP_BYTES
        length = _frame_length(data, start)
        if not length:
            return 0, None
        end = start + length
        if data[start] == V2:
            message_id = data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
            body, checked = start + _HEADER_V2_BYTES, end - _CHECKSUM_BYTES
            system, component = data[start + 5], data[start + 6]
            if data[start + 2] & SIGNED:
                checked -= SIGNATURE_BYTES
        else:
            message_id = data[start + 5]
            body, checked = start + _HEADER_V1_BYTES, end - _CHECKSUM_BYTES
            system, component = data[start + 3], data[start + 4]
        extra = _EXTRA.get(message_id)
        if extra is None:
            return self._unknown(data, at, end)
        if mavlink.x25crc(data[start + 1 : checked] + extra).crc != data[checked] | data[checked + 1] << 8:
            return self._bad(data, at, end)
        self.frames += 1
        if data[start] == V1:
            self._notes["MAVLink 1 frames"] += 1
        elif data[start + 2] & SIGNED:
            self._notes["signed frames"] += 1
        if message_id not in self._wanted:
            return end - at, None
        stamp_us = int.from_bytes(data[at:start], "big")
        return end - at, Frame(stamp_us, system, component, message_id, data[body:checked])

    def _unknown(self, data: bytes, at: int, end: int) -> tuple[int, None]:
        """A message outside the dialect: its checksum cannot be known, so that the next record must vouch for it."""
        if not _begins_record(data, end):
            return 0, None
        self._notes["unknown messages"] += 1
        return end - at, None

    def _bad(self, data: bytes, at: int, end: int) -> tuple[int, None]:
        """A wrong checksum: a damaged frame if the next record is where it should be, else no frame at all."""
        if not _begins_record(data, end):
            return 0, None
        self._skipped["bad checksum"] += 1
        return end - at, None

    def _resync(self, data: bytes, at: int, limit: int) -> int:
        """Start of the next record with a correct checksum behind ``at``, or ``limit`` if there is none yet."""
        for found in _MAGIC.finditer(data, at + STAMP_BYTES + 1):
            start = found.start() - STAMP_BYTES
            if start >= limit:
                break
            if is_frame(data, found.start()):
                return start
        return limit


def is_frame(data: bytes, start: int) -> int:
    """Bytes of the frame of the dialect with a correct checksum that begins here; 0 if none does."""
    length = _frame_length(data, start)
    if not length:
        return 0
    if data[start] == V2:
        message_id = data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
        end = start + length - (SIGNATURE_BYTES if data[start + 2] & SIGNED else 0)
    else:
        message_id, end = data[start + 5], start + length
    extra = _EXTRA.get(message_id)
    if extra is None:
        return 0
    crc: int = mavlink.x25crc(data[start + 1 : end - 2] + extra).crc
    return length if crc == data[end - 2] | data[end - 1] << 8 else 0


def _frame_length(data: bytes, start: int) -> int:
    """Bytes of the frame that begins here; 0 if none does or not all of it is there."""
    if start + _HEADER_V1_BYTES + _CHECKSUM_BYTES > len(data):
        return 0
    magic = data[start]
    if magic == V2:
        flags = data[start + 2]
        if flags & ~SIGNED:  # flags that are not understood forbid reading the frame
            return 0
        length = _HEADER_V2_BYTES + data[start + 1] + _CHECKSUM_BYTES + SIGNATURE_BYTES * flags
    elif magic == V1:
        length = _HEADER_V1_BYTES + data[start + 1] + _CHECKSUM_BYTES
    else:
        return 0
    return length if start + length <= len(data) else 0


def _begins_record(data: bytes, at: int) -> bool:
    """Whether a record, or the end of the data, is here."""
    magic = at + STAMP_BYTES
    return at == len(data) or (magic < len(data) and data[magic] in (V1, V2))


def decoded(message_id: int, payload: bytes) -> Message:
    """The message of a payload whose checksum was found correct; cut zeros are put back."""
    kind = mavlink.mavlink_map[message_id]
    values = kind.unpacker.unpack(payload[: kind.unpacker.size].ljust(kind.unpacker.size, b"\0"))
    if len(values) == len(kind.orders):
        return kind(*[values[order] for order in kind.orders])
    ends = list(accumulate(kind.lengths, initial=0))
    return kind(
        *[
            list(values[ends[order] : ends[order + 1]]) if kind.lengths[order] > 1 else values[ends[order]]
            for order in kind.orders
        ]
    )
