"""How a feed begins without a step: the first position that is fed is the autopilot's own.

Its receiver and the fleet are never quite of one opinion, and without fixes it drifts until the loss is noticed. An
autopilot that begins to use positions from outside is set to the first of them (PX4 when nothing else aids it,
ArduPilot at the change of the source set), so that the difference would be a step in flight. It is taken off slowly.
"""

from __future__ import annotations

import math

import numpy as np

from estimators.model.measurements import Vector

RATE_MPS = 0.4
"""So fast is a difference taken off, horizontally and vertically."""
LARGEST_HORIZONTAL_M, LARGEST_VERTICAL_M = 3.0, 5.0
"""An autopilot that is further off is set to the estimate at once: it would be led astray for too long."""
STRAYED_M = 4.5
"""The same of one that was near enough when the feed began, and drifts until it takes what it is fed."""
LED_S = 2.0
"""A small difference is taken off within about so long."""
PX4_COUNTS_ON_GPS_S = 8.0
"""So long after its last fix PX4 counts on its receiver. Of a feed in a local frame it takes the motion alone then,
and when it gives the receiver up, after 7.0 to 7.2 s in its own simulator, it sets itself to what it is fed."""


class Handover:
    """Of one feed: ``shift_m`` and ``rate_mps`` ``(3,)`` NED are added to the estimate's position and velocity.

    What is fed is then where an autopilot is that moves as it is told: it knows nothing of the difference, which is
    no error of what it is fed. Counted as one, it made a feed so loose that an autopilot drifted by metres.
    """

    def __init__(self) -> None:
        self.shift_m: Vector = np.zeros(3)
        self.rate_mps: Vector = np.zeros(3)
        self._at_s = -math.inf

    def begin(self, apart_m: Vector | None, t_s: float) -> None:
        """The feed begins, or is only prepared, with an estimate of ``t_s`` that is ``apart_m`` ``(3,)`` from the
        autopilot's own position; ``None`` if that is not known."""
        self._be_at(apart_m, LARGEST_HORIZONTAL_M, t_s)

    def follow(self, apart_m: Vector, t_s: float) -> Vector:
        """The autopilot takes nothing but the motion yet: be where it is, lest it be set elsewhere later.

        The velocity leads it to the estimate meanwhile, along the ground. By how much the shift changed, ``(3,)``.
        """
        before_m = self.shift_m
        self._be_at(apart_m, STRAYED_M, t_s)
        across = self.shift_m[:2]
        self.rate_mps[:2] = -across / max(math.hypot(*across) / RATE_MPS, LED_S)
        return np.asarray(self.shift_m - before_m)

    def _be_at(self, apart_m: Vector | None, farthest_m: float, t_s: float) -> None:
        self._at_s = t_s
        self.shift_m, self.rate_mps = np.zeros(3), np.zeros(3)
        if apart_m is None or not np.isfinite(apart_m).all():
            return
        if math.hypot(apart_m[0], apart_m[1]) <= farthest_m and abs(apart_m[2]) <= LARGEST_VERTICAL_M:
            self.shift_m = -np.asarray(apart_m, float)

    def go_on(self, t_s: float) -> Vector:
        """Take some of it off; by how much the shift changed, ``(3,)``."""
        elapsed_s = max(t_s - self._at_s, 0.0)
        most_m = RATE_MPS * elapsed_s
        self._at_s = t_s
        before_m = self.shift_m
        across_m = math.hypot(before_m[0], before_m[1])
        sizes_m = np.array((across_m, across_m, abs(before_m[2])))
        left_m = np.maximum(sizes_m - most_m, 0.0)
        self.shift_m = before_m * np.divide(left_m, sizes_m, out=np.zeros(3), where=sizes_m > 0.0)
        change_m = np.asarray(self.shift_m - before_m)
        self.rate_mps = change_m / elapsed_s if elapsed_s > 0.0 else np.zeros(3)
        return change_m
