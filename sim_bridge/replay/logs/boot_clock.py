"""A vehicle's boot clock on log time, fitted to a whole log.

Messages arrive late, never early, so of all differences of arrival and boot time the lowest ones show the
offset of the two clocks, less the smallest latency of the link. Around each instant the offset is the line below
all differences that is closest to them in the mean: the edge of their lower convex hull over its centre (Zhang,
Liu, Xia 2002, clock synchronisation from one-way delays). The wider that window, the surer it holds a message that
did not wait; but the clock of a simulator on a loaded computer changes its pace and stalls, so that the window is
only as wide as the link's jitter asks for. A reboot begins anew.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import pairwise

from agent.mavlink.boot_times import WRAP_MS_S, turns

MAX_POINTS = 4096
"""Lowest differences kept per boot; a longer log keeps them coarser."""
FINEST_BUCKET_S = 0.25
WINDOW_S, NARROWEST_S = 10.0, 1.0
"""Half width of the windows at most and at least; they lie half of that apart."""
WINDOW_PER_JITTER = 100.0
FEWEST_POINTS = 4
MAX_DRIFT = 0.05
REBOOT_BACKWARDS_S = 1.0
EARLY_S, LATE_S = 1.0, 10.0
"""A message this much before, or behind, what the offset of the last ones allows belongs to another clock."""
CONFIRM, CONFIRM_S = 5, 0.5
"""A new clock is believed after so many messages that agree, over so long: a burst of overtaken ones is shorter."""
MOST_SUSPECTS = 512

Point = tuple[float, float]
"""Boot time and arrival minus boot time, in seconds."""


@dataclass(slots=True)
class _Bucket:
    """The messages of a stretch of boot time: the one with the lowest difference, and the mean of all."""

    lowest: Point
    mean_s: float
    count: int


@dataclass(frozen=True, slots=True)
class BootSession:
    """One boot: from which log time on, and offset of log time by boot time, piecewise linear."""

    from_s: float
    nodes_s: tuple[float, ...]
    offsets_s: tuple[float, ...]
    drift: float
    """Of the offset, before the first and behind the last node."""

    def log_s(self, boot_s: float) -> float:
        """Log time of a boot time."""
        nodes, offsets = self.nodes_s, self.offsets_s
        place = bisect_right(nodes, boot_s)
        if place == 0:
            return boot_s + offsets[0] + self.drift * (boot_s - nodes[0])
        if place == len(nodes):
            return boot_s + offsets[-1] + self.drift * (boot_s - nodes[-1])
        share = (boot_s - nodes[place - 1]) / (nodes[place] - nodes[place - 1])
        return boot_s + offsets[place - 1] + share * (offsets[place] - offsets[place - 1])


@dataclass(slots=True)
class _Boot:
    """The differences of one boot, by stretches of boot time."""

    from_s: float
    width_s: float = FINEST_BUCKET_S
    buckets: dict[int, _Bucket] = field(default_factory=dict)

    def add(self, boot_s: float, difference_s: float) -> None:
        place = int(boot_s / self.width_s)
        bucket = self.buckets.get(place)
        if bucket is None:
            self.buckets[place] = _Bucket((boot_s, difference_s), difference_s, 1)
            if len(self.buckets) > MAX_POINTS:
                self._coarsen()
            return
        bucket.count += 1
        bucket.mean_s += (difference_s - bucket.mean_s) / bucket.count
        if difference_s < bucket.lowest[1]:
            bucket.lowest = (boot_s, difference_s)

    def _coarsen(self) -> None:
        finer, self.buckets = self.buckets, {}
        self.width_s *= 2
        for place, bucket in finer.items():
            other = self.buckets.get(place // 2)
            if other is None:
                self.buckets[place // 2] = bucket
            else:
                count = other.count + bucket.count
                mean_s = other.mean_s + (bucket.mean_s - other.mean_s) * bucket.count / count
                lowest = min(other.lowest, bucket.lowest, key=_difference)
                self.buckets[place // 2] = _Bucket(lowest, mean_s, count)

    def jitter_s(self) -> float:
        """How differently late messages are: within stretches, and from one to the next."""
        ordered = [self.buckets[place] for place in sorted(self.buckets)]
        spreads = [
            max(bucket.mean_s - bucket.lowest[1], abs(bucket.lowest[1] - before.lowest[1]))
            for before, bucket in pairwise(ordered)
        ]
        return sorted(spreads)[len(spreads) // 2] if spreads else 0.0


class BootClockFit:
    """Takes boot times with their arrivals in the order of arrival, makes `BootSession` of them.

    The boot times begin anew every ``wrap_s``, which is no reboot.
    """

    def __init__(self, wrap_s: float = WRAP_MS_S) -> None:
        self._wrap_s = wrap_s
        self._boots: list[_Boot] = []
        self._top_s = 0.0
        self._low: Point = (0.0, 0.0)
        self._next_low: Point = (0.0, 0.0)
        self._suspects: list[tuple[float, float]] = []
        self.reboots = 0
        self.jumps = 0
        """Times that the clock jumped without going back to a boot."""
        self.refused = 0
        """Single stamps that fitted nothing."""

    def add(self, boot_s: float, arrival_s: float) -> None:
        """Take in that a message stamped ``boot_s`` was there at log time ``arrival_s``."""
        boot_s += turns(boot_s, arrival_s - self._low[1], self._wrap_s) * self._wrap_s if self._boots else 0.0
        if not self._boots:
            self._begin(boot_s, arrival_s)
        elif not self._belongs(boot_s, arrival_s):
            self._doubt(boot_s, arrival_s)
            return
        self.refused += len(self._suspects)
        self._suspects.clear()
        self._take(boot_s, arrival_s)

    @property
    def heard(self) -> bool:
        """Whether any boot time was taken in."""
        return bool(self._boots)

    def sessions(self) -> list[BootSession]:
        """The boots in their order; none if nothing was taken in."""
        return [_fitted(boot) for boot in self._boots]

    def _begin(self, boot_s: float, arrival_s: float) -> None:
        self._boots.append(_Boot(arrival_s))
        self._top_s = 0.0
        self._low = self._next_low = (boot_s, arrival_s - boot_s)

    def _belongs(self, boot_s: float, arrival_s: float) -> bool:
        if boot_s < self._top_s - REBOOT_BACKWARDS_S:
            return False
        slack = MAX_DRIFT * abs(boot_s - self._low[0])
        later_s = arrival_s - boot_s - self._low[1]
        return -EARLY_S - slack <= later_s <= LATE_S + slack

    def _take(self, boot_s: float, arrival_s: float) -> None:
        self._top_s = max(self._top_s, boot_s)
        difference_s = arrival_s - boot_s
        # The reference is the lowest difference of the last stretch, not of all: it drifts.
        if difference_s < self._next_low[1]:
            self._next_low = (boot_s, difference_s)
        if boot_s - self._low[0] > WINDOW_S:
            self._low, self._next_low = self._next_low, (boot_s, difference_s)
        self._boots[-1].add(boot_s, difference_s)

    def _doubt(self, boot_s: float, arrival_s: float) -> None:
        """Begin a new boot once several messages in a row agree on it."""
        if self._suspects:
            last_boot_s, last_arrival_s = self._suspects[-1]
            if abs((boot_s - last_boot_s) - (arrival_s - last_arrival_s)) > EARLY_S:
                self.refused += len(self._suspects)
                self._suspects.clear()
        self._suspects.append((boot_s, arrival_s))
        if len(self._suspects) < CONFIRM or arrival_s - self._suspects[0][1] < CONFIRM_S:
            if len(self._suspects) > MOST_SUSPECTS:
                self._suspects.pop(0)
                self.refused += 1
            return
        if boot_s < self._top_s - REBOOT_BACKWARDS_S:
            self.reboots += 1
        else:
            self.jumps += 1
        confirmed, self._suspects = self._suspects, []
        self._begin(*confirmed[0])
        for suspect in confirmed:
            self._take(*suspect)


class LogBootClock:
    """Log time of a vehicle's boot times, each by the boot that was running when the message arrived."""

    def __init__(self, sessions: list[BootSession]) -> None:
        self._sessions = sessions
        self._starts = [session.from_s for session in sessions]

    def session(self, arrival_s: float) -> int:
        """Which boot was running, from 0; -1 if no boot time was ever heard."""
        if not self._sessions:
            return -1
        return max(bisect_right(self._starts, arrival_s) - 1, 0)

    def log_s(self, boot_s: float, arrival_s: float) -> float | None:
        """Log time of a boot time that arrived at ``arrival_s``; ``None`` if no boot time was ever heard."""
        place = self.session(arrival_s)
        return None if place < 0 else self._sessions[place].log_s(boot_s)

    def unwrapped_s(self, boot_s: float, arrival_s: float, wrap_s: float) -> float | None:
        """The same of a boot time that begins anew every ``wrap_s``."""
        t_s = self.log_s(boot_s, arrival_s)
        begun = 0 if t_s is None else turns(t_s, arrival_s, wrap_s, wrap_s / 4)
        return self.log_s(boot_s + begun * wrap_s, arrival_s) if begun else t_s


