"""Tables as lines of text: plain or gzip, whatever is at their beginning, their end or in between."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Generator
from pathlib import Path

MAX_LINE = 1 << 16
"""Characters; a longer line is none."""
GZIP_MAGIC = b"\x1f\x8b"

Skip = Callable[[str, int], None]
"""Counts a line that cannot be used: why, and its number."""


def text_lines(path: Path, skip: Skip) -> Generator[tuple[int, str], None, None]:
    """The lines of a file with their numbers from 1, without a byte order mark and without blank lines.

    Bytes that are not UTF-8 come as replacement characters. Lines longer than `MAX_LINE` are skipped, so that memory
    does not grow with the file, and so is what comes behind damage or a cut of a gzip stream. Raises `OSError` for a
    file that cannot be read.
    """
    with path.open("rb") as raw:
        packed = raw.peek(2)[:2] == GZIP_MAGIC
        with gzip.open(raw) if packed else raw as unpacked:
            text = io.TextIOWrapper(unpacked, encoding="utf-8-sig", errors="replace", newline="")
            number = 0
            try:
                while line := text.readline(MAX_LINE):
                    number += 1
                    if _is_cut(line):
                        while _is_cut(text.readline(MAX_LINE)):
                            pass
                        skip("line too long", number)
                    elif not line.isspace():
                        yield number, line
            except EOFError:
                skip("the file ends early", number)
            except (gzip.BadGzipFile, zlib.error):
                skip("gzip stream damaged from some byte on", number)


def _is_cut(piece: str) -> bool:
    """Whether a line goes on behind what was read of it."""
    return len(piece) == MAX_LINE and not piece.endswith(("\n", "\r"))
