"""Truth from CSV files, one per agent: ``n, e, d`` (NED m), a clock, and maybe ``vn, ve, vd`` and ``qw``..``qz``.

The clock is ``unix_s`` (or ``time_unix_s``) or ``time_boot_s`` of the autopilot; a file that has both also says how
the two belong together, which lays logs of boot time side by side. Lines that begin with ``#`` are left out, but for
``lat LAT lon LON alt ALT`` in them: the origin of the file's frame, if it is another than the fleet's.
"""

from __future__ import annotations

import bisect
import csv
import gzip
import io
import itertools
import math
import re
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from agent.frames import FleetFrame
from agent.samples import Quaternion, Triple
from sim_bridge.logs.events import TruthSample
from sim_bridge.replay.errors import ReplayError

POSITION, VELOCITY, QUATERNION = ("n", "e", "d"), ("vn", "ve", "vd"), ("qw", "qx", "qy", "qz")
UNIX_NAMES, BOOT_NAME = ("unix_s", "time_unix_s"), "time_boot_s"
_ORIGIN = re.compile(r"lat\s+(-?[\d.]+)\s+lon\s+(-?[\d.]+)\s+alt\s+(-?[\d.]+)")
PLACE_TOLERANCE_M = 1e-3
MEDIAN_LINES = 101
"""Two seconds of the usual 50 Hz."""
Row = dict[str, float]
"""One line's numbers by their column."""


@dataclass(slots=True)
class TruthFile:
    """One file; ``skipped`` counts the lines left out by the last reading, by reason."""

    path: Path
    frame: FleetFrame
    skipped: Counter[str] = field(default_factory=Counter)

    def unix_of_boot_s(self) -> float | None:
        """Unix time at boot: the median over the file, since the recorder's stamps are late by their jitter.

        ``None`` where the file lacks one of the clocks.
        """
        differences = [
            row[unix] - row[BOOT_NAME]
            for row in self._rows()
            for unix in UNIX_NAMES
            if unix in row and BOOT_NAME in row
        ]
        return sorted(differences)[len(differences) // 2] if differences else None

    def samples(self, clock: str) -> Iterator[TruthSample]:
        """The states on a clock, ``unix`` or ``boot``, rising; raises `ReplayError` where the file lacks that clock.

        Unix time of a file with both clocks is the boot time plus the running median of their difference: a
        recorder's stamps jitter, the autopilot's do not.
        """
        self.skipped.clear()
        last_s = -math.inf
        for time_s, row in self._boot_timed() if clock == "boot" else self._unix_timed():
            if time_s <= last_s:
                self.skipped["time not rising"] += 1
                continue
            last_s = time_s
            position, velocity = _triple(row, POSITION), _triple(row, VELOCITY)
            assert position is not None
            yield TruthSample(time_s, self._moved(position), velocity, _quaternion(row))

    def has_boot_clock(self) -> bool:
        """Whether the file gives the autopilot's own time."""
        return any(BOOT_NAME in row for row in itertools.islice(self._rows(), 1))

    def _boot_timed(self) -> Iterator[tuple[float, Row]]:
        for row in self._rows():
            if BOOT_NAME not in row:
                raise ReplayError(self.path, f"truth: a column {BOOT_NAME}", f"{', '.join(row)}")
            yield row[BOOT_NAME], row

    def _unix_timed(self) -> Iterator[tuple[float, Row]]:
        held: deque[tuple[float, Row]] = deque()
        offsets: deque[float] = deque()
        ordered: list[float] = []
        for row in self._rows():
            unix_s = next((row[name] for name in UNIX_NAMES if name in row), None)
            if unix_s is None:
                raise ReplayError(self.path, f"truth: a column {' or '.join(UNIX_NAMES)}", f"{', '.join(row)}")
            if BOOT_NAME not in row:
                yield unix_s, row
                continue
            held.append((row[BOOT_NAME], row))
            offsets.append(unix_s - row[BOOT_NAME])
            bisect.insort(ordered, offsets[-1])
            if len(offsets) > MEDIAN_LINES:
                del ordered[bisect.bisect_left(ordered, offsets.popleft())]
            if len(held) > MEDIAN_LINES // 2:
                boot_s, middle = held.popleft()
                yield boot_s + ordered[len(ordered) // 2], middle
        for boot_s, row in held:
            yield boot_s + ordered[len(ordered) // 2], row

    def _moved(self, position_m: Triple) -> Triple:
        north, east, down = position_m
        dn, de, dd = self._shift_m
        return north + dn, east + de, down + dd

    _shift_m: Triple = (0.0, 0.0, 0.0)

    def _rows(self) -> Iterator[Row]:
        """The lines as numbers by name; those that are none are counted."""
        with self.path.open("rb") as raw:
            packed = raw.peek(2)[:2] == b"\x1f\x8b"
            with gzip.open(raw) if packed else raw as unpacked:
                text = io.TextIOWrapper(unpacked, encoding="utf-8", errors="replace", newline="")
                try:
                    yield from self._parsed(text)
                except (EOFError, gzip.BadGzipFile):
                    self.skipped["the file ends early"] += 1

    def _parsed(self, text: io.TextIOWrapper) -> Iterator[Row]:
        names: list[str] = []
        for cells in csv.reader(text):
            if not cells:
                continue
            if cells[0].startswith("#"):
                self._take_origin(",".join(cells))
            elif not names:
                names = self._header(cells)
            else:
                try:
                    row = dict(zip(names, map(float, cells), strict=True))
                except ValueError:
                    self.skipped["no numbers"] += 1
                    continue
                if all(map(math.isfinite, row.values())):
                    yield row
                else:
                    self.skipped["not finite"] += 1
        if not names:
            raise ReplayError(self.path, "truth: a header line with n, e, d", "an empty file")

    def _header(self, cells: list[str]) -> list[str]:
        names = [cell.strip() for cell in cells]
        if not set(POSITION) <= set(names):
            raise ReplayError(self.path, "truth: a header line with n, e, d", repr(",".join(names))[:80])
        return names

    def _take_origin(self, comment: str) -> None:
        match = _ORIGIN.search(comment)
        if match:
            lat, lon, alt = map(float, match.groups())
            place = self.frame.ned(lat, lon, alt)
            self._shift_m = place if max(map(abs, place)) > PLACE_TOLERANCE_M else (0.0, 0.0, 0.0)


def _triple(row: Row, names: tuple[str, str, str]) -> Triple | None:
    if not all(name in row for name in names):
        return None
    a, b, c = names
    return row[a], row[b], row[c]


def _quaternion(row: Row) -> Quaternion | None:
    if not all(name in row for name in QUATERNION):
        return None
    w, x, y, z = (row[name] for name in QUATERNION)
    return w, x, y, z