def _difference(point: Point) -> float:
    return point[1]


def _fitted(boot: _Boot) -> BootSession:
    points = sorted(bucket.lowest for bucket in boot.buckets.values())
    first_s, last_s = points[0][0], points[-1][0]
    half_s = min(max(WINDOW_PER_JITTER * boot.jitter_s(), NARROWEST_S, 4 * boot.width_s), WINDOW_S)
    if len(points) < FEWEST_POINTS or last_s - first_s < half_s:
        return BootSession(boot.from_s, (first_s,), (min(map(_difference, points)),), 0.0)
    count = max(2, round((last_s - first_s) / (half_s / 2)) + 1)
    nodes = [first_s + (last_s - first_s) * i / (count - 1) for i in range(count)]
    offsets, drifts = [], []
    boots_s = [boot_s for boot_s, _ in points]
    for node_s in nodes:
        window = points[bisect_right(boots_s, node_s - half_s) : bisect_right(boots_s, node_s + half_s)]
        offset_s, drift = _supporting_line(window or points, node_s)
        offsets.append(offset_s)
        drifts.append(drift)
    return BootSession(boot.from_s, tuple(nodes), tuple(offsets), sorted(drifts)[count // 2])


def _supporting_line(points: list[Point], at_s: float) -> tuple[float, float]:
    """Value at ``at_s`` and slope of the line below all points that is closest to them in the mean."""
    hull = _lower_hull(points)
    centre_s = sum(boot_s for boot_s, _ in points) / len(points)
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x0 <= centre_s <= x1:
            slope = min(max((y1 - y0) / (x1 - x0), -MAX_DRIFT), MAX_DRIFT)
            return y0 + slope * (at_s - x0), slope
    return min(y for _, y in points), 0.0


def _lower_hull(points: list[Point]) -> list[Point]:
    """Andrew's monotone chain; the points in the order of their abscissae."""
    hull: list[Point] = []
    for point in points:
        while len(hull) >= 2 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        if hull and point[0] == hull[-1][0]:
            continue
        hull.append(point)
    return hull


def _turn(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
