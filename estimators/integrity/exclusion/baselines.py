"""Ranges held against the distances between fixes: what is left over, pair by pair, in bins of a quarter of a second.

Nothing of an estimator is in it, so a poisoned estimate cannot hide what poisons it, and all drones that hold the
same measurements find the same. A range is held against fixes interpolated to its instant: no velocity is needed, and
an interval of 0.2 s costs 2 cm at 4 m/s2. The median of a bin makes little of ranges without a line of sight.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimators.integrity.thresholds import SCATTERED
from estimators.model.measurements import Kind, RowTable, Vector

BIN_S = 0.25
WAIT_S = 2.0
"""A range that no fix follows for so long is held against none."""
LARGEST_GAP_S = 1.1
"""Between fixes that a place between them is interpolated from."""
LATE_S = 0.3
"""So long after its end a bin is closed: the fix that surrounds its last range has come."""
FIXES_KEPT = 64
NEAREST_M = 4.0
"""Drones nearer to each other say nothing: the direction between them is not known."""
FARTHEST_M = 1e5
"""Nor do drones that are said to be farther away: no radio reaches so far, and a liar may say anything."""
CURVED_M2 = 1.2
"""Variance of both fixes across the line between them. Over a distance d it makes the line longer by up to this
over d, which no direction tells."""
NORMAL_OF_MEDIAN = 1.4826
"""1-sigma of a Gaussian by the median of its absolute value."""
BLOCKED_SCATTER_M = 1.0
"""By how much those without a line of sight scatter."""
SCATTER_NATS = 2.0
"""What the scatter of a bin, a few ranges, tells at most."""
LONE_M, LONE_SIGMAS = 0.5, 4.0
"""1-sigma at least, and the most that it may be off by, of a range that is alone in its bin: nothing tells whether it
had a line of sight, so that it takes several of them to say that anything is off."""
SCATTER_RANGES = 24
"""So many of a pair tell how they scatter, by how each is off the line between those before and after it."""
LEAST_SHARE, NORMAL_OF_LEAST = 0.2, 3.947
"""The scatter is that of the best fifth, and what makes 1-sigma of a Gaussian of it. A blocked range spoils three of
them: of ranges of which one in thirty is blocked seven in two seconds would have to be."""
STUCK_RANGES = 16
"""So many times the same are no measurements: with a last digit and a noise of 1 cm, one chance in 10 000 000."""
FEWEST_RANGES = 16
STRAIGHT_S = 0.3
"""Between the outer two of three, for the line to be straight: 4 m/s2 make 5 cm of it."""
PASSING_MPS = 8.0
"""Drones that pass each other so fast have ranges that are off a line, the more the nearer they are."""
LEAST_SIGMA_M = 0.05
"""No ranges are taken to be better than that."""
ENDS_RANGES = 16
"""So many of one end held against those of the other tell whether both measure the same distance."""
LEAST_LOBE_M = 1.0 / 6.0
"""Antennas have lobes, and modules delays: both ends of a sound pair may differ by several times that."""

Pair = tuple[int, int]
"""Two ids, the smaller first."""
_Held = tuple[float, Vector, float]
"""Of a range: what is left over, the way between the fixes, and its variance."""


@dataclass(frozen=True, slots=True)
class SharedTick:
    """What came in for a tick: ``rows`` by slot, and the ids ``agents`` of the slots."""

    tick: int
    agents: tuple[int, ...]
    rows: RowTable


@dataclass(frozen=True, slots=True)
class Ranging:
    """What a pair's ranges of late say of themselves, whatever any fix says."""

    scatter: float
    """About a straight line, over the sigma that they claim."""
    ends_apart: float
    """How far what one end measures is off what the other does, over the same: no receiver makes them differ."""
    stuck: bool
    """Whether they repeat to the last digit."""

    @property
    def impossible(self) -> bool:
        """Whether they cannot be right, wherever the drones are."""
        return self.stuck or self.ends_apart > SCATTERED

    def is_spoiled(self, limit: float) -> bool:
        """Whether they are off, with that many sigmas as the limit."""
        return self.stuck or max(self.scatter, self.ends_apart) > limit


