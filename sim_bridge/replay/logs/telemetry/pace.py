"""Simulators that run slower, or faster, than the clock of the recorder beside them.

Gazebo on a loaded computer runs at a third of real time, in the next minute at another pace: on the recorder's time
no acceleration fits the motion. The boot clock is then the log's clock. A vehicle's crystal is never off by a
thousandth of that.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import pairwise

KNOT_S = 0.25
MOST_KNOTS = 8192
STRETCH_S = 10.0
"""Over so long a link's jitter is small beside what the clocks gain."""
SHORTEST_S = 3.0
OFF, OFF_ALL = 0.1, 0.04
"""A pace off by this is a simulator's: over a stretch, and over all; `BootClockFit` follows what is less."""
JITTER_S = 0.5
"""What a slow radio may make of a stretch, besides."""
OFF_SHARE = 0.25
REBOOT_S = 1.0
FASTEST = 10.0

Knot = tuple[float, float]
"""Arrival and the latest boot time so far, in s."""


@dataclass(slots=True)
class PaceSurvey:
    """Boot times of one source as they came, a few a second."""

    knots: list[Knot] = field(default_factory=list)
    width_s: float = KNOT_S

    def add(self, boot_s: float, arrival_s: float) -> None:
        """Take in that a message stamped ``boot_s`` was there at ``arrival_s``."""
        if self.knots and arrival_s - self.knots[-1][0] < self.width_s:
            return
        self.knots.append((arrival_s, boot_s))
        if len(self.knots) > MOST_KNOTS:
            self.knots = self.knots[::2]
            self.width_s *= 2

    def pace(self) -> Pace | None:
        """The log's clock by these boot times; ``None`` where the recorder's fits them."""
        paces = [((b1 - b0) / (a1 - a0), a1 - a0) for (a0, b0), (a1, b1) in self._stretches()]
        whole_s = sum(duration_s for _, duration_s in paces)
        if not whole_s:
            return None
        mean = sum(pace * duration_s for pace, duration_s in paces) / whole_s
        off_s = sum(each_s for pace, each_s in paces if abs(pace - 1.0) * each_s > OFF * each_s + JITTER_S)
        steadily = abs(mean - 1.0) > OFF_ALL and whole_s >= 2 * STRETCH_S
        if mean <= 0.0 or not (steadily or off_s > OFF_SHARE * whole_s):
            return None
        return _paced(self.knots, mean)

    def _stretches(self) -> list[tuple[Knot, Knot]]:
        """Begin and end of stretches without a jump of the clock; the last one before each may be shorter."""
        found, begin = [], 0
        for k in range(1, len(self.knots) + 1):
            last = k == len(self.knots) or not _goes_on(self.knots[k - 1], self.knots[k])
            duration_s = self.knots[k - 1][0] - self.knots[begin][0]
            if duration_s >= STRETCH_S or (last and duration_s >= SHORTEST_S):
                found.append((self.knots[begin], self.knots[k - 1]))
                begin = k - 1
            if last:
                begin = k
        return found


@dataclass(frozen=True, slots=True)
class Pace:
    """Log time of the recorder's time; ``mean`` is what the vehicles' clocks gained per second of it."""

    arrivals_s: list[float]
    logs_s: list[float]
    mean: float

    def log_s(self, arrival_s: float) -> float:
        """Log time, 0 at the recorder's 0, rising with it."""
        place = bisect_right(self.arrivals_s, arrival_s)
        if place == 0:
            return self.logs_s[0] + self.mean * (arrival_s - self.arrivals_s[0])
        if place == len(self.arrivals_s):
            return self.logs_s[-1] + self.mean * (arrival_s - self.arrivals_s[-1])
        before_s, behind_s = self.arrivals_s[place - 1], self.arrivals_s[place]
        share = (arrival_s - before_s) / (behind_s - before_s)
        return self.logs_s[place - 1] + share * (self.logs_s[place] - self.logs_s[place - 1])


def _paced(knots: list[Knot], mean: float) -> Pace:
    first_s, top_s = knots[0]
    logs_s = [mean * first_s]
    for (before_s, _), (arrival_s, boot_s) in pairwise(knots):
        if _goes_on((before_s, top_s), (arrival_s, boot_s)):
            logs_s.append(logs_s[-1] + max(boot_s - top_s, 0.0))
            top_s = max(boot_s, top_s)
        else:
            logs_s.append(logs_s[-1] + mean * (arrival_s - before_s))
            top_s = boot_s
    return Pace([arrival_s for arrival_s, _ in knots], logs_s, mean)


def _goes_on(before: Knot, behind: Knot) -> bool:
    """Whether a boot clock went on from one knot to the next: no reboot, no jump."""
    return -REBOOT_S <= behind[1] - before[1] <= FASTEST * (behind[0] - before[0]) + REBOOT_S
