"""Whose measurements contradict all others: averages of normalised squared residuals, sensor by sensor.

A residual r of a row with variance R counts as r^2 / R, about one where the sensor is as good as it claims, and the
robust solution says besides which weight it left to the row. A receiver whose fixes stay far off while everything
else agrees is wrong about its drone's place, or all others are: the estimate may not be believed there. Where
enough other receivers are left to tell (`FEWEST_WITNESSES`), its rows get no weight at all: a Student-t density
weighs an outlier down, but a pull that lasts moves the estimate. They are still looked at, against what the estimate
without them predicts, and count again once they agree.

The ranges of a pair whose ends both have fixes that fit better than they do are left out in the same way: a path
around an obstacle, or a bias that nobody has calibrated, is far more common than two receivers that err alike.
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
RECENT_S = 1.0
"""A drone without a fix for longer is not held by fixes."""
LARGEST_SQUARE = 10.0
"""A residual counts as this at most: an average tells whether many are large, not how large one was."""


@dataclass(frozen=True, slots=True)
class Ignored:
    """Whose measurements are to get no weight."""

    receivers: NDArray[np.bool_]
    """``(n,)``: fixes and velocities of these agents."""
    pairs: NDArray[np.bool_]
    """``(n, n)``, symmetric: ranges between two agents."""

    def rows(self, rows: RowTable) -> NDArray[np.bool_]:
        """Which of the rows ``(m,)`` these are."""
        receiver = np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY, Kind.SPEED)) & self.receivers[rows["agent"]]
        ranged = rows["kind"] == Kind.RANGE
        return np.asarray(receiver | (ranged & self.pairs[rows["agent"], np.where(ranged, rows["other"], 0)]))

    def any(self) -> bool:
        """Whether there are any."""
        return bool(self.receivers.any() or self.pairs.any())


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
    ignored_pairs: NDArray[np.bool_]
    """``(n, n)``, symmetric: whose ranges get none."""


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
        self.ignored = Ignored(np.zeros(agents, np.bool_), np.zeros((agents, agents), np.bool_))
        """What is to get no weight."""
        self._ignored_s: Vector = np.zeros(agents)
        self._unfixed_s = np.full(agents, np.inf)
        """``(n,)``: since the last fix."""

    def observe(self, evidence: Residuals) -> tuple[Finding, ...]:
        """A finding about each slot whose fixes contradict the rest, an alarm where it is the own one."""
        self._average(evidence)
        self._unfixed_s += self._period_s
        self._unfixed_s[evidence.rows["agent"][evidence.rows["kind"] == Kind.POSITION]] = 0.0
        squares = self._sensors.values[0].reshape(-1, KINDS)[:, [Kind.POSITION, Kind.VELOCITY]].max(axis=1)
        limit = np.where(self.contradictory, AGREEING_SQUARE, CONTRADICTING_SQUARE)
        # fixes that have stopped contradict nothing any more
        self.contradictory = (squares > limit) & (self._unfixed_s <= SETTLED_S)
        self.ignored = Ignored(self._ignored_receivers(squares), self._ignored_pairs(squares))
        self._ignored_s = np.where(self.ignored.receivers, self._ignored_s + self._period_s, 0.0)
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
        pairs = _symmetric(self._pairs.told()[0], agents)
        return Innovations(squares, weights, pairs, self.ignored.receivers, self.ignored.pairs)

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet; of fresh agents nothing is remembered."""
        before = self._sensors, self._pairs, self.contradictory, self.ignored, self._ignored_s, self._unfixed_s
        self._slot, agents, old = change.own, change.after.size, change.before.size
        self._make(agents)
        for slot, was in change.stayed.items():
            self.contradictory[slot], self.ignored.receivers[slot] = before[2][was], before[3].receivers[was]
            self._ignored_s[slot], self._unfixed_s[slot] = before[4][was], before[5][was]
            for kind in range(KINDS):
                self._sensors.keep(before[0], slot * KINDS + kind, was * KINDS + kind)
            for other, other_was in change.stayed.items():
                self._pairs.keep(before[1], _pair(slot, other, agents), _pair(was, other_was, old))
                self.ignored.pairs[slot, other] = before[3].pairs[was, other_was]

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

    def _ignored_receivers(self, squares: Vector) -> NDArray[np.bool_]:
        """Rows lose their weight where enough other receivers tell, and regain it once they agree."""
        ignored = self.ignored.receivers & self.contradictory
        witnesses = np.count_nonzero(~self.contradictory & (self._unfixed_s <= RECENT_S))
        for slot in np.flatnonzero(self.contradictory & ~ignored & (squares > IGNORED_SQUARE)):
            ignored[slot] = witnesses >= FEWEST_WITNESSES
        return np.asarray(ignored)

    def _ignored_pairs(self, squares: Vector) -> NDArray[np.bool_]:
        """Ranges lose their weight where fixes that fit hold both ends, and regain it once they agree."""
        agents = len(squares)
        held = (self._unfixed_s <= RECENT_S) & ~self.contradictory
        pairs = _symmetric(self._pairs.values[0], agents)
        worse = pairs > np.maximum(squares[:, None], squares[None, :])
        begin = (pairs > IGNORED_SQUARE) & worse & held[:, None] & held[None, :]
        return np.asarray(begin | (self.ignored.pairs & (pairs > AGREEING_SQUARE) & held[:, None] & held[None, :]))


def _symmetric(pairs: Vector, agents: int) -> Matrix:
    """What stands above the diagonal of ``(n, n)``, on both sides."""
    square = pairs.reshape(agents, agents)
    return np.asarray(np.where(np.tri(agents, dtype=np.bool_), square.T, square))


def _pair(one: int, other: int, agents: int) -> int:
    return min(one, other) * agents + max(one, other)
