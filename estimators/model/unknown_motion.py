"""What nobody tells of a drone's motion: the spread of a position that follows from accelerations not known."""

from __future__ import annotations

import math

MANOEUVRE_S = 3.0
"""How long an acceleration that is not known lasts."""


def silence_sigma_m(silent_s: float, accel_variance: float, period_s: float) -> float:
    """1-sigma per axis that a time without any data adds to a position.

    An acceleration of variance q, drawn anew each tick T, moves a position by ``sqrt(q T t^3 / 3)`` in a time t.
    """
    return math.sqrt(accel_variance * period_s * max(silent_s, 0.0) ** 3 / 3.0)


def unseen_variance(unseen_ticks: int, accel_variance: float, period_s: float) -> float:
    """Variance per axis of the tick-averaged acceleration of a drone that has not been heard for some ticks.

    Drawn anew each tick, unknown accelerations would cancel out; real ones last. The position variance of a constant
    one grows with the fourth power of time, which white ones give whose variance grows with time, ``2 q t / T``;
    after the time that a manoeuvre lasts it grows no further (R. A. Singer, 1970).
    """
    lasting_ticks = min(unseen_ticks, MANOEUVRE_S / period_s)
    return max(2.0 * lasting_ticks, 1.0) * accel_variance
