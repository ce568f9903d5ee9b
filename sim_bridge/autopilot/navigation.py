"""The autopilot's own navigation: a small fixed-gain filter, so that what it reports is not the truth.

Everything in the fleet's NED frame; the wire's coordinates are relative to `Navigation.origin_m`, the point
where the autopilot first knew its position.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sim_bridge.world import quaternions
from sim_bridge.world.quaternions import Array
from sim_bridge.world.sensors import GpsFix, SensedAttitude

PERIOD_S = 0.02
POSITION_GAIN = 0.3
VELOCITY_GAIN = 0.5
VELOCITY_FROM_POSITION_PER_S = 0.3
AIDED_S = 1.0
"""Position is called good for this long after the last fix or feed."""
UNAIDED_TILT_RAD = math.radians(2.2)
"""Without a position an autopilot takes part of its own motion for gravity: PX4's attitude in flight is tilted by 1.9
to 2.6 degrees then, one way for as long as it lasts, within a second."""
UPRIGHT_RAD = 1e-4
"""A smaller tilt is none."""
TILT_TIME_S = 0.5
"""Time constant of the tilt, when it comes and when it goes."""


class Navigation:
    """Position and velocity as the autopilot believes them; nothing before the first fix or feed."""

    def __init__(self) -> None:
        self.origin_m: Array | None = None
        self.position_m: Array = np.zeros(3)
        self.velocity_mps: Array = np.zeros(3)
        self._aided_s = -np.inf
        self._predicted_s: float | None = None
        self._tilt_rad: Array = np.zeros(3)
        self._tilts_to_rad: Array = np.zeros(3)
        """Rotation vector in NED, of the outage that lasts or was the last."""

    def attitude(self, sensed: SensedAttitude) -> SensedAttitude:
        """The attitude as the autopilot has it: tilted without positions."""
        if not self._tilt_rad.any():
            return sensed
        turn = quaternions.from_rotation_vector(self._tilt_rad[None])
        return replace(sensed, quaternion=quaternions.multiply(turn, sensed.quaternion[None])[0])

    def aided(self, now: float) -> bool:
        """Whether a position came lately."""
        return self.origin_m is not None and now - self._aided_s <= AIDED_S

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
            self._lean(step_s, self.aided(now))
            self.position_m = self.position_m + step_s * self.velocity_mps + 0.5 * step_s**2 * accel_ned_mps2
            self.velocity_mps = self.velocity_mps + step_s * accel_ned_mps2
        self._predicted_s = now

    def _lean(self, step_s: float, aided: bool) -> None:
        """Let the tilt follow; its direction is that of the vehicle's motion when the positions stopped."""
        if aided and not self._tilt_rad.any():
            across = np.array((-self.velocity_mps[1], self.velocity_mps[0], 0.0))
            size = float(np.linalg.norm(across))
            self._tilts_to_rad = UNAIDED_TILT_RAD * (across / size if size > 0.0 else np.array((0.0, 1.0, 0.0)))
            return
        share = 1.0 - math.exp(-step_s / TILT_TIME_S)
        self._tilt_rad = self._tilt_rad + share * ((0.0 if aided else self._tilts_to_rad) - self._tilt_rad)
        if aided and float(np.linalg.norm(self._tilt_rad)) < UPRIGHT_RAD:
            self._tilt_rad = np.zeros(3)

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

    def on_fix(self, fix: GpsFix, now: float) -> None:
        """Use a valid fix of the autopilot's own receiver."""
        self.correct(np.array(fix.position_ned_m), np.array(fix.velocity_ned_mps), now)
