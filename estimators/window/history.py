"""The measurement window: rows and inputs of the last N+1 ticks, in one order whatever order they came in."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, kernel
from estimators.model.layout import BodyKind, Layout
from estimators.model.measurements import (
    ROW,
    InputTable,
    Matrix,
    RowTable,
    Vector,
    empty_rows,
)
from estimators.model.members import MemberChange
from estimators.model.row_kernels import RANGE, IntArray, mark_usable
from estimators.model.unknown_motion import TARGET_ACCEL_VARIANCE
from estimators.window.inputs import InputHistory

SAME_ANTENNAS_M = 0.05
"""Antennas of one drone are further apart; an arm turns by less between the times that both ends give a range."""
ANCHOR_ACCEL_VARIANCE = 1e-8
"""Of a body that stands still: what keeps its block from becoming certain."""
_NEVER = np.iinfo(np.int64).min
"""Of an agent of which nothing was heard."""


class MeasurementWindow:
    """Rows and inputs of ticks ``first..last``.

    A row is identified by tick, instant, sensor and observer; the same record twice (a repeated packet, a
    relay) is kept once. What is older than the window is dropped, what is newer waits for its tick; what
    cannot be used (not finite, no positive variance, an agent outside the fleet) is refused. All are counted.
    """

    def __init__(
        self,
        layout: Layout,
        ticks: int,
        *,
        other_accel_variance: float,
        target_accel_variance: float = TARGET_ACCEL_VARIANCE,
        reciprocal_ranges: Literal["independent", "shared"] = "independent",
        unknown_inputs: Literal["zero", "hold"] = "zero",
        held_accel_fade: float = 1.0,
    ) -> None:
        self.layout = layout
        self.ticks = ticks
        self.first = 0
        self.last = -1
        self.dropped = 0
        """Rows and inputs that came too late for their place in the window."""
        self.refused = 0
        """Rows and inputs that no estimator could use."""
        self._shared = reciprocal_ranges == "shared"
        self._rows = empty_rows()
        hold = unknown_inputs == "hold"
        self._unknown = {
            BodyKind.VEHICLE: other_accel_variance,
            BodyKind.TARGET: target_accel_variance,
            BodyKind.ANCHOR: ANCHOR_ACCEL_VARIANCE,
        }
        self._inputs = InputHistory(self._unknown_variance(), hold=hold, fade=held_accel_fade)
        self._origin: int | None = None
        self._last_heard = np.full(layout.size, _NEVER, np.int64)

    @property
    def begun(self) -> bool:
        """Whether it holds more than one tick."""
        return self.last > self.first

    @property
    def full(self) -> bool:
        """Whether the next tick moves its start."""
        return self.last - self.first == self.ticks

    @property
    def next_first(self) -> int:
        """Where it starts once the next tick is open."""
        return max(self.first, self.last + 1 - self.ticks)

    def open(self, tick: int) -> bool:
        """Move the window's end to the next tick; True at the very first. Raises ``ValueError`` on a leap."""
        first = self._origin is None
        if first:
            self.first = tick
        elif tick != self.last + 1:
            raise ValueError(f"tick {tick} after {self.last}: ticks grow by one")
        self.advance(tick)
        return first

    def advance(self, tick: int) -> None:
        """Move the end of the window to ``tick``; what falls out at the start is forgotten."""
        self.last = tick
        if self._origin is None:
            self._origin = tick
        self.first = max(self.first, tick - self.ticks)
        if len(self._rows) and self._rows["tick"][0] < self.first:
            self._rows = self._rows[np.searchsorted(self._rows["tick"], self.first) :]
        self._inputs.forget_before(self.first)

    def insert(self, rows: RowTable, inputs: InputTable) -> None:
        """Put rows and inputs to their places."""
        refused, dropped = self._inputs.insert(inputs, self.first)
        self.refused += refused
        self.dropped += dropped
        if not len(rows):
            return
        table = np.empty(len(self._rows) + len(rows), ROW)
        new = np.ascontiguousarray(rows, ROW)
        agents = len(self._last_heard)
        count, refused, dropped = _take_in(table, self._rows, new, agents, self.first, self._last_heard)
        self._rows = table[:count]
        for slot in self.layout.target_slots:  # nothing is told by it, only of it
            seen = new["tick"][new["other"] == slot]
            if len(seen):
                self.hear(slot, int(seen.max()))
        self.refused += refused
        self.dropped += dropped

    def insert_current(self, rows: RowTable, inputs: InputTable) -> None:
        """For a filter, which has no past to put late rows into: those of earlier ticks are dropped, counted."""
        late = rows["tick"] < self.last
        self.dropped += int(np.count_nonzero(late))
        self.insert(rows[~late], inputs)

    def rows(self) -> tuple[RowTable, IntArray]:
        """Rows up to the window's last tick, sorted, and the first row of each tick ``(N+2,)``."""
        rows = self._rows
        if self._shared:
            once = np.empty(len(rows), np.bool_)
            _mark_once(rows, once)
            rows = rows[once]
        start = np.empty(self.last - self.first + 2, np.int64)
        _find_starts(rows, self.first, start)
        return rows[: start[-1]], start

    def inputs(self) -> tuple[Matrix, Matrix]:
        """Accelerations ``(N, 3n)`` over the window's ticks and their variances, see `InputHistory`."""
        return self._inputs.table(self.first, self.last)

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet. Rows that name an agent which did not stay are dropped; known motion is kept."""
        self.layout = change.after
        self._rows = _renamed(self._rows, change)
        heard = np.full(change.after.size, _NEVER, np.int64)
        for slot, before in change.known.items():
            heard[slot] = self._last_heard[before]
        self._last_heard = heard
        self._inputs.change_members(change, self._unknown_variance())

    def _unknown_variance(self) -> Vector:
        """Of the acceleration of each body where it is not known, (m/s2)2 per axis."""
        return np.array([self._unknown[kind] for kind in self.layout.kinds])

    def hear(self, slot: int, tick: int) -> None:
        """Note that information of an agent reached this one by another way than rows."""
        self._last_heard[slot] = max(int(self._last_heard[slot]), tick)

    def ages(self) -> IntArray:
        """Ticks ``(n,)`` since anything that an agent observed, or that was observed of a target, entered.

        Where nothing did, since before the start.
        """
        before = -1 if self._origin is None else self._origin - 1
        return np.asarray(self.last - np.maximum(self._last_heard, before))


@entry("UniTuple(int64, 3)(ROW[::1], ROW[::1], ROW[::1], int64, int64, int64[::1])", ROW=ROW)
def _take_in(
    table: RowTable, known: RowTable, rows: RowTable, agents: int, first: int, last_heard: IntArray
) -> tuple[int, int, int]:
    """``table`` <- what is ``known``, sorted, and ``rows``, of equal ones the earliest.

    Gives the number of them, how many rows no estimator could use, and how many were of ticks before ``first``.
    ``last_heard`` gets the latest tick of each observer.
    """
    usable = np.empty(rows.shape[0], np.bool_)
    mark_usable(rows, agents, usable)
    count, refused, dropped = known.shape[0], 0, 0
    for i in range(count):  # numpy copies structured arrays field by field
        table[i] = known[i]
    for r in range(rows.shape[0]):
        row = rows[r]
        if not usable[r]:
            refused += 1
            continue
        if row["tick"] < first:
            dropped += 1
            continue
        last_heard[row["observer"]] = max(last_heard[row["observer"]], row["tick"])
        at = count
        while at > 0 and _is_before(row, table[at - 1]):
            at -= 1
        if at > 0 and not _is_before(table[at - 1], row):
            continue  # the same record
        for i in range(count, at, -1):
            table[i] = table[i - 1]
        table[at] = row
        count += 1
    return count, refused, dropped


@entry("void(ROW[::1], int64, int64[::1])", ROW=ROW)
def _find_starts(rows: RowTable, first: int, start: IntArray) -> None:
    """start ``(N+2,)`` <- the first of the sorted rows that is of each tick from ``first`` on, or of a later one."""
    r = 0
    for k in range(start.shape[0]):
        while r < rows.shape[0] and rows[r]["tick"] < first + k:
            r += 1
        start[k] = r


@kernel
def _is_before(a: np.void, b: np.void) -> bool:
    """The order of rows, by all that identifies a record: the most significant first."""
    if a["tick"] != b["tick"]:
        return bool(a["tick"] < b["tick"])
    if a["observer"] != b["observer"]:
        return bool(a["observer"] < b["observer"])
    if a["kind"] != b["kind"]:
        return bool(a["kind"] < b["kind"])
    if a["agent"] != b["agent"]:
        return bool(a["agent"] < b["agent"])
    if a["other"] != b["other"]:
        return bool(a["other"] < b["other"])
    if a["offset_s"] != b["offset_s"]:
        return bool(a["offset_s"] < b["offset_s"])
    if a["x"] != b["x"]:
        return bool(a["x"] < b["x"])
    if a["y"] != b["y"]:
        return bool(a["y"] < b["y"])
    return bool(a["z"] < b["z"])


@entry("void(ROW[::1], boolean[::1])", ROW=ROW)
def _mark_once(rows: RowTable, once: NDArray[np.bool_]) -> None:
    """once ``(m,)`` <- false for ranges whose exchange is in the sorted rows from its lower end too.

    One exchange is one measurement. Two between other antennas of the same agents are two.
    """
    first = 0
    for r in range(rows.shape[0]):
        row = rows[r]
        while rows[first]["tick"] < row["tick"]:
            first += 1
        once[r] = True
        if row["kind"] != RANGE or row["agent"] <= row["other"]:
            continue
        for k in range(first, rows.shape[0]):
            seen = rows[k]
            if seen["tick"] != row["tick"]:
                break
            if seen["kind"] != RANGE or seen["agent"] != row["other"] or seen["other"] != row["agent"]:
                continue
            apart = (seen["x"] + row["x"]) ** 2 + (seen["y"] + row["y"]) ** 2 + (seen["z"] + row["z"]) ** 2
            if np.sqrt(apart) < SAME_ANTENNAS_M:
                once[r] = False
                break


def _renamed(rows: RowTable, change: MemberChange) -> RowTable:
    """Rows with the slots of the new fleet; those that name an agent which did not stay are left out."""
    target = np.full(change.before.size + 1, -2, np.int32)
    target[-1] = -1  # index -1, "no other end", stays what it is
    for slot, before in change.stayed.items():
        target[before] = slot
    renamed = rows.copy()
    for field in ("agent", "other", "observer"):
        renamed[field] = target[rows[field]]
    kept = (renamed["agent"] >= 0) & (renamed["other"] >= -1) & (renamed["observer"] >= 0)
    return np.asarray(renamed[kept])
