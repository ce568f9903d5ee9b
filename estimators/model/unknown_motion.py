"""What nobody tells of a drone's motion: the spread of a position that follows from accelerations not known."""

from __future__ import annotations

import math

from estimators.model.measurements import Vector

MANOEUVRE_S = 3.0
"""How long an acceleration that is not known lasts."""
TARGET_ACCEL_VARIANCE = 0.02**2
"""Of the acceleration of a target, (m/s2)2 per axis, drawn anew each tick: what walks or drives on the ground."""
TILTED_MPS2 = 0.35
"""1-sigma per horizontal axis of an acceleration whose attitude is that of an autopilot without positions: 2 degrees
of tilt. On PX4 1.9 to 2.6 degrees were measured, 0.33 to 0.45 m/s2, in one direction for 20 s."""


def silence_sigma_m(silent_s: float, accel_variance: float, period_s: float) -> float:
    """1-sigma per axis that a time without any data adds to a position.

    An acceleration of variance q, drawn anew each tick T, moves a position by ``sqrt(q T t^3 / 3)`` in a time t.
    """
    return math.sqrt(accel_variance * period_s * max(silent_s, 0.0) ** 3 / 3.0)


def drift_variances(unseen_s: Vector, accel_variance: float) -> tuple[Vector, Vector]:
    """Variances per axis, m2 and (m/s)2, that an acceleration which is not known adds to a state moved on for a time.

    The acceleration, of variance q, is taken to last: ``q t^4 / 4`` and ``q t^2``.
    """
    return accel_variance * unseen_s**4 / 4.0, accel_variance * unseen_s**2


def unseen_variance(unseen_ticks: int, accel_variance: float, period_s: float) -> float:
    """Variance per axis of the tick-averaged acceleration of a drone that has not been heard for some ticks.

    Drawn anew each tick, unknown accelerations would cancel out; real ones last. The position variance of a constant
    one grows with the fourth power of time, which white ones give whose variance grows with time, ``2 q t / T``;
    after the time that a manoeuvre lasts it grows no further (R. A. Singer, 1970).
    """
    lasting_ticks = min(unseen_ticks, MANOEUVRE_S / period_s)
    return max(2.0 * lasting_ticks, 1.0) * accel_variance
