"""GPS and UTC stamps in a log to the Unix time of log time 0."""

from __future__ import annotations

import calendar
import math
from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np

from agent.mavlink.utc_stamps import ROLLOVER_S
from estimators.model.measurements import Vector
from sim_bridge.replay.logs.events import UnixZero

GPS_EPOCH_UNIX_S = 315_964_800
WEEK_S = 604_800
LEAPS_UNIX_S = tuple(
    calendar.timegm((year, month, 1, 0, 0, 0))
    for year, month in (
        (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7), (1994, 7),
        (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
    )
)  # fmt: skip
"""When UTC fell a second further behind GPS time (IERS Bulletin C)."""
EARLIEST_UNIX_S = 1_262_304_000
"""Start of 2010: no autopilot logged before it, so that an earlier week is one that has rolled over."""
RECEIVER_LATENCY_SIGMA_S = 0.1
"""Fixes are logged 0.05 to 0.25 s after their instant, which the fit cannot see."""
FEWEST = 2
MAX_DRIFT = 0.05
DRIFT_SPAN_S = 30.0
"""Over less the drift is not told from the receiver's jitter, and taken as none."""
KEPT = 2048


def unix_of_week(week: int, of_week_ms: int) -> float:
    """Unix time of a GPS week and the milliseconds of it, with the leap seconds of that date."""
    gps_s = since_earliest(GPS_EPOCH_UNIX_S + week * WEEK_S + of_week_ms * 1e-3)
    leaps = bisect_right([unix_s + count for count, unix_s in enumerate(LEAPS_UNIX_S, 1)], gps_s)
    return gps_s - leaps


def since_earliest(unix_s: float) -> float:
    """A time of a receiver with as many turns of its week as make it later than all autopilots."""
    return unix_s + ROLLOVER_S * max(math.ceil((EARLIEST_UNIX_S - unix_s) / ROLLOVER_S), 0)


@dataclass(slots=True)
class GpsTimeFit:
    """Pairs of log and Unix time to a line; memory is bounded by keeping every second pair when full."""

    pairs: list[tuple[float, float]] = field(default_factory=list)
    stride: int = 1
    seen: int = 0

    def add(self, t_s: float, unix_s: float) -> None:
        """Take in that it was ``unix_s`` at log time ``t_s``; what is not finite is left out."""
        if not (math.isfinite(t_s) and math.isfinite(unix_s)):
            return
        self.seen += 1
        if self.seen % self.stride == 0:
            self.pairs.append((t_s, unix_s))
            if len(self.pairs) >= KEPT:
                self.pairs = self.pairs[::2]
                self.stride *= 2

    def unix_zero(self) -> UnixZero:
        """By receiver time: the median line, which single wrong stamps do not bend."""
        line = fitted(self.pairs)
        if line is None:
            return UnixZero(0.0, math.inf, "unknown")
        offset_s, drift, spread_s = line
        return UnixZero(offset_s, math.hypot(spread_s, RECEIVER_LATENCY_SIGMA_S), "gps", drift)


def fitted(pairs: list[tuple[float, float]]) -> tuple[float, float, float] | None:
    """Offset at log time 0, drift, and robust spread of Unix minus log time; ``None`` of too few pairs."""
    if len(pairs) < FEWEST:
        return None
    t_s, unix_s = np.array(pairs).T
    centre_s = float(np.median(t_s))
    difference_s = unix_s - t_s
    level_s = float(np.median(difference_s))
    drift = _median_slope(t_s, difference_s - level_s)
    residual_s = difference_s - level_s - drift * (t_s - centre_s)
    shift_s = float(np.median(residual_s))
    spread_s = 1.4826 * float(np.median(np.abs(residual_s - shift_s)))
    return level_s + shift_s - drift * centre_s, drift, spread_s


def _median_slope(x: Vector, y: Vector) -> float:
    """Median of the slopes between points half the data apart (after Theil and Sen)."""
    half = len(x) // 2
    run = x[half:] - x[: len(x) - half]
    usable = run > 0
    if not usable.any() or np.ptp(x) < DRIFT_SPAN_S:
        return 0.0
    slope = float(np.median((y[half:] - y[: len(y) - half])[usable] / run[usable]))
    return min(max(slope, -MAX_DRIFT), MAX_DRIFT)
