"""What an autopilot without positions takes for its attitude."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sim_bridge.world import quaternions
from sim_bridge.world.quaternions import Array
from sim_bridge.world.sensors import SensedAttitude

AIDED_S = 1.0
"""Position is called good for this long after the last fix or feed."""
TILT_RAD = math.radians(2.2)
"""Without a position an autopilot takes part of its own motion for gravity: PX4's attitude in flight is tilted by 1.9
to 2.6 degrees then, one way for as long as it lasts, within a second."""
UPRIGHT_RAD = 1e-4
"""A smaller tilt is none."""
TILT_TIME_S = 0.5
"""Time constant of the tilt, when it comes and when it goes."""


class UnaidedTilt:
    """The tilt of one autopilot; none before its first position, when it stands still and gravity levels it."""

    def __init__(self) -> None:
        self._now_rad: Array = np.zeros(3)
        self._towards_rad: Array = np.zeros(3)
        """Rotation vectors in NED."""

    def attitude(self, sensed: SensedAttitude) -> SensedAttitude:
        """The attitude as the autopilot has it."""
        if not self._now_rad.any():
            return sensed
        turn = quaternions.from_rotation_vector(self._now_rad[None])
        return replace(sensed, quaternion=quaternions.multiply(turn, sensed.quaternion[None])[0])

    def step(self, step_s: float, aided: bool, velocity_mps: Array) -> None:
        """Let the tilt follow; its direction is that of the motion ``(3,)`` NED when the positions stopped."""
        if aided and not self._now_rad.any():
            across = np.array((-velocity_mps[1], velocity_mps[0], 0.0))
            size = float(np.linalg.norm(across))
            self._towards_rad = TILT_RAD * (across / size if size > 0.0 else np.array((0.0, 1.0, 0.0)))
            return
        share = 1.0 - math.exp(-step_s / TILT_TIME_S)
        self._now_rad = self._now_rad + share * ((0.0 if aided else self._towards_rad) - self._now_rad)
        if aided and float(np.linalg.norm(self._now_rad)) < UPRIGHT_RAD:
            self._now_rad = np.zeros(3)
