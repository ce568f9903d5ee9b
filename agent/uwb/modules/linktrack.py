"""Nooploop LinkTrack: NodeFrame2 and NodeFrame3 of the NLink protocol, from node to node.

Little-endian, after the vendor's public unpacking library (nooploop-dev/nlink_unpack). It has sample bytes of
other frames, which the checksum here is held to; **no public sample confirms these two.**

NodeFrame3, 21 bytes before its nodes::

    0  55 05         4  role     6  local_time u32 ms    14  reserved, 4    20  nodes u8
    2  length u16    5  id      10  system_time u32 ms   18  voltage u16 mV
    node, 7 bytes: role, id, distance i24 mm, first path u8, received u8 (each -0.5 dBm)

NodeFrame2, 119 bytes before its nodes: ``55 04``, length, role, id, system_time at 6, local_time at 102, their count
at 118; its nodes have 6 more bytes. The last byte of a frame is the sum of all before it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from agent.uwb.modules.reading import ByteCounts, ModuleRange, Reading
from transport.messages.uwb_body import MAX_RANGE_M, MAX_RANGES

BAUD = 921_600
CLOCK_WRAP_S = 2.0**32 * 1e-3
HIGHEST_ROLE = 6
"""Node, anchor, tag, console, master, slave, monitor."""
_BEGIN = 0x55
_LENGTH = struct.Struct("<H")
_CLOCK = struct.Struct("<I")
_LEAST = 4
"""Bytes of a frame that tell its length."""


@dataclass(frozen=True, slots=True)
class _NodeLayout:
    """Where in a node frame what is, in bytes."""

    clock_at: int
    count_at: int
    node_bytes: int

    @property
    def fixed(self) -> int:
        return self.count_at + 1

    def length(self, nodes: int) -> int:
        return self.fixed + nodes * self.node_bytes + 1


NODE_FRAMES = {0x04: _NodeLayout(102, 118, 13), 0x05: _NodeLayout(6, 20, 7)}
"""By their second byte: NodeFrame2 and 3."""
FIXED_LENGTHS = {0x00: 896, 0x01: 128}
"""Anchor and tag frames, which do not tell their length."""
OTHERS = range(0x02, 0x0A)
"""Further frames that tell it; no ranges between nodes are taken from them."""
LONGEST_OTHER = 2048


class _NoFrame(Exception):
    """No frame begins here."""


class LinkTrackParser:
    """Bytes of a LinkTrack's port to readings.

    Besides the checksum, which one in 256 damaged frames passes, everything in a frame has to make sense: its length
    for its count, roles, distances, no node twice.
    """

    def __init__(self) -> None:
        self.counts = ByteCounts()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Reading]:
        """Take in bytes; what they completed."""
        self.counts.fed += len(data)
        self._buffer += data
        return list(self._readings(last=False))

    def pause(self) -> list[Reading]:
        """What is unfinished stays so."""
        return list(self._readings(last=True))

    def _readings(self, *, last: bool) -> Iterator[Reading]:
        while self._buffer:
            try:
                length = self._length()
                if length is None or len(self._buffer) < length:
                    if not last:
                        return
                    raise _NoFrame("incomplete")
                reading = self._frame(bytes(self._buffer[:length]))
            except _NoFrame as wrong:
                self._skip(str(wrong))
                continue
            del self._buffer[:length]
            self.counts.used += length
            if reading is not None:
                self.counts.readings += 1
                yield reading

    def _skip(self, reason: str) -> None:
        """Leave out the first byte, and all up to where a frame may begin."""
        begin = self._buffer.find(_BEGIN, 1)
        end = len(self._buffer) if begin < 0 else begin
        self.counts.refused[reason] += end
        del self._buffer[:end]

    def _length(self) -> int | None:
        """Of the frame that begins the buffer; ``None`` until it can be told. Raises `_NoFrame` where none begins."""
        buffer = self._buffer
        if buffer[0] != _BEGIN:
            raise _NoFrame("no frame")
        if len(buffer) < 2:
            return None
        mark = buffer[1]
        if mark in FIXED_LENGTHS:
            return FIXED_LENGTHS[mark]
        if mark not in OTHERS:
            raise _NoFrame("no frame")
        if len(buffer) < _LEAST:
            return None
        (length,) = _LENGTH.unpack_from(buffer, 2)
        layout = NODE_FRAMES.get(mark)
        if layout is None:
            if not _LEAST < length <= LONGEST_OTHER:
                raise _NoFrame("wrong length")
            return int(length)
        nodes, rest = divmod(length - layout.length(0), layout.node_bytes)
        if rest or not 0 <= nodes <= MAX_RANGES:
            raise _NoFrame("wrong length")
        if len(buffer) > layout.count_at and buffer[layout.count_at] != nodes:
            raise _NoFrame("wrong length")
        return int(length)

    def _frame(self, frame: bytes) -> Reading | None:
        """What a whole frame says, ``None`` for one of another kind; raises `_NoFrame`."""
        if sum(frame[:-1]) & 0xFF != frame[-1]:
            raise _NoFrame("wrong checksum")
        layout = NODE_FRAMES.get(frame[1])
        if layout is None:
            return None
        if frame[4] > HIGHEST_ROLE:
            raise _NoFrame("implausible")
        nodes = [
            _node(frame[at : at + layout.node_bytes]) for at in range(layout.fixed, len(frame) - 1, layout.node_bytes)
        ]
        if len({node.module for node in nodes}) != len(nodes):
            raise _NoFrame("implausible")
        ranges = tuple(node for node in nodes if node.range_m > 0.0)
        if len(ranges) < len(nodes):
            self.counts.left_out["no distance"] += len(nodes) - len(ranges)
        (clock_ms,) = _CLOCK.unpack_from(frame, layout.clock_at)
        return Reading(ranges, frame[5], clock_ms * 1e-3, CLOCK_WRAP_S)


def _node(node: bytes) -> ModuleRange:
    """One node's entry; raises `_NoFrame`."""
    range_m = int.from_bytes(node[2:5], "little", signed=True) * 1e-3
    if node[0] > HIGHEST_ROLE or not 0.0 <= range_m <= MAX_RANGE_M:
        raise _NoFrame("implausible")
    first_path_dbm, rx_dbm = -0.5 * node[5], -0.5 * node[6]
    known = node[5] > 0 and node[6] > 0
    return ModuleRange(node[1], range_m, rx_dbm if known else None, first_path_dbm if known else None)