@dataclass(frozen=True, slots=True)
class LeftOver:
    """Of one pair in one bin."""

    residual_m: float
    """Median of range less distance between the fixes."""
    direction: Vector
    """``(3,)`` from the second to the first, by their fixes."""
    distance_m: float
    """Between their fixes, on average."""
    ranging: Ranging
    blocked_nats: float
    """Odds of ranges without a line of sight, each too long by something else, by how those of the bin scatter."""
    variance_m2: float
    """Of that median, as far as ranges and the curvature of the distance go."""


@dataclass(frozen=True, slots=True)
class Bin:
    """What was left over in a quarter of a second, and how well each drone's fixes of it are known."""

    number: int
    pairs: Mapping[Pair, LeftOver]
    fix_variance_m2: Mapping[int, Vector]
    """``(3,)`` of the mean of a drone's fixes, as claimed."""
    unheld: Mapping[Pair, Ranging]
    """Of pairs that range and of which nothing can be left over: an end has had no fixes for a while, or both are
    near."""

    def without(self, agents: Container[int]) -> Bin:
        """The same without the pairs of some drones."""
        kept = {pair: each for pair, each in self.pairs.items() if not any(agent in agents for agent in pair)}
        return self if len(kept) == len(self.pairs) else replace(self, pairs=kept)


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A range whose ends' fixes are waited for."""

    t_s: float
    pair: Pair
    range_m: float
    variance_m2: float
    arms_m: Vector
    """``(3,)``: lever arm of the first end's antenna less that of the second's."""
    measured_by: int


class _Fixes:
    """Of one drone, newest last: instants, places and variances."""

    def __init__(self) -> None:
        self.t_s: deque[float] = deque(maxlen=FIXES_KEPT)
        self.place_m: deque[Vector] = deque(maxlen=FIXES_KEPT)
        self.variance_m2: deque[Vector] = deque(maxlen=FIXES_KEPT)

    def add(self, t_s: float, place_m: Vector, variance_m2: Vector) -> None:
        """A fix in its place; one of an instant that is there already is left out."""
        at = len(self.t_s)
        while at and self.t_s[at - 1] > t_s:
            at -= 1
        if at and self.t_s[at - 1] == t_s:
            return
        if len(self.t_s) == FIXES_KEPT:
            if not at:
                return
            self.t_s.popleft(), self.place_m.popleft(), self.variance_m2.popleft()
            at -= 1
        self.t_s.insert(at, t_s)
        self.place_m.insert(at, place_m)
        self.variance_m2.insert(at, variance_m2)

    def at(self, t_s: float) -> Vector | None:
        """The place at an instant; ``None`` where no two fixes hold it."""
        after = len(self.t_s)
        while after and self.t_s[after - 1] >= t_s:
            after -= 1
        if after == len(self.t_s) or not after:
            return self.place_m[after] if after < len(self.t_s) and self.t_s[after] == t_s else None
        gap_s = self.t_s[after] - self.t_s[after - 1]
        if gap_s > LARGEST_GAP_S:
            return None
        share = (t_s - self.t_s[after - 1]) / gap_s
        return np.asarray((1.0 - share) * self.place_m[after - 1] + share * self.place_m[after])

    def mean_variance(self, from_s: float, to_s: float) -> Vector | None:
        """Of the mean of a bin, such that bins next to each other, which share fixes, are as good as white.

        ``None`` where there are no fixes about.
        """
        found = [at for at, t in enumerate(self.t_s) if from_s - LARGEST_GAP_S <= t <= to_s + LARGEST_GAP_S]
        if len(found) < 2:
            return None
        apart_s = (self.t_s[found[-1]] - self.t_s[found[0]]) / (len(found) - 1)
        return np.asarray(np.mean([self.variance_m2[at] for at in found], axis=0) * apart_s / (to_s - from_s))


