"""Truth from CSV files, one per agent: ``n, e, d`` (NED m), a clock, and maybe ``vn, ve, vd`` and ``qw``..``qz``.

The clock is ``unix_s`` (or ``time_unix_s``) or ``time_boot_s`` of the autopilot; a file that has both also says how
the two belong together, which lays logs of boot time side by side. Lines that begin with ``#`` are left out, but for
``lat LAT lon LON alt ALT`` in them: the origin of the file's frame, if it is another than the fleet's.
"""

from __future__ import annotations

import bisect
import csv
import itertools
import math
import re
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Quaternion, Triple
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.logs.events import TruthSample
from sim_bridge.replay.logs.stamps import rising
from sim_bridge.replay.side_files.text_lines import text_lines

POSITION, VELOCITY, QUATERNION = ("n", "e", "d"), ("vn", "ve", "vd"), ("qw", "qx", "qy", "qz")
UNIX_NAMES, BOOT_NAME = ("unix_s", "time_unix_s"), "time_boot_s"
_ORIGIN = re.compile(r"lat\s+{0}\s+lon\s+{0}\s+alt\s+{0}".format(r"([-+.\d][-+.\deE]*)"))
MAX_HEIGHT_M = 1e5
MAX_NUMBER = 1e12
"""No time, place or speed is as large."""
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
        for time_s, row in rising(self._boot_timed() if clock == "boot" else self._unix_timed(), self.skipped):
            position, velocity = _triple(row, POSITION), _triple(row, VELOCITY)
            assert position is not None
            yield TruthSample(time_s, position, velocity, _quaternion(row))

    def has_boot_clock(self) -> bool:
        """Whether the file gives the autopilot's own time."""
        return any(BOOT_NAME in row for row in itertools.islice(self._rows(), 1))

    def _boot_timed(self) -> Iterator[tuple[float, Row]]:
        for row in self._rows():
            if BOOT_NAME not in row:
                raise ReplayError(self.path, f"truth: a column {BOOT_NAME}", repr(", ".join(row)[:80]))
            yield row[BOOT_NAME], row

    def _unix_timed(self) -> Iterator[tuple[float, Row]]:
        held: deque[tuple[float, Row]] = deque()
        offsets: deque[float] = deque()
        ordered: list[float] = []
        for row in self._rows():
            unix_s = next((row[name] for name in UNIX_NAMES if name in row), None)
            if unix_s is None:
                raise ReplayError(self.path, f"truth: a column {' or '.join(UNIX_NAMES)}", repr(", ".join(row)[:80]))
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

    def _rows(self) -> Iterator[Row]:
        """The lines as numbers by name, places in the fleet's frame; those that are none are counted."""
        names: list[str] = []
        shift_m: Triple = (0.0, 0.0, 0.0)
        for _, line in text_lines(self.path, self._skip):
            if line.startswith("#"):
                shift_m = self._origin(line) or shift_m
                continue
            cells = next(csv.reader([line]))
            if not names:
                names = self._header(cells)
                continue
            try:
                row = dict(zip(names, map(float, cells), strict=True))
            except ValueError:
                self.skipped["no numbers"] += 1
                continue
            if not all(abs(number) <= MAX_NUMBER for number in row.values()):
                self.skipped["not finite or too large"] += 1
                continue
            for name, shift in zip(POSITION, shift_m, strict=True):
                row[name] += shift
            yield row
        if not names:
            raise ReplayError(self.path, "truth: a header line with n, e, d", "no line that can be read")

    def _skip(self, reason: str, _line: int) -> None:
        self.skipped[reason] += 1

    def _header(self, cells: list[str]) -> list[str]:
        names = [cell.strip() for cell in cells]
        if not set(POSITION) <= set(names):
            raise ReplayError(self.path, "truth: a header line with n, e, d", repr(",".join(names)[:80]))
        return names

    def _origin(self, comment: str) -> Triple | None:
        """Where the origin that a comment names is in the fleet's frame, NED m; ``None`` if it names none.

        Raises `ReplayError` for an origin that is none: the states would be anywhere.
        """
        match = _ORIGIN.search(comment)
        if match is None:
            return None
        try:
            lat_deg, lon_deg, alt_m = (float(word.rstrip(".")) for word in match.groups())
        except ValueError:
            lat_deg = lon_deg = alt_m = math.nan
        if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and abs(alt_m) <= MAX_HEIGHT_M):
            expected = "truth: lat LAT lon LON alt ALT of its origin in degrees and metres"
            raise ReplayError(self.path, expected, repr(match.group()[:80]))
        place = self.frame.ned(lat_deg, lon_deg, alt_m)
        return place if max(map(abs, place)) > PLACE_TOLERANCE_M else (0.0, 0.0, 0.0)


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
