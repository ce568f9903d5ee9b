"""Telemetry logs as ground stations write them: a big-endian Unix time in us before every MAVLink frame."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO

SUFFIX = ".tlog"
STAMP = struct.Struct(">Q")
MAVLINK_1, MAVLINK_2 = 0xFE, 0xFD
SIGNED = 0x01
MAX_FRAME_BYTES = 280


class TlogWriter:
    """Appends whole frames; raises `OSError` wherever the disk does."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.size_bytes = 0
        """Where the next stamp goes."""

    def write(self, frame: bytes, unix_s: float) -> None:
        """Append one frame."""
        self._stream.write(STAMP.pack(round(unix_s * 1e6)) + frame)
        self.size_bytes += STAMP.size + len(frame)

    def flush(self) -> None:
        """Give the operating system what is there."""
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def frame_bytes(start: bytes) -> int:
    """Length of the frame that begins with these (at least three) bytes; 0 if none does."""
    if len(start) < 3:
        return 0
    magic, payload, flags = start[:3]
    if magic == MAVLINK_2:
        return 12 + payload + (13 if flags & SIGNED else 0)
    return 8 + payload if magic == MAVLINK_1 else 0


def read_frames(stream: IO[bytes], offset: int) -> Iterator[bytes]:
    """The frames from a stamp at ``offset`` on; ends where the file does, or where it holds no frame."""
    stream.seek(offset)
    while True:
        start = stream.read(STAMP.size + 3)
        length = frame_bytes(start[STAMP.size :])
        if not length:
            return
        rest = stream.read(length - 3)
        if len(rest) < length - 3:
            return
        yield start[STAMP.size :] + rest