class _Scatter:
    """Of a pair's ranges that one end measured: those of the other may be off by something else, all the time."""

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=3)
        self._off: deque[float] = deque(maxlen=SCATTER_RANGES)
        self._said_m = math.nan
        self._repeats = 0

    @property
    def stuck(self) -> bool:
        """Whether the last so many were the same."""
        return self._repeats >= STUCK_RANGES

    def hear(self, t_s: float, said_m: float, range_m: float, sigma_m: float) -> bool:
        """The next range, as said and between the bodies; false for one that is late, which is left out."""
        if self._last and t_s <= self._last[-1][0]:
            return False
        self._repeats = self._repeats + 1 if said_m == self._said_m else 0
        self._said_m = said_m
        self._last.append((t_s, range_m))
        if len(self._last) == 3 and t_s - self._last[0][0] <= STRAIGHT_S:
            (t0, before), (t1, middle), (t2, after) = self._last
            share = (t1 - t0) / (t2 - t0)
            off = middle - (1.0 - share) * before - share * after
            curved_m = 0.5 * (t1 - t0) * (t2 - t1) * PASSING_MPS**2 / max(range_m, 1.0)
            self._off.append(abs(off) / (sigma_m * (1.0 + (1.0 - share) ** 2 + share**2) ** 0.5 + curved_m))
        return True

    def sigmas(self) -> float:
        """1-sigma over what is claimed; 1 where it is not told."""
        if len(self._off) < FEWEST_RANGES:
            return 1.0
        ordered = sorted(self._off)
        at = LEAST_SHARE * (len(ordered) - 1)
        below = int(at)
        return NORMAL_OF_LEAST * (ordered[below] + (at - below) * (ordered[below + 1] - ordered[below]))


class _Ends:
    """Of a pair's ranges that both ends measured, each held against the line between two of the other end."""

    def __init__(self) -> None:
        self._heard: dict[int, deque[tuple[float, float]]] = {}
        self._apart: deque[tuple[float, float]] = deque(maxlen=ENDS_RANGES)

    def hear(self, t_s: float, by: int, pair: Pair, range_m: float, sigma_m: float) -> None:
        """The next range that one end measured, between the bodies."""
        mine = self._heard.setdefault(by, deque(maxlen=ENDS_RANGES))
        other = self._heard.setdefault(pair[0] if by == pair[1] else pair[1], deque(maxlen=ENDS_RANGES))
        sign, unit_m = (1.0 if by == pair[0] else -1.0), max(sigma_m, LEAST_LOBE_M)
        if mine:
            of_late = [each for each in other if mine[-1][0] < each[0] <= t_s]
            found = [(at, _off_line((at, heard), mine[-1], (t_s, range_m))) for at, heard in of_late]
            self._apart.extend((at, -sign * off / unit_m) for at, off in found if off is not None)
        later = len(other)
        while later and other[later - 1][0] >= t_s:
            later -= 1
        if 0 < later < len(other):
            off = _off_line((t_s, range_m), other[later - 1], other[later])
            self._apart.extend([] if off is None else [(t_s, sign * off / unit_m)])
        mine.append((t_s, range_m))

    def apart(self, now_s: float) -> float:
        """By how many sigmas they differ in the middle; 0 where it is not told."""
        fresh = [off for t_s, off in self._apart if now_s - t_s <= 2.0 * WAIT_S]
        return abs(float(np.median(fresh))) if len(fresh) == ENDS_RANGES else 0.0


def _off_line(at: tuple[float, float], before: tuple[float, float], after: tuple[float, float]) -> float | None:
    """How far a range is off the line between two; ``None`` where they are too far apart for it to be straight."""
    gap_s = after[0] - before[0]
    if not 0.0 < gap_s <= STRAIGHT_S:
        return None
    share = (at[0] - before[0]) / gap_s
    return at[1] - (1.0 - share) * before[1] - share * after[1]


