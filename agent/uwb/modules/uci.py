"""FiRa UCI (DWM3001CDK and SR150 with UCI firmware): notifications of two-way ranging.

Little-endian, after the FiRa consortium's UCI generic specification as the public packet description of Android's UCI
has it; held to bytes that a DWM3001CDK sent. There is no checksum: USB has its own, a bare UART has none. So all that
the layout leaves fixed is checked.

Packet: octet 0 is message type (3 bits), boundary flag (more follows), group; octet 1 opcode; octet 3 length. Ranging
is notification 3, group 2, opcode 0::

     0  sequence u32          9  interval u32 ms    15  address mode (0: 2, 1: 8 bytes)   24  measurements u8
     4  session u32          13  type (1: two-way)  16  primary session u32
     8  reserved             14  reserved, 0        20  reserved u32, 0
    measurement, 31 bytes: address 2 or 8, status, NLOS, distance u16 cm, angles 12, slot, RSSI, reserved 11 or 5
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from agent.uwb.modules.reading import ByteCounts, ModuleRange, Reading
from transport.messages.uwb_body import MAX_RANGE_M, MAX_RANGES

BAUD = 115_200
HEADER_BYTES = 4
TYPES = range(1, 4)
"""Command (an echo), response, notification."""
GROUPS = frozenset((0, 1, 2, 3, *range(9, 16)))
"""Core, session, ranging, data, vendors' and tests'."""
HIGHEST_OPCODE = 0x3F
RANGING = (3, 2, 0)
"""Type, group and opcode of what brings ranges."""
LONGEST_MESSAGE = 25 + 31 * MAX_RANGES + 1024
"""With what a vendor may add."""
_MORE = 0x10
_INFO = struct.Struct("<IIBIBBBIIB")
_MEASUREMENT_BYTES = 31
_TWO_WAY = 1
_NO_DISTANCE = 0xFFFF
_OK = 0


class _NoMessage(Exception):
    """No message that makes sense."""


def _may_begin(octet: int) -> bool:
    """Whether a packet can begin so."""
    return octet >> 5 in TYPES and octet & 0x0F in GROUPS


class UciParser:
    """Bytes of a UCI port to readings.

    A stream that lost its step finds it again at the next ranging notification.
    """

    def __init__(self) -> None:
        self.counts = ByteCounts()
        self._buffer = bytearray()
        self._parts = bytearray()
        """Payload so far of a message in several packets."""
        self._part_bytes = 0
        self._of: tuple[int, int, int] | None = None
        self._in_step = True
        self._last: dict[int, int] = {}
        """Sequence number of the last notification by session."""

    def feed(self, data: bytes) -> list[Reading]:
        """Take in bytes; what they completed."""
        self.counts.fed += len(data)
        self._buffer += data
        return list(self._readings(last=False))

    def pause(self) -> list[Reading]:
        """What is unfinished stays so."""
        readings = list(self._readings(last=True))
        self._drop_parts("incomplete")
        return readings

    def _readings(self, *, last: bool) -> Iterator[Reading]:
        while self._buffer:
            try:
                kind, end = self._header()
                if end is None or len(self._buffer) < end:
                    if not last:
                        return
                    raise _NoMessage("incomplete")
                reading = self._packet(kind, end)
            except _NoMessage as wrong:
                self._drop_parts(str(wrong))
                self._in_step = False
                del self._buffer[0]
                self.counts.refused[str(wrong)] += 1
                continue
            if reading is not None:
                self.counts.readings += 1
                yield reading

    def _drop_parts(self, reason: str) -> None:
        if self._part_bytes:
            self.counts.refused[reason] += self._part_bytes
        self._parts.clear()
        self._part_bytes, self._of = 0, None

    def _header(self) -> tuple[tuple[int, int, int], int | None]:
        """Kind of the packet that begins the buffer, and where it ends, if that is known; raises `_NoMessage`."""
        buffer = self._buffer
        kind = buffer[0] >> 5, buffer[0] & 0x0F, buffer[1] if len(buffer) > 1 else 0
        known = _may_begin(buffer[0]) and kind[2] <= HIGHEST_OPCODE
        if not known or (not self._in_step and kind != RANGING) or (len(buffer) > 2 and buffer[2]):
            raise _NoMessage("no packet")
        if len(buffer) < HEADER_BYTES:
            return kind, None
        return kind, HEADER_BYTES + buffer[3]

    def _packet(self, kind: tuple[int, int, int], end: int) -> Reading | None:
        """Take the packet that ends there off the buffer; raises `_NoMessage` before anything is taken."""
        if self._of is not None and kind != self._of:
            raise _NoMessage("incomplete")
        payload = bytes(self._parts) + bytes(self._buffer[HEADER_BYTES:end])
        if self._buffer[0] & _MORE:
            if len(payload) > LONGEST_MESSAGE:
                raise _NoMessage("too long")
            self._parts[:] = payload
            self._part_bytes, self._of = self._part_bytes + end, kind
            del self._buffer[:end]
            return None
        if len(self._buffer) > end and not _may_begin(self._buffer[end]):
            raise _NoMessage("out of step")
        reading = self._ranges(payload) if kind == RANGING else None
        self.counts.used += self._part_bytes + end
        self._part_bytes = 0
        self._drop_parts("")
        del self._buffer[:end]
        self._in_step = True
        return reading

    def _ranges(self, payload: bytes) -> Reading | None:
        """What a notification says, ``None`` where nothing new; raises `_NoMessage`."""
        if len(payload) < _INFO.size:
            raise _NoMessage("wrong length")
        sequence, session, _, interval_ms, kind, zero, mode, _, zeros, count = _INFO.unpack_from(payload)
        if kind != _TWO_WAY or zero or zeros or mode > 1 or not interval_ms:
            raise _NoMessage("implausible")
        if count > MAX_RANGES or len(payload) < _INFO.size + count * _MEASUREMENT_BYTES:
            raise _NoMessage("wrong length")
        found = [
            self._range(payload[at : at + _MEASUREMENT_BYTES], 8 if mode else 2)
            for at in range(_INFO.size, _INFO.size + count * _MEASUREMENT_BYTES, _MEASUREMENT_BYTES)
        ]
        if self._last.get(session) == sequence:
            self.counts.left_out["repeated"] += count
            return None
        if session not in self._last and len(self._last) >= MAX_RANGES:
            self._last.clear()
        self._last[session] = sequence
        return Reading(tuple(each for each in found if each is not None))

    def _range(self, entry: bytes, address_bytes: int) -> ModuleRange | None:
        """One measurement, ``None`` for one that failed; raises `_NoMessage`."""
        address = int.from_bytes(entry[:address_bytes], "little")
        status, nlos = entry[address_bytes], entry[address_bytes + 1]
        distance_cm = int.from_bytes(entry[address_bytes + 2 : address_bytes + 4], "little")
        slot_at = address_bytes + 16
        if any(entry[slot_at + 2 :]):
            raise _NoMessage("implausible")
        if status != _OK:
            self.counts.left_out["failed"] += 1
            return None
        range_m = distance_cm * 1e-2
        if distance_cm in (0, _NO_DISTANCE) or range_m > MAX_RANGE_M:
            self.counts.left_out["no distance"] += 1
            return None
        rssi = entry[slot_at + 1]
        return ModuleRange(
            address, range_m, -0.5 * rssi if 0 < rssi < 0xFF else None, None, float(nlos) if nlos <= 1 else None
        )
