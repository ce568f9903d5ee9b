"""ArduPilot dataflash logs (``.BIN``) as records: the file describes its own formats in FMT records.

pymavlink's DFReader maps the whole file and keeps an index that grows with it, takes no gzip, and stops at
damage; this one streams, unpacks only the wanted records (five times as fast) and counts what was damaged.
There are no checksums in this format: a record is believed if it ends where another begins.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from sim_bridge.replay.logs.telemetry.frames import Readable

CHUNK_BYTES = 1 << 18
HEAD = b"\xa3\x95"
HEAD_BYTES = 3
FMT_TYPE, FMT_BYTES = 0x80, 89
FORMAT_OF_FORMAT = HEAD + bytes((FMT_TYPE, FMT_TYPE, FMT_BYTES)) + b"FMT\0"
"""How every dataflash log describes the record that describes records."""
LONGEST_RECORD_BYTES = 255
_FMT = struct.Struct("<BB4s16s64s")

_TYPES: dict[str, tuple[str, float | None]] = {
    "a": ("64s", None), "b": ("b", None), "B": ("B", None), "h": ("h", None), "H": ("H", None), "i": ("i", None),
    "I": ("I", None), "f": ("f", None), "d": ("d", None), "n": ("4s", None), "N": ("16s", None), "Z": ("64s", None),
    "c": ("h", 1e-2), "C": ("H", 1e-2), "e": ("i", 1e-2), "E": ("I", 1e-2), "L": ("i", 1e-7), "M": ("B", None),
    "q": ("q", None), "Q": ("Q", None), "g": ("e", None),
}  # fmt: skip
"""Characters of a format: how they are packed, and the factor to the unit (m, m/s, deg) where it is not 1."""
_TEXTS, _INTEGERS = frozenset("anNZ"), frozenset("bBhHiIMqQ")
_TEXT_LABEL = "Name"
_INTEGER_LABELS = frozenset(("TimeUS", "I", "C", "PI", "Status", "GMS", "GWk", "SMS", "Type"))
"""Wanted labels that are text, or whole numbers, in every layout; all others are numbers."""

Values = dict[str, Any]
"""The wanted fields of a record by label, in the log's units (m, m/s, rad/s, deg); absent where it has none."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """How to take the wanted fields out of a record of one type."""

    name: str
    length: int
    unpacker: struct.Struct
    labels: tuple[str, ...]
    places: tuple[int, ...]
    scales: tuple[float | None, ...]

    def values(self, data: bytes, at: int) -> Values:
        raw = self.unpacker.unpack_from(data, at + HEAD_BYTES)
        return {
            label: raw[place] if scale is None else raw[place] * scale
            for label, place, scale in zip(self.labels, self.places, self.scales, strict=True)
        }


class RecordReader:
    """The wanted records of a log, in order, as ``(name, values)``; memory does not grow with the log.

    ``wanted`` gives the labels to take of each record name, ``TimeUS`` among them. ``skipped`` and ``notes``
    count the rest.
    """

    def __init__(
        self,
        file: Readable,
        wanted: Mapping[str, tuple[str, ...]],
        skipped: Counter[str],
        notes: Counter[str],
    ) -> None:
        self._file = file
        self._wanted = wanted
        self._skipped = skipped
        self._notes = notes
        self._lengths: dict[int, int] = {FMT_TYPE: FMT_BYTES}
        self._layouts: dict[int, _Layout] = {}
        self.records = 0
        """Records of known types, wanted or not."""

    def __iter__(self) -> Iterator[tuple[str, Values]]:
        data, at, final = b"", 0, False
        while not final:
            block = self._file.read(CHUNK_BYTES)
            final = not block
            data, at = data[at:] + block, 0
            limit = len(data) if final else len(data) - LONGEST_RECORD_BYTES - HEAD_BYTES
            while at < limit:
                end = self._end(data, at)
                if not end:
                    start, at = at, self._resync(data, at, limit)
                    cut = final and at == limit and at - start < LONGEST_RECORD_BYTES
                    self._skipped["bytes of a cut last record" if cut else "garbage bytes"] += at - start
                    continue
                kind = data[at + 2]
                self.records += 1
                if kind == FMT_TYPE:
                    self._learn(data, at)
                else:
                    layout = self._layouts.get(kind)
                    if layout is not None:
                        yield layout.name, layout.values(data, at)
                at = end

    def _end(self, data: bytes, at: int) -> int:
        """End of the record of a known type that begins here; 0 if none does."""
        if data[at : at + 2] != HEAD or at + HEAD_BYTES > len(data):
            return 0
        end = at + self._lengths.get(data[at + 2], len(data) + 1)
        if end > len(data) or not (data.startswith(HEAD, end) or end == len(data)):
            return 0
        return end

    def _resync(self, data: bytes, at: int, limit: int) -> int:
        """The next place behind ``at`` where a record of a known type begins, or ``limit``."""
        found = data.find(HEAD, at + 1, limit + len(HEAD))
        while found >= 0 and found < limit:
            if self._end(data, found):
                return found
            found = data.find(HEAD, found + 1, limit + len(HEAD))
        return limit

    def _learn(self, data: bytes, at: int) -> None:
        """Take in the description of a type; the first one holds, a damaged one is counted."""
        kind, length, raw_name, raw_format, raw_labels = _FMT.unpack_from(data, at + HEAD_BYTES)
        if kind in self._lengths:
            return
        layout = self._layout(length, _text(raw_name), _text(raw_format), _text(raw_labels).split(","))
        if layout is None:
            self._skipped["damaged FMT record"] += 1
            return
        self._lengths[kind] = length
        if "TimeUS" in layout.labels:  # logs before 2014 have milliseconds instead
            self._layouts[kind] = layout
        elif layout.name in self._wanted:
            self._notes["kinds of records without TimeUS"] += 1

    def _layout(self, length: int, name: str, characters: str, labels: list[str]) -> _Layout | None:
        types = [_TYPES.get(character) for character in characters]
        known = [each for each in types if each is not None]
        if len(known) != len(types) or len(types) != len(labels):
            return None
        unpacker = struct.Struct("<" + "".join(packed for packed, _ in known))
        if unpacker.size + HEAD_BYTES != length:
            return None
        # a flipped bit makes another type of the same size, such as four characters (n) of a float (f)
        taken = [(label, labels.index(label)) for label in self._wanted.get(name, ()) if label in labels]
        if not all(_may_be(label, characters[place]) for label, place in taken):
            return None
        return _Layout(
            name,
            length,
            unpacker,
            tuple(map(itemgetter(0), taken)),
            tuple(map(itemgetter(1), taken)),
            tuple(known[place][1] for _, place in taken),
        )


def _may_be(label: str, character: str) -> bool:
    """Whether a wanted field can be of this type."""
    if label == _TEXT_LABEL:
        return character in _TEXTS
    return character in _INTEGERS if label in _INTEGER_LABELS else character not in _TEXTS


def _text(raw: bytes) -> str:
    return raw.rstrip(b"\0").decode("ascii", "replace")


def text_of(value: Any) -> str:
    """A text field (parameter name) without its padding."""
    return _text(value) if isinstance(value, bytes) else ""
