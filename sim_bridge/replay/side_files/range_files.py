"""Ranges from a file: CSV with a header line, or JSON lines; one range per line, or a ``uwb-range/1`` frame.

===========  ==================================================  =======================================
column       also accepted as                                    meaning
===========  ==================================================  =======================================
time         time_s, time_unix_s, timestamp                      Unix s from 1e9 on, else s after the start
observer     node1, from                                         id of the agent that measured
target       node2, to                                           id of the other
range_m      uwb_range, range                                    m
sigma_m      sigma                                               1-sigma in m; absent = the configured one
true_m       mocap_range, truth                                  true distance in m, for `fleetloc ranges`
tag          observer_tag                                        antenna of the observer, 0..15; absent = 0
other_tag    target_tag                                          antenna of the other, likewise
===========  ==================================================  =======================================

A line that cannot be used is counted by reason with the numbers of the first such lines; it stops nothing.
"""

from __future__ import annotations

import csv
import heapq
import json
import math
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.side_files.text_lines import text_lines
from transport.errors import Rejected
from transport.messages.uwb_body import MAX_RANGE_M, MAX_TAGS, UwbFrame, decode_uwb

NAMES: Mapping[str, tuple[str, ...]] = {
    "time": ("time", "time_s", "time_unix_s", "timestamp"),
    "observer": ("observer", "node1", "from"),
    "target": ("target", "node2", "to"),
    "range_m": ("range_m", "uwb_range", "range"),
    "sigma_m": ("sigma_m", "sigma"),
    "true_m": ("true_m", "mocap_range", "truth"),
    "tag": ("tag", "observer_tag"),
    "other_tag": ("other_tag", "target_tag", "otag"),
}
REQUIRED = ("time", "observer", "target", "range_m")
_EXPECTED = f"a header line with the columns {', '.join(REQUIRED)}, or JSON lines"
UNIX_FROM_S = 1e9
"""Times from here on (2001) are Unix time."""
REORDERED_LINES = 512
"""So many lines are held back to put them into the order of their times."""
LINES_NAMED = 5


Numbered = Generator[tuple[int, str], None, None]
"""Lines of a file with their numbers."""


@dataclass(frozen=True, slots=True)
class RangeLine:
    """One range as the file has it: ids, metres; ``sigma_m`` and ``true_m`` are ``None`` where they are absent."""

    time_s: float
    observer: int
    target: int
    range_m: float
    sigma_m: float | None
    true_m: float | None = None
    tag: int = 0
    other_tag: int = 0


@dataclass(slots=True)
class RangeCounts:
    """What became of a file's lines; ``lines`` are the numbers of the first bad ones by reason."""

    read: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    lines: dict[str, list[int]] = field(default_factory=dict)

    def skip(self, reason: str, line: int) -> None:
        """A line that cannot be used."""
        self.skipped[reason] += 1
        named = self.lines.setdefault(reason, [])
        if len(named) < LINES_NAMED:
            named.append(line)

    def become(self, other: RangeCounts) -> None:
        """Count what another has counted, in place of what was counted here."""
        self.read, self.skipped, self.lines = other.read, other.skipped, other.lines


def read_ranges(path: Path, counts: RangeCounts) -> Iterator[RangeLine]:
    """The ranges of a file in the order of their times; memory does not grow with the file.

    Lines further out of order than `REORDERED_LINES` are counted and left out. Raises `ReplayError` for a file that
    is no list of ranges, `OSError` where it cannot be read.
    """
    return in_order(_lines(path, counts), counts)


def in_order(lines: Iterable[tuple[int, RangeLine]], counts: RangeCounts) -> Iterator[RangeLine]:
    """Numbered lines sorted by time, `REORDERED_LINES` at a time; those that come later still are counted."""
    waiting: list[tuple[float, int, int, RangeLine]] = []
    last_s = -math.inf
    for order, (number, line) in enumerate(lines):
        if line.time_s < last_s:
            counts.skip("out of order", number)
            continue
        heapq.heappush(waiting, (line.time_s, order, number, line))
        if len(waiting) > REORDERED_LINES:
            last_s, _, _, first = heapq.heappop(waiting)
            counts.read += 1
            yield first
    while waiting:
        counts.read += 1
        yield heapq.heappop(waiting)[3]


def _lines(path: Path, counts: RangeCounts) -> Iterator[tuple[int, RangeLine]]:
    numbered = text_lines(path, counts.skip)
    first = next(numbered, None)
    if first is None:
        raise ReplayError(path, f"ranges: {_EXPECTED}", "no line that can be read")
    if first[1].lstrip().startswith("{"):
        yield from _json_lines(first, numbered, counts)
    else:
        yield from _csv_lines(_columns(path, first[1]), numbered, counts)


