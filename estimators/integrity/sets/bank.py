"""Where all neighbours certainly are, relative to the own drone: one relative filter each, fed with bounded rows.

Nothing of an estimator comes in, so an estimate can be held against the sets. The rows are those that estimators
take; those without a hard bound count only where the configuration states one for their sensor (`SensorBounds`). A
guarantee is worth as much as these bounds: a receiver whose error exceeds its bound once may put the drone outside.

A row holds for its own instant. It is brought to the tick's by how far its drone has moved since, which is known
from the velocities of fixes, give or take their bound and what the drone can have accelerated. So each drone has a
box in the fleet's frame, moved and widened tick by tick and cut by each fix; the boxes' difference is
the box of the relative position.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.sets.ellipsoid import Ellipsoid
from estimators.integrity.sets.relative import Conflict, RelativeBounds, RelativeFilter
from estimators.integrity.thresholds import AGREEING_S
from estimators.model.measurements import Kind, Matrix, RowTable, Vector

LATE_TICKS = 16
"""Rows older than this are left out."""
REPEATED_S = 0.15
"""What is found of a neighbour again after so long is no single outlier, and stands until it has agreed for a while:
a bound that is broken for good, as by a bias, shows only now and then, when the errors of both sensors add up."""


@dataclass(frozen=True, slots=True)
class SensorBounds:
    """Hard bounds of sensors whose rows state none, per axis where there are axes; infinite: rows left out."""

    position_m: tuple[float, float, float] = (math.inf,) * 3
    """Of fixes: north, east, down."""
    velocity_mps: float = math.inf
    """Of the velocities of fixes."""
    range_m: float = math.inf
    acceleration_mps2: float = math.inf
    """No drone accelerates by more."""
    speed_mps: float = math.inf
    """No drone moves faster."""


@dataclass(frozen=True, slots=True)
class BoundedTick:
    """What came in for a tick: ``rows``, by slot, the ids ``agents`` of the slots, and which is the ``own``."""

    tick: int
    agents: tuple[int, ...]
    own: int
    rows: RowTable
    relative: Mapping[int, Vector]
    """The estimate that is held against the sets: relative position ``(3,)`` of others, by id, NED m."""


class _Track:
    """Of one drone: how far it has moved in each of the last ticks, and the box that it is in. NED m."""

    def __init__(self) -> None:
        self._velocity, self._half = np.zeros(3), np.full(3, np.inf)
        self._measured_s = np.zeros(3)
        self._steps: deque[tuple[Vector, Vector]] = deque(maxlen=LATE_TICKS)
        self.low: Vector = np.full(3, -np.inf)
        self.high: Vector = np.full(3, np.inf)

    def hear_velocity(self, axis: int, value: float, half_width: float, t_s: float) -> None:
        """A velocity of an instant, per axis; an older one is left out."""
        if t_s >= self._measured_s[axis] or not np.isfinite(self._half[axis]):
            self._velocity[axis], self._half[axis], self._measured_s[axis] = value, half_width, t_s

    def step(self, t_s: float, period_s: float, bounds: SensorBounds) -> tuple[Vector, Vector]:
        """How far it has moved in the period that ends at ``t_s``, and the half width of that.

        The half width holds for half a period more: rows of a tick may be so much later than the tick.
        """
        after_s, before_s = t_s + 0.5 * period_s - self._measured_s, self._measured_s - (t_s - period_s)
        half = self._half + bounds.acceleration_mps2 * np.maximum(after_s, before_s)
        unknown = half > bounds.speed_mps
        moved = period_s * np.where(unknown, 0.0, self._velocity)
        slack = period_s * np.where(unknown, bounds.speed_mps, half)
        self._steps.append((moved, slack))
        self.low, self.high = self.low + moved - slack, self.high + moved + slack
        return moved, slack

    def since(self, ticks: float) -> tuple[Vector, Vector]:
        """How far it has moved in the last (or, below zero, the next) ticks and parts of one, and the half width."""
        moved: Vector = np.zeros(3)
        slack: Vector = np.zeros(3)
        left = abs(ticks)
        for step, half in reversed(self._steps):
            share = min(left, 1.0)
            if share <= 0.0:
                break
            moved, slack, left = moved + share * step, slack + share * half, left - share
        if left > 0.0:
            slack = np.full(3, np.inf)
        return math.copysign(1.0, ticks) * moved, slack

    def take_fix(self, axis: int, value: float, half_width: float) -> bool:
        """Cut the box; false where nothing of it is left: then the fix is the box."""
        low, high = max(self.low[axis], value - half_width), min(self.high[axis], value + half_width)
        fits = bool(low <= high)
        self.low[axis], self.high[axis] = (low, high) if fits else (value - half_width, value + half_width)
        return fits


@dataclass(frozen=True, slots=True)
class _Spell:
    """What was found of a neighbour of late: since when, the last time, and the gravest of it."""

    since_s: float
    last_s: float
    gravest: Finding

    def again(self, now_s: float, found: Finding) -> _Spell:
        """With what is found now."""
        gravest = found if found.gravity > self.gravest.gravity else self.gravest
        return _Spell(self.since_s, now_s, gravest)

    @property
    def repeated(self) -> bool:
        return self.last_s - self.since_s >= REPEATED_S


class SetBank:
    """The guaranteed sets of all neighbours of one drone."""

    def __init__(self, period_s: float, bounds: SensorBounds) -> None:
        self._period_s = period_s
        self._bounds = bounds
        self._tick: int | None = None
        self._tracks: dict[int, _Track] = {}
        self._filters: dict[int, RelativeFilter] = {}
        self._spells: dict[int, _Spell] = {}
        self.conflicts: dict[int, int] = {}
        """Ticks whose bounds contradicted each other, by the neighbour's id."""

    @property
    def sets(self) -> dict[int, Ellipsoid]:
        """By id of the neighbour: its relative position, NED m; none where nothing is certain."""
        found = {agent: each.set for agent, each in self._filters.items()}
        return {agent: each for agent, each in found.items() if each is not None}

    def observe(self, evidence: BoundedTick) -> tuple[Finding, ...]:
        """A finding about each neighbour whose bounds contradict each other, or whose estimate is outside its set.

        What comes again stands until nothing has been found for `AGREEING_S`.
        """
        rows, half = self._bounded(evidence.rows)
        rows, half = _recent(rows, half, evidence.tick)
        if self._tick is not None and not 0 < evidence.tick - self._tick <= LATE_TICKS:
            self._tracks, self._filters = {}, {}
        self._keep(evidence.agents)
        steps = self._moved(evidence, rows, half)
        disagreeing = self._take_fixes(evidence, rows, half)
        self._tick = evidence.tick
        own = evidence.agents[evidence.own]
        found = [_broken(agent, "fixes") for agent in sorted(disagreeing)]
        for slot, agent in enumerate(evidence.agents):
            if slot == evidence.own:
                continue
            ranges = self._ranges(evidence, rows, half, slot)
            bounds = self._relative(own, agent, steps, ranges)
            conflict = self._filters[agent].observe(bounds)
            self.conflicts[agent] = self._filters[agent].conflicts
            found += self._findings(agent, conflict, evidence.relative.get(agent))
        return (*found, *self._standing(found, evidence.tick * self._period_s))

    def _standing(self, found: Sequence[Finding], now_s: float) -> list[Finding]:
        """What was found again and again of late, and is not among what is found now."""
        self._spells = {agent: each for agent, each in self._spells.items() if now_s - each.last_s <= AGREEING_S}
        for each in found:
            if each.about is not None:
                spell = self._spells.get(each.about) or _Spell(now_s, now_s, each)
                self._spells[each.about] = spell.again(now_s, each)
        said = {(each.about, each.what) for each in found}
        repeated = [each.gravest for each in self._spells.values() if each.repeated]
        return [each for each in repeated if (each.about, each.what) not in said]

    def _findings(self, agent: int, conflict: Conflict, relative: Vector | None) -> list[Finding]:
        if conflict is not Conflict.NONE:
            return [_broken(agent, "ranges and fixes" if conflict & Conflict.PRESENT else "way")]
        held = self._filters[agent].set
        if held is None or relative is None:
            return []
        try:
            level = held.level(relative)
        except np.linalg.LinAlgError:  # flat: the estimate is never exactly on it
            return []
        return [Finding(What.DIVERGED, Gravity.ALARM, agent, level, 1.0)] if level > 1.0 else []

    def _keep(self, agents: Sequence[int]) -> None:
        """Begin with those who have come, let go who has left."""
        self._tracks = {agent: self._tracks.get(agent) or _Track() for agent in agents}
        self._filters = {agent: self._filters.get(agent) or RelativeFilter(self._period_s) for agent in agents}
        self._spells = {agent: each for agent, each in self._spells.items() if agent in self._tracks}

    def _bounded(self, rows: RowTable) -> tuple[RowTable, Vector]:
        """Rows with a bound, and their half widths: those that they state, or else the configured ones."""
        stated = rows["half_width"]
        configured = np.full(len(rows), np.inf)
        kind = rows["kind"]
        for axis, name in enumerate("xyz"):
            at = (kind == Kind.POSITION) & (rows[name] == 1.0)
            configured[at] = self._bounds.position_m[axis]
        configured[kind == Kind.VELOCITY] = self._bounds.velocity_mps
        configured[kind == Kind.RANGE] = self._bounds.range_m
        half = np.where(np.isfinite(stated), stated, configured)
        known = np.isfinite(half)
        return rows[known], half[known]

    def _moved(self, evidence: BoundedTick, rows: RowTable, half: Vector) -> dict[int, tuple[Vector, Vector]]:
        """How far each drone has moved since the last tick, and the half width of that."""
        for at in np.flatnonzero(rows["kind"] == Kind.VELOCITY):
            axis = _axis(rows[at])
            if axis is not None:
                t_s = float(rows["tick"][at]) * self._period_s + float(rows["offset_s"][at])
                track = self._tracks[evidence.agents[rows["agent"][at]]]
                track.hear_velocity(axis, float(rows["value"][at]), float(half[at]), t_s)
        ticks = 1 if self._tick is None else evidence.tick - self._tick
        steps = {}
        for agent, track in self._tracks.items():
            moved: Vector = np.zeros(3)
            slack: Vector = np.zeros(3)
            for k in range(ticks):
                t_s = (evidence.tick - ticks + 1 + k) * self._period_s
                step, width = track.step(t_s, self._period_s, self._bounds)
                moved, slack = moved + step, slack + width
            steps[agent] = moved, slack
        return steps

    def _take_fixes(self, evidence: BoundedTick, rows: RowTable, half: Vector) -> set[int]:
        """Cut the boxes by the fixes; gives whose fixes contradict what was known of their drone."""
        disagreeing = set()
        for at in np.flatnonzero(rows["kind"] == Kind.POSITION):
            axis = _axis(rows[at])
            if axis is None:
                continue
            agent = evidence.agents[rows["agent"][at]]
            moved, slack = self._tracks[agent].since(self._age(rows[at], evidence.tick))
            width = float(half[at]) + slack[axis]
            if not self._tracks[agent].take_fix(axis, float(rows["value"][at]) + moved[axis], width):
                disagreeing.add(agent)
        return disagreeing

    def _ranges(self, evidence: BoundedTick, rows: RowTable, half: Vector, slot: int) -> Matrix:
        """The own ranges to a neighbour, as `RelativeBounds` has them."""
        own = evidence.own
        between = (rows["agent"] == own) & (rows["other"] == slot) | (rows["agent"] == slot) & (rows["other"] == own)
        at = np.flatnonzero((rows["kind"] == Kind.RANGE) & between)
        found = np.zeros((len(at), 5))
        mine, other = (self._tracks[evidence.agents[each]] for each in (own, slot))
        kept = 0
        for each in at:
            age = self._age(rows[each], evidence.tick)
            (moved, slack), (other_moved, other_slack) = mine.since(age), other.since(age)
            width = float(half[each]) + float(np.linalg.norm(slack + other_slack))
            if math.isfinite(width):
                arms = np.array([rows[axis][each] for axis in "xyz"])  # of the antennas, from the one's end
                arms = arms if rows["agent"][each] == own else -arms
                found[kept] = rows["value"][each], width, *(other_moved - moved + arms)
                kept += 1
        return found[:kept]

    def _relative(
        self, own: int, agent: int, steps: Mapping[int, tuple[Vector, Vector]], ranges: Matrix
    ) -> RelativeBounds:
        mine, other = self._tracks[own], self._tracks[agent]
        moved, slack = steps[agent][0] - steps[own][0], steps[agent][1] + steps[own][1]
        return RelativeBounds(moved, slack, other.low - mine.high, other.high - mine.low, ranges)

    def _age(self, row: np.void, tick: int) -> float:
        """Ticks from a row's instant to the tick's."""
        return tick - int(row["tick"]) - float(row["offset_s"]) / self._period_s


def _broken(agent: int, which: str) -> Finding:
    return Finding(What.BOUNDS_BROKEN, Gravity.DEGRADED, agent, detail=f"{which} of {agent}")


def _recent(rows: RowTable, half: Vector, tick: int) -> tuple[RowTable, Vector]:
    recent = (rows["tick"] > tick - LATE_TICKS) & (rows["tick"] <= tick)
    return rows[recent], half[recent]


def _axis(row: np.void) -> int | None:
    """The axis of the frame that a row measures along; ``None``: another direction."""
    for axis, name in enumerate("xyz"):
        if row[name] == 1.0:
            return axis
    return None
