"""Decawave DWM1001 with PANS: lines of the shell commands ``lec`` and ``les``, from a tag to anchors.

After the vendor's API guide; held to lines that modules printed, as public sources quote them::

    DIST,2,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,0.00,5.68,POS,6.95,5.37,-1.97,52
    022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49 le_us=3082 est[6.97,5.17,-1.77,53]

An anchor is its 16-bit address in hex, where the shell's configuration puts it, and its distance in m. Modules print
lines into each other at high rates, and there is no checksum: a line that is not whole is refused as a whole. A digit
that went missing before the point shows nowhere.
"""

from __future__ import annotations

import re

from agent.uwb.modules.reading import ByteCounts, ModuleRange, Reading
from agent.uwb.modules.text_lines import TextLines
from transport.messages.uwb_body import MAX_RANGE_M

BAUD = 115_200
PROMPT = b"dwm> "
WAKE = b"\r\r"
"""Twice within a second: the shell opens."""
START = b"lec\r"
"""Switches the lines on, and off again."""
_NUMBER = rb"-?\d{1,4}\.\d\d"
_DIST = re.compile(
    rb"DIST,(\d{1,2})((?:,AN\d{1,2},[0-9A-Fa-f]{4}(?:,%b){4})*)(?:,POS(?:,%b){3},\d{1,3})?" % (_NUMBER, _NUMBER)
)
_ANCHOR = re.compile(rb",AN(\d+),([0-9A-Fa-f]{4})(?:,%b){3},(%b)" % (_NUMBER, _NUMBER))
_LES = re.compile(
    rb"((?:[0-9A-Fa-f]{4}\[%b,%b,%b\]=%b ?)+)(?:le_us=\d+ ?)?(?:est\[(?:%b,){3}\d{1,3}\])?" % ((_NUMBER,) * 5)
)
_LES_ANCHOR = re.compile(rb"([0-9A-Fa-f]{4})\[[^\]]*\]=(%b)" % _NUMBER)
_SPEAKS = re.compile(rb"DIST|\]=|\d,POS,")


class Dwm1001Parser:
    """Bytes of a DWM1001's shell to readings."""

    def __init__(self) -> None:
        self.counts = ByteCounts()
        self._lines = TextLines(self.counts)

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
        """A line may go on after a pause: a prompt waits for its command."""
        return []

    def wake(self) -> bytes:
        """What to send to a module that brings no ranges: opens its shell; once it has answered, switches them on."""
        if self._lines.rest.endswith(PROMPT):
            return START
        return WAKE

    def _line(self, line: bytes, size: int) -> Reading | None:
        text = line.strip()
        while text.startswith(PROMPT.strip()):
            text = text.removeprefix(PROMPT.strip()).strip()
        anchors = _anchors(text)
        if anchors is None:
            if _SPEAKS.search(text):
                self.counts.refused["malformed"] += size
            else:
                self.counts.used += size
            return None
        if any(not 0.0 <= range_m <= MAX_RANGE_M for _, range_m in anchors):
            self.counts.refused["implausible"] += size
            return None
        self.counts.used += size
        ranges = tuple(ModuleRange(module, range_m) for module, range_m in anchors if range_m > 0.0)
        if len(ranges) < len(anchors):
            self.counts.left_out["no distance"] += len(anchors) - len(ranges)
        return Reading(ranges)


def _anchors(text: bytes) -> list[tuple[int, float]] | None:
    """Addresses and distances in a line of ranges; ``None`` for another, or one that is not whole."""
    dist = _DIST.fullmatch(text)
    if dist is not None:
        found = [(int(i), int(address, 16), float(d)) for i, address, d in _ANCHOR.findall(dist[2])]
        whole = [i for i, _, _ in found] == list(range(int(dist[1])))
    else:
        les = _LES.fullmatch(text)
        if les is None:
            return None
        found = [(0, int(address, 16), float(d)) for address, d in _LES_ANCHOR.findall(les[1])]
        whole = True
    if not whole or len({address for _, address, _ in found}) != len(found):
        return None
    return [(address, d) for _, address, d in found]