class Baselines:
    """Collects rows and gives bins, each once all that belongs to it can have come."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._fixes: dict[int, _Fixes] = {}
        self._waiting: deque[_Waiting] = deque()
        self._open: dict[int, dict[Pair, list[_Held]]] = {}
        self._scatter: dict[tuple[int, int], _Scatter] = {}
        """Of who measured, and to whom."""
        self._ends: dict[Pair, _Ends] = {}
        self._unheld: dict[Pair, int] = {}
        """The bin of the last range that there was no fix to be held against for."""
        self._next: int | None = None

    def take(self, evidence: SharedTick) -> list[Bin]:
        """The bins that a tick closes."""
        self._fixes = {agent: self._fixes.get(agent) or _Fixes() for agent in evidence.agents}
        self._scatter = {pair: each for pair, each in self._scatter.items() if set(pair) <= self._fixes.keys()}
        self._ends = {pair: each for pair, each in self._ends.items() if set(pair) <= self._fixes.keys()}
        self._unheld = {pair: each for pair, each in self._unheld.items() if set(pair) <= self._fixes.keys()}
        self._open = {
            number: {pair: held for pair, held in pairs.items() if set(pair) <= self._fixes.keys()}
            for number, pairs in self._open.items()
        }
        self._hear(evidence)
        now_s = evidence.tick * self._period_s
        self._hold(now_s)
        last = int((now_s - LATE_S) // BIN_S)
        if self._next is None or not 0 <= last - self._next <= FIXES_KEPT:
            self._next = last
        closed = []
        while self._next < last:
            closed.append(self._close(self._next))
            self._next += 1
        return closed

    def _hear(self, evidence: SharedTick) -> None:
        rows = evidence.rows
        t_s = rows["tick"] * self._period_s + rows["offset_s"]
        for agent, instant_s, axes in _fixes_of(rows, t_s):
            place = rows["value"][axes].astype(np.float64)
            self._fixes[evidence.agents[agent]].add(instant_s, place, rows["variance"][axes].astype(np.float64))
        for at in np.flatnonzero(rows["kind"] == Kind.RANGE):
            one, other = evidence.agents[rows["agent"][at]], evidence.agents[rows["other"][at]]
            by = one
            arms = np.array([rows[axis][at] for axis in "xyz"])  # of the antennas, of the one's less the other's
            if one > other:
                one, other, arms = other, one, -arms
            said = float(rows["value"][at]), float(rows["variance"][at])
            self._waiting.append(_Waiting(float(t_s[at]), (one, other), *said, arms, by))

    def _hold(self, now_s: float) -> None:
        """Hold the ranges that fixes surround against them."""
        still: deque[_Waiting] = deque()
        for each in self._waiting:
            t_s, pair = each.t_s, each.pair
            if not all(agent in self._fixes for agent in pair):
                continue
            if not -WAIT_S <= now_s - t_s <= WAIT_S:
                if now_s > t_s:
                    self._hear_unheld(each)
                continue
            one, other = (self._fixes[agent].at(t_s) for agent in pair)
            if one is None or other is None:
                still.append(each)
                continue
            apart = one - other + each.arms_m
            distance = float(np.linalg.norm(apart))
            if min(distance, each.range_m) > NEAREST_M and max(distance, each.range_m) < FARTHEST_M:
                held = self._open.setdefault(int(t_s // BIN_S), {}).setdefault(pair, [])
                held.append((each.range_m - distance, apart, each.variance_m2))
                self._hear_ranging(each, each.range_m - float(apart @ each.arms_m) / distance)
            elif max(distance, each.range_m) < FARTHEST_M:
                self._hear_unheld(each)
        self._waiting = still

    def _hear_unheld(self, each: _Waiting) -> None:
        """A range that cannot be held against fixes: there are none, or they do not tell the direction."""
        self._unheld[each.pair] = max(int(each.t_s // BIN_S), self._unheld.get(each.pair, 0))
        # which way the antennas' lever arms point is not known: they may be all of what it is off
        self._hear_ranging(each, each.range_m, float(np.linalg.norm(each.arms_m)))

    def _hear_ranging(self, each: _Waiting, between_m: float, arm_m: float = 0.0) -> None:
        """A range for what the pair's ranges say of themselves, between the bodies as well as that is known."""
        pair, by, sigma_m = each.pair, each.measured_by, max(math.hypot(each.variance_m2**0.5, arm_m), LEAST_SIGMA_M)
        to = pair[0] if by == pair[1] else pair[1]
        if self._scatter.setdefault((by, to), _Scatter()).hear(each.t_s, each.range_m, between_m, sigma_m):
            self._ends.setdefault(pair, _Ends()).hear(each.t_s, by, pair, between_m, sigma_m)

    def _close(self, number: int) -> Bin:
        from_s = number * BIN_S
        held = self._open.pop(number, {})
        pairs = {pair: _left_over(each, self._ranging(pair, from_s)) for pair, each in held.items()}
        self._open = {each: held for each, held in self._open.items() if each > number}
        variances = {agent: fixes.mean_variance(from_s, from_s + BIN_S) for agent, fixes in self._fixes.items()}
        late = number - round((WAIT_S + LATE_S + 1.0) / BIN_S)
        unheld = [pair for pair, last in self._unheld.items() if last >= late and pair not in pairs]
        known = {agent: each for agent, each in variances.items() if each is not None}
        return Bin(number, pairs, known, {pair: self._ranging(pair, from_s) for pair in unheld})

    def _ranging(self, pair: Pair, now_s: float) -> Ranging:
        """Of those of its ends that measured."""
        ways = [self._scatter[way] for way in (pair, pair[::-1]) if way in self._scatter]
        apart = self._ends[pair].apart(now_s) if pair in self._ends else 0.0
        return Ranging(max(each.sigmas() for each in ways), apart, any(each.stuck for each in ways))


