"""Whose measurements contradict all others: averages of normalised squared residuals, sensor by sensor.

A residual r of a row with variance R counts as r^2 / R, about one where the sensor is as good as it claims, and the
robust solution says besides which weight it left to the row. A receiver whose fixes stay far off while everything
else agrees is wrong about its drone's place, or all others are: the estimate may not be believed there. Where
enough other receivers are left to tell (`FEWEST_WITNESSES`), its rows get no weight at all: a Student-t density
weighs an outlier down, but a pull that lasts moves the estimate. They are still looked at, against what the estimate
without them predicts, and count again once they agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import (
    AGREEING_SQUARE,
    CONTRADICTING_SQUARE,
    FEWEST_WITNESSES,
    IGNORED_SQUARE,
    SETTLED_S,
)
from estimators.model.measurements import Kind, Matrix, RowTable, Vector
from estimators.model.members import MemberChange

KINDS = len(Kind)
MEMORY_S = 3.0
"""Of the averages."""
LARGEST_SHARE = 0.2
"""Of one tick's rows in an average: one outlier of a slow sensor is no contradiction."""
LARGEST_SQUARE = 10.0
"""A residual counts as this at most: an average tells whether many are large, not how large one was."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """Rows that have been weighed for good, as a robust solution has them."""

    rows: RowTable
    """``(m,)``."""
    squares: Vector
    """``(m,)``: squared residuals over the variances that they are expected to have."""
    weights: Vector
    """``(m,)`` of the rows, 0..1."""


@dataclass(frozen=True, slots=True)
class Innovations:
    """Averages over the last seconds; NaN where nothing was measured."""

    squares: Matrix
    """``(n, kinds)``: normalised squared residuals by agent and `Kind`; of ranges, those to all others."""
    weights: Matrix
    """``(n, kinds)``: the weights that the rows got."""
    pairs: Matrix
    """``(n, n)``: normalised squared residuals of the ranges between two agents, symmetric."""
    ignored: NDArray[np.bool_]
    """``(n,)``: whose fixes and velocities get no weight."""


class _Averages:
    """Of squares and weights, one of each a key; both begin at one, as if all were well."""

    def __init__(self, keys: int, period_s: float) -> None:
        self.values = np.ones((2, keys))
        self.heard = np.zeros(keys, np.bool_)
        self._waited_s = np.zeros(keys)
        self._period_s = period_s

    def take(self, keys: NDArray[np.int64], squares: Vector, weights: Vector) -> None:
        """A tick's rows, by their keys; what has not come for longer counts for more."""
        self._waited_s += self._period_s
        counts = np.bincount(keys, minlength=len(self._waited_s))
        heard = np.flatnonzero(counts)
        share = np.minimum(self._waited_s[heard] / MEMORY_S, LARGEST_SHARE)
        capped = np.minimum(squares, LARGEST_SQUARE)
        for average, values in zip(self.values, (capped, weights), strict=True):
            mean = np.bincount(keys, values, len(counts))[heard] / counts[heard]
            average[heard] += share * (mean - average[heard])
        self._waited_s[heard] = 0.0
        self.heard[heard] = True

    def told(self) -> Matrix:
        """The averages ``(2, keys)``, NaN where nothing came."""
        return np.where(self.heard, self.values, np.nan)

    def keep(self, other: _Averages, key: int, was: int) -> None:
        """Go on with another's average."""
        self.values[:, key], self.heard[key] = other.values[:, was], other.heard[was]


