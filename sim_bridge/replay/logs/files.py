"""Log files as bytes: plain or gzip, an end that is missing counted instead of raised."""

from __future__ import annotations

import gzip
import io
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim_bridge.replay.logs.events import LogError

GZIP_MAGIC = b"\x1f\x8b"


class LogFile:
    """The content of a log file from its beginning.

    A damaged or cut gzip stream ends where it can no longer be unpacked, which ``skipped`` counts.
    """

    def __init__(self, file: io.BufferedReader | gzip.GzipFile, skipped: Counter[str]) -> None:
        self._file = file
        self._skipped = skipped
        self._ended = False

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes, none at the end."""
        pieces: list[bytes] = []
        missing = size
        while missing and not self._ended:
            try:
                # Unlike read, this gives what could be unpacked before the damage.
                piece = self._file.read1(missing)
            except (EOFError, zlib.error, gzip.BadGzipFile):
                self._skipped["gzip stream damaged from some byte on"] += 1
                piece = b""
            self._ended = not piece
            pieces.append(piece)
            missing -= len(piece)
        return b"".join(pieces)


@contextmanager
def opened(path: Path, skipped: Counter[str]) -> Iterator[LogFile]:
    """The content of a file, unpacked if its first bytes say gzip; raises `LogError` if it cannot be opened."""
    try:
        raw = path.open("rb")
    except FileNotFoundError:
        raise LogError(path, "a flight log", "no such file") from None
    except OSError as error:
        raise LogError(path, "a flight log", error.strerror or str(error)) from None
    with raw:
        packed = raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        raw.seek(0)
        if packed:
            with gzip.GzipFile(fileobj=raw, mode="rb") as unpacked:
                yield LogFile(unpacked, skipped)
        else:
            yield LogFile(raw, skipped)