def _csv_lines(columns: Mapping[str, int], rest: Numbered, counts: RangeCounts) -> Iterator[tuple[int, RangeLine]]:
    for number, text in rest:
        if text.startswith("#"):
            continue
        cells = next(csv.reader([text]))  # line by line: a stray quote costs its line only
        try:
            line = _line({name: cells[index] for name, index in columns.items() if index < len(cells)})
        except (KeyError, ValueError) as error:
            counts.skip(_reason(error), number)
            continue
        yield number, line


def _columns(path: Path, header: str) -> dict[str, int]:
    """Where each known column is; raises `ReplayError` naming what is missing."""
    found = [name.strip().lower() for name in next(csv.reader([header]))]
    columns = {name: found.index(spelling) for name, spelling in _spellings(found)}
    if not set(REQUIRED) <= columns.keys():
        raise ReplayError(path, f"ranges: {_EXPECTED}", repr(", ".join(found)[:80]))
    return columns


def _json_lines(first: tuple[int, str], rest: Numbered, counts: RangeCounts) -> Iterator[tuple[int, RangeLine]]:
    for number, text in chain([first], rest):
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            counts.skip("no JSON", number)
            continue
        try:
            if not isinstance(content, dict):
                raise ValueError("no object")
            lines = frame_lines(decode_uwb(text.encode())) if "obs" in content else [_line(_renamed(content))]
        except (KeyError, ValueError, Rejected) as error:
            counts.skip(_reason(error), number)
            continue
        for line in lines:
            yield number, line


def frame_lines(frame: UwbFrame) -> list[RangeLine]:
    """The ranges of a ``uwb-range/1`` frame; raises `ValueError` without observer or Unix time."""
    if frame.observer is None or frame.clock != "unix":
        raise ValueError("frame without observer or Unix time")
    return ranges_at(frame, frame.observer, frame.t_ns * 1e-9)


def ranges_at(frame: UwbFrame, observer: int, time_s: float) -> list[RangeLine]:
    """The ranges of a frame whose observer and time (Unix s) are known."""
    return [
        RangeLine(
            time_s + entry.offset_s,
            observer,
            entry.other,
            entry.range_m,
            entry.sigma_m,
            tag=entry.tag,
            other_tag=entry.other_tag,
        )
        for entry in frame.ranges
    ]


def _renamed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a JSON object under our names."""
    return {name: content[spelling] for name, spelling in _spellings(content)}


def _spellings(found: Collection[str]) -> Iterator[tuple[str, str]]:
    """Our name and the file's of every column that is there; the first spelling in the table counts."""
    for name, spellings in NAMES.items():
        spelling = next((spelling for spelling in spellings if spelling in found), None)
        if spelling is not None:
            yield name, spelling


def _line(values: Mapping[str, Any]) -> RangeLine:
    """A checked line; raises `KeyError` or `ValueError` saying what is wrong with it."""
    time_s, range_m = _number(values, "time"), _number(values, "range_m")
    observer, target = _id(values, "observer"), _id(values, "target")
    if observer == target:
        raise ValueError("observer is target")
    if not 0.0 < range_m <= MAX_RANGE_M:
        raise ValueError("range_m out of range")
    sigma_m, true_m = (_number(values, name) if values.get(name) not in (None, "") else None
                       for name in ("sigma_m", "true_m"))  # fmt: skip
    if sigma_m is not None and sigma_m <= 0.0:
        raise ValueError("sigma_m not positive")
    tags = _tag(values, "tag"), _tag(values, "other_tag")
    return RangeLine(time_s, observer, target, range_m, sigma_m, true_m, *tags)


def _number(values: Mapping[str, Any], name: str) -> float:
    try:
        value = float(values[name])
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} no number") from error
    if not math.isfinite(value):
        raise ValueError(f"{name} not finite")
    return value


def _id(values: Mapping[str, Any], name: str) -> int:
    value = _number(values, name)
    if value != int(value) or not 1 <= value <= 0xFFFF:
        raise ValueError(f"{name} no id")
    return int(value)


def _tag(values: Mapping[str, Any], name: str) -> int:
    if values.get(name) in (None, ""):
        return 0
    value = _number(values, name)
    if value != int(value) or not 0 <= value < MAX_TAGS:
        raise ValueError(f"{name} no antenna")
    return int(value)


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"{error.args[0]} missing"
    if isinstance(error, Rejected):
        return f"frame: {error.reason}"
    return str(error)