class InnovationMonitor:
    """Keeps the averages of a fleet of ``agents``; ``slot`` is the own place, whose contradictions are alarms."""

    def __init__(self, agents: int, slot: int, period_s: float) -> None:
        self._slot = slot
        self._period_s = period_s
        self._make(agents)

    def _make(self, agents: int) -> None:
        self._sensors = _Averages(agents * KINDS, self._period_s)
        self._pairs = _Averages(agents * agents, self._period_s)
        self.contradictory = np.zeros(agents, np.bool_)
        """``(n,)``: whose fixes contradict the rest."""
        self.ignored = np.zeros(agents, np.bool_)
        """``(n,)``: whose fixes and velocities are to get no weight."""
        self._ignored_s = np.zeros(agents)

    def observe(self, evidence: Residuals) -> tuple[Finding, ...]:
        """A finding about each slot whose fixes contradict the rest, an alarm where it is the own one."""
        self._average(evidence)
        squares = self._sensors.values[0].reshape(-1, KINDS)[:, [Kind.POSITION, Kind.VELOCITY]].max(axis=1)
        limit = np.where(self.contradictory, AGREEING_SQUARE, CONTRADICTING_SQUARE)
        self.contradictory = squares > limit
        self._ignore(squares)
        return tuple(
            self._finding(int(slot), float(squares[slot]), float(limit[slot]))
            for slot in np.flatnonzero(self.contradictory)
        )

    def _finding(self, slot: int, square: float, limit: float) -> Finding:
        if self._ignored_s[slot] >= SETTLED_S:
            return Finding(What.FIXES_IGNORED, Gravity.DEGRADED, slot, square, limit)
        gravity = Gravity.ALARM if slot == self._slot else Gravity.DEGRADED
        return Finding(What.FIXES_CONTRADICT, gravity, slot, square, limit)

    def averages(self) -> Innovations:
        """As they are now."""
        agents = len(self.contradictory)
        squares, weights = self._sensors.told().reshape(2, agents, KINDS)
        pairs = self._pairs.told()[0].reshape(agents, agents)
        return Innovations(squares, weights, np.where(np.tri(agents, dtype=np.bool_), pairs.T, pairs), self.ignored)

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet; of fresh agents nothing is remembered."""
        before = self._sensors, self._pairs, self.contradictory, self.ignored, self._ignored_s
        self._slot, agents, old = change.own, change.after.size, change.before.size
        self._make(agents)
        for slot, was in change.stayed.items():
            self.contradictory[slot], self.ignored[slot] = before[2][was], before[3][was]
            self._ignored_s[slot] = before[4][was]
            for kind in range(KINDS):
                self._sensors.keep(before[0], slot * KINDS + kind, was * KINDS + kind)
            for other, other_was in change.stayed.items():
                self._pairs.keep(before[1], _pair(slot, other, agents), _pair(was, other_was, old))

    def _average(self, evidence: Residuals) -> None:
        """Ranges count for both of their ends, and for the pair."""
        rows, agents = evidence.rows, len(self.contradictory)
        kind = rows["kind"].astype(np.int64)
        ranged = np.flatnonzero(kind == Kind.RANGE)
        one, other = rows["agent"].astype(np.int64), rows["other"][ranged].astype(np.int64)
        twice = np.concatenate((np.arange(len(rows)), ranged))
        keys = np.concatenate((one, other)) * KINDS + kind[twice]
        self._sensors.take(keys, evidence.squares[twice], evidence.weights[twice])
        pairs = np.minimum(one[ranged], other) * agents + np.maximum(one[ranged], other)
        self._pairs.take(pairs, evidence.squares[ranged], evidence.weights[ranged])

    def _ignore(self, squares: Vector) -> None:
        """Rows lose their weight where enough other receivers tell, and regain it once they agree."""
        ignored = self.ignored & self.contradictory
        witnesses = len(squares) - np.count_nonzero(self.contradictory)
        for slot in np.flatnonzero(self.contradictory & ~ignored & (squares > IGNORED_SQUARE)):
            ignored[slot] = witnesses >= FEWEST_WITNESSES
        self.ignored = ignored
        self._ignored_s = np.where(ignored, self._ignored_s + self._period_s, 0.0)


def _pair(one: int, other: int, agents: int) -> int:
    return min(one, other) * agents + max(one, other)
