"""Qorvo DWM3001CDK with the CLI firmware: the notifications of ``INITF`` and ``RESPF``.

After the vendor's developer manual and forum; held to lines that boards printed, as public sources quote them::

    SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=2
     [mac_address=0x0001, status="SUCCESS", distance[cm]=210, RSSI[dBm]=-78.0];
     [mac_address=0x0002, status="RX_TIMEOUT"]}

Whole centimetres. There is no checksum (USB has its own); a notification that is not whole is refused as a whole.
"""

from __future__ import annotations

import re

from agent.uwb.modules.reading import ByteCounts, ModuleRange, Reading
from agent.uwb.modules.text_lines import LONGEST_LINE, TextLines
from transport.messages.uwb_body import MAX_RANGE_M, MAX_RANGES

BAUD = 115_200
GOOD = (b"SUCCESS", b"Ok", b"OK")
"""How firmware of different age says that a measurement succeeded."""
_BEGIN = b"SESSION_INFO_NTF:"
_FIELD = rb"(?:, [A-Za-z_]+(?:\[[A-Za-z]+\])?=[-+.\w]+)*"
_ONE = rb'\[mac_address=0x[0-9a-fA-F]{4}(?:[0-9a-fA-F]{12})?, status="[A-Za-z_]+"%b\]' % _FIELD
_WHOLE = re.compile(
    rb"SESSION_INFO_NTF: ?\{session_handle=(\d{1,10}), sequence_number=(\d{1,10}), block_index=\d{1,10}, "
    rb"n_measurements=(\d{1,3})((?:;? *%b)*) *\}" % _ONE
)
_MEASUREMENT = re.compile(rb'\[mac_address=0x([0-9a-fA-F]+), status="(\w+)"(%b)\]' % _FIELD)
_DISTANCE = re.compile(rb", distance\[cm\]=(-?\d{1,6})(?=,|$)")
_POWER = re.compile(rb", RSSI\[dBm\]=(-?\d{1,3}(?:\.\d+)?)(?=,|$)")


class Dwm3001Parser:
    """Bytes of a DWM3001CDK's console to readings."""

    def __init__(self) -> None:
        self.counts = ByteCounts()
        self._lines = TextLines(self.counts)
        self._begun = b""
        """A notification as far as its lines have come."""
        self._size = 0
        self._last: tuple[bytes, bytes] | None = None

    def feed(self, data: bytes) -> list[Reading]:
        """Take in bytes; what they completed."""
        readings = []
        for line, size in self._lines.feed(data):
            reading = self._line(line, size)
            if reading is not None:
                self.counts.readings += 1
                readings.append(reading)
        return readings

    def pause(self) -> list[Reading]:
        """A notification does not stop halfway."""
        self._refuse("incomplete")
        return []

    def _refuse(self, reason: str) -> None:
        if self._size:
            self.counts.refused[reason] += self._size
        self._begun, self._size = b"", 0

    def _line(self, line: bytes, size: int) -> Reading | None:
        text = line.strip()
        if text.startswith(_BEGIN):
            self._refuse("incomplete")
            self._begun = text
        elif not self._begun:
            if b"mac_address" in text:
                self.counts.refused["malformed"] += size
            else:
                self.counts.used += size
            return None
        elif text:
            self._begun += b" " + text
        self._size += size
        if len(self._begun) > LONGEST_LINE:
            self._refuse("too long")
        elif self._begun.endswith(b"}"):
            return self._notification()
        return None

    def _notification(self) -> Reading | None:
        whole = _WHOLE.fullmatch(self._begun)
        found = [] if whole is None else _MEASUREMENT.findall(whole[4])
        if whole is None or int(whole[3]) != len(found) or len(found) > MAX_RANGES:
            self._refuse("malformed")
            return None
        self.counts.used += self._size
        self._begun, self._size = b"", 0
        if self._last == (whole[1], whole[2]):
            self.counts.left_out["repeated"] += len(found)
            return None
        self._last = whole[1], whole[2]
        ranges = (self._range(*each) for each in found)
        return Reading(tuple(each for each in ranges if each is not None))

    def _range(self, address: bytes, status: bytes, fields: bytes) -> ModuleRange | None:
        distance = _DISTANCE.search(fields)
        if status not in GOOD:
            self.counts.left_out["failed"] += 1
            return None
        range_m = 0.0 if distance is None else int(distance[1]) * 1e-2
        if not 0.0 < range_m <= MAX_RANGE_M:
            self.counts.left_out["no distance"] += 1
            return None
        power = _POWER.search(fields)
        return ModuleRange(int(address, 16), range_m, None if power is None else float(power[1]))
