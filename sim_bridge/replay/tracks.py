"""What estimates are compared with, on disk: states of one drone over time, written as they come.

A track is a file of fixed entries (time, position, velocity; little-endian doubles), so that a run
of hours needs no more memory than one of seconds: reading maps the file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.sensing.samples import Triple

SUFFIX = ".track"
ENTRY = np.dtype([("t_s", "<f8"), ("position_m", "<f8", 3), ("velocity_mps", "<f8", 3)])
RANGE_ENTRY = np.dtype([("t_s", "<f8"), ("target", "<i4"), ("range_m", "<f8"), ("sigma_m", "<f8")])
FLUSH_ENTRIES = 256
UNKNOWN: Triple = (math.nan, math.nan, math.nan)
"""A velocity that the source does not give."""

Floats = NDArray[np.float64]


class TrackWriter:
    """Appends states in the order of their times; those that are not later than the last are left out."""

    def __init__(self, path: Path) -> None:
        """Make the file anew; raises `OSError` if that cannot be done."""
        self._file = path.open("wb")
        self._buffer = np.zeros(FLUSH_ENTRIES, ENTRY)
        self._held = 0
        self._last_s = -math.inf
        self.written = 0

    def write(self, t_s: float, position_m: Triple, velocity_mps: Triple | None) -> None:
        """One state, NED m and m/s at fleet time ``t_s``."""
        if not t_s > self._last_s:
            return
        self._last_s = t_s
        self._buffer[self._held] = (t_s, position_m, UNKNOWN if velocity_mps is None else velocity_mps)
        self._held += 1
        self.written += 1
        if self._held == FLUSH_ENTRIES:
            self._flush()

    def close(self) -> None:
        """Write out what is held; may be called again."""
        if not self._file.closed:
            self._flush()
            self._file.close()

    def _flush(self) -> None:
        self._file.write(self._buffer[: self._held].tobytes())
        self._held = 0


def track_path(directory: Path, kind: str, agent_id: int) -> Path:
    """The track of one kind of reference of one agent."""
    return directory / f"{kind}_{agent_id:03d}{SUFFIX}"


def measured_path(directory: Path, agent_id: int) -> Path:
    """The ranges that one agent measured."""
    return track_path(directory, "ranges", agent_id)


@dataclass(frozen=True, slots=True)
class MeasuredRange:
    """A range as its observer got it; ``sigma_m`` as the file or module claimed, ``None`` where it did not."""

    target: int
    range_m: float
    sigma_m: float | None


class MeasuredWriter:
    """Appends the ranges that an agent measures."""

    def __init__(self, path: Path) -> None:
        """Make the file anew; raises `OSError` if that cannot be done."""
        self._file = path.open("wb")

    def write(self, t_s: float, measured: MeasuredRange) -> None:
        """One range at fleet time ``t_s``."""
        sigma_m = math.nan if measured.sigma_m is None else measured.sigma_m
        entry = np.array([(t_s, measured.target, measured.range_m, sigma_m)], RANGE_ENTRY)
        self._file.write(entry.tobytes())

    def close(self) -> None:
        """Write out what is held; may be called again."""
        self._file.close()


def read_measured(path: Path) -> Iterator[tuple[float, MeasuredRange]]:
    """Fleet times and ranges of a file; none if it is not there."""
    if not path.exists() or path.stat().st_size < RANGE_ENTRY.itemsize:
        return
    for entry in np.memmap(path, RANGE_ENTRY, "r"):
        sigma_m = float(entry["sigma_m"])
        yield (
            float(entry["t_s"]),
            MeasuredRange(int(entry["target"]), float(entry["range_m"]), None if math.isnan(sigma_m) else sigma_m),
        )


class WrittenTrack:
    """A written track; ``entries`` is mapped, not read."""

    def __init__(self, path: Path) -> None:
        empty = not path.exists() or path.stat().st_size < ENTRY.itemsize
        self.entries: NDArray[np.void] = np.empty(0, ENTRY) if empty else np.memmap(path, ENTRY, "r")

    def __len__(self) -> int:
        return len(self.entries)

    def at(self, t_s: Floats, max_gap_s: float) -> Floats:
        """States ``(K, 6)`` at fleet times ``(K,)``; NaN outside and in gaps longer than ``max_gap_s``.

        Positions by cubic Hermite where the velocities are known, else linear. Velocities are interpolated, not those
        of the cubic: positions in whole 1e-7 degrees (1 cm) every 20 ms have slopes wrong by half a metre per second.
        """
        states = np.full((len(t_s), 6), np.nan)
        if len(self) < 2:
            return states
        times = self.entries["t_s"]
        right = np.clip(np.searchsorted(times, t_s, side="right"), 1, len(self) - 1)
        before, after = self.entries[right - 1], self.entries[right]
        step_s = after["t_s"] - before["t_s"]
        inside = (t_s >= before["t_s"]) & (t_s <= after["t_s"]) & (step_s <= max_gap_s)
        states[inside] = _hermite(before[inside], after[inside], t_s[inside])
        return states


def _hermite(before: Any, after: Any, t_s: Floats) -> Floats:
    step = (after["t_s"] - before["t_s"])[:, None]
    s = (t_s - before["t_s"])[:, None] / step
    p0, p1 = before["position_m"], after["position_m"]
    slope = (p1 - p0) / step
    m0, m1 = (step * np.where(np.isnan(end["velocity_mps"]), slope, end["velocity_mps"]) for end in (before, after))
    position = p0 + s * m0 + s**2 * (3 * (p1 - p0) - 2 * m0 - m1) + s**3 * (2 * (p0 - p1) + m0 + m1)
    return np.hstack((position, (m0 + s * (m1 - m0)) / step))
