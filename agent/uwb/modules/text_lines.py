"""Bytes of a text console to lines, bounded in length and counted."""

from __future__ import annotations

from collections.abc import Iterator

from agent.uwb.modules.reading import ByteCounts

LONGEST_LINE = 4096
_ENDS = (0x0A, 0x0D)


class TextLines:
    """Splits at CR and LF. The bytes of each line, its end included, are the caller's to count."""

    def __init__(self, counts: ByteCounts) -> None:
        self._counts = counts
        self._buffer = bytearray()
        self._too_long = False

    @property
    def rest(self) -> bytes:
        """The line that has not ended yet: a prompt, or what is still on its way."""
        return bytes(self._buffer)

    def feed(self, data: bytes) -> Iterator[tuple[bytes, int]]:
        """Lines without their ends, and how many bytes each took."""
        self._counts.fed += len(data)
        for byte in data:
            self._buffer.append(byte)
            if byte in _ENDS:
                line, size = bytes(self._buffer[:-1]), len(self._buffer)
                self._buffer.clear()
                if self._too_long:
                    self._counts.refused["too long"] += size
                    self._too_long = False
                else:
                    yield line, size
            elif len(self._buffer) >= LONGEST_LINE:
                self._counts.refused["too long"] += len(self._buffer)
                self._buffer.clear()
                self._too_long = True