def _left_over(held: list[_Held], ranging: Ranging) -> LeftOver:
    """Of the few ranges of a pair in a bin: in plain floats, which are faster here than arrays."""
    residuals = sorted(residual for residual, _, _ in held)
    direction, distance = np.zeros(3), 0.0
    for _, way, _ in held:
        away = math.sqrt(float(way @ way))
        distance += away / len(held)
        direction += way / away
    direction /= len(held)
    norm = math.sqrt(float(direction @ direction))
    median = _middle(residuals)
    disagreeing = NORMAL_OF_MEDIAN * _middle(sorted(abs(each - median) for each in residuals))
    if len(held) == 1:
        disagreeing = max(LONE_M, abs(median) / LONE_SIGMAS)
    claimed = sum(variance for _, _, variance in held) / len(held)
    spread = max(claimed * max(ranging.scatter, 1.0) ** 2, disagreeing**2)
    variance = math.pi / 2.0 * spread / len(held) + (CURVED_M2 / distance) ** 2
    nats = 0.0 if len(held) == 1 else _blocked_nats(disagreeing, max(claimed**0.5, LEAST_SIGMA_M))
    unit = direction / norm if norm > 0.0 else direction
    return LeftOver(median, unit, distance, ranging, nats, variance)


def _blocked_nats(scatter_m: float, sigma_m: float) -> float:
    """Odds of an exponential scatter against that of what ranges claim, with as much for their ends and motion."""
    sigma_m = math.hypot(sigma_m, LEAST_LOBE_M)
    blocked = -scatter_m / BLOCKED_SCATTER_M - math.log(BLOCKED_SCATTER_M)
    sound = -0.5 * (scatter_m / sigma_m) ** 2 - math.log(sigma_m * math.sqrt(np.pi / 2.0))
    return min(max(blocked - sound, -SCATTER_NATS), SCATTER_NATS)


def _middle(ordered: Sequence[float]) -> float:
    """The median of numbers in their order."""
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else 0.5 * (ordered[half - 1] + ordered[half])


def _fixes_of(rows: RowTable, t_s: Vector) -> Iterable[tuple[int, float, list[int]]]:
    """Whole fixes: the slot, the instant, and the rows of north, east and down."""
    found: dict[tuple[int, float], dict[int, int]] = {}
    for at in np.flatnonzero(rows["kind"] == Kind.POSITION):
        for axis, name in enumerate("xyz"):
            if rows[name][at] == 1.0:
                found.setdefault((int(rows["agent"][at]), float(t_s[at])), {})[axis] = int(at)
    whole = ((key, axes) for key, axes in found.items() if len(axes) == 3)
    return [(agent, instant_s, [axes[0], axes[1], axes[2]]) for (agent, instant_s), axes in whole]
