"""The autopilot's own navigation: a small fixed-gain filter, so that what it reports is not the truth.

Everything in the fleet's NED frame; the wire's coordinates are relative to `Navigation.origin_m`, the point
where the autopilot first knew its position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_bridge.world.quaternions import Array
from sim_bridge.world.sensors import GpsFix, SensedAttitude
from sim_bridge.world.unaided import AIDED_S, UnaidedTilt

PERIOD_S = 0.02
POSITION_GAIN = 0.3
VELOCITY_GAIN = 0.5
VELOCITY_FROM_POSITION_PER_S = 0.3


@dataclass(frozen=True, slots=True)
class OutsideState:
    """A position from outside in the fleet frame, NED, its 1-sigmas per axis, and the instant it is taken for.

    An axis that is NaN is not used; an innovation above ``gate`` sigmas is refused. ``relative``: while the autopilot
    counts on its own receiver, it takes the difference for an offset of the feed.
    """

    position_m: Array
    velocity_mps: Array | None
    position_sigma_m: Array
    velocity_sigma_mps: Array
    taken_s: float
    reset_counter: int
    gate: float = 5.0
    relative: bool = False


class Navigation:
    """Position and velocity as the autopilot believes them; nothing before the first fix or feed."""

    def __init__(self) -> None:
        self.origin_m: Array | None = None
        self.position_m: Array = np.zeros(3)
        self.velocity_mps: Array = np.zeros(3)
        self._aided_s = -np.inf
        self._predicted_s: float | None = None
        self._tilt = UnaidedTilt()

    def attitude(self, sensed: SensedAttitude) -> SensedAttitude:
        """The attitude as the autopilot has it: tilted without positions."""
        return self._tilt.attitude(sensed)

    def aided(self, now: float) -> bool:
        """Whether a position came lately."""
        return self.origin_m is not None and now - self._aided_s <= AIDED_S

    def unaided_s(self, now: float) -> float:
        """Since a position was used."""
        return now - self._aided_s

    def ratio(self, now: float) -> float:
        """Of the horizontal innovation and its gate, as the autopilot tells it."""
        return 0.1 if self.aided(now) else 1.0

    def set_origin(self, origin_m: Array) -> None:
        """Set the origin (of an autopilot that never had a fix) and start there."""
        self.origin_m = origin_m
        self.position_m = np.array(origin_m, float)

    def due(self, now: float) -> bool:
        """Whether the next prediction is due."""
        return self._predicted_s is None or now - self._predicted_s >= PERIOD_S - 1e-6

    def predict(self, accel_ned_mps2: Array, now: float) -> None:
        """Integrate the measured acceleration ``(3,)`` NED, gravity removed, up to now."""
        if self._predicted_s is not None and self.origin_m is not None:
            step_s = now - self._predicted_s
            self._tilt.step(step_s, self.aided(now), self.velocity_mps)
            self.position_m = self.position_m + step_s * self.velocity_mps + 0.5 * step_s**2 * accel_ned_mps2
            self.velocity_mps = self.velocity_mps + step_s * accel_ned_mps2
        self._predicted_s = now

    def correct(self, position_m: Array, velocity_mps: Array | None, now: float) -> None:
        """Pull towards an outside position (and velocity) ``(3,)`` in the fleet frame."""
        if self.origin_m is None:
            self.set_origin(np.array(position_m, float))
            self.velocity_mps = np.zeros(3) if velocity_mps is None else np.array(velocity_mps, float)
        innovation = position_m - self.position_m
        self.position_m = self.position_m + POSITION_GAIN * innovation
        if velocity_mps is None:
            self.velocity_mps = self.velocity_mps + VELOCITY_FROM_POSITION_PER_S * innovation
        else:
            self.velocity_mps = self.velocity_mps + VELOCITY_GAIN * (velocity_mps - self.velocity_mps)
        self._aided_s = now

    def on_height(self, down_m: float, now: float) -> None:
        """The height of the autopilot's barometer, which this filter does not use."""

    def on_outside(self, outside: OutsideState, now: float) -> None:
        """Use a position from outside, as if it were of now."""
        known = np.where(np.isfinite(outside.position_m), outside.position_m, self.position_m)
        self.correct(known, outside.velocity_mps, now)

    def on_fix(self, fix: GpsFix, now: float) -> None:
        """Use a valid fix of the autopilot's own receiver."""
        self.correct(np.array(fix.position_ned_m), np.array(fix.velocity_ned_mps), now)
