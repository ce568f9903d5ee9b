"""The fleet as it truly moves: double integrators that tilt to accelerate. Sans-I/O, one fixed inner step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_bridge.world import quaternions
from sim_bridge.world.guidance import Path, Waypoints, command, lqr_gain
from sim_bridge.world.quaternions import Array

STEP_RATE_HZ = 200
"""Inner steps per second; an IMU sample is the mean over one step, as PX4 sends it."""
TOUCHDOWN_M = 0.05
TOUCHDOWN_MPS = 0.3


@dataclass(frozen=True, slots=True)
class Dynamics:
    """How the vehicles answer to commands.

    ``gravity_mps2`` points down. The acceleration follows its command with the lag ``accel_lag_s`` (zero: at
    once), which is what a real attitude loop does. Guidance runs every ``guidance_steps`` inner steps and its
    gain is designed for that period.
    """

    gravity_mps2: float = 9.80665
    max_accel_mps2: float = 2.0
    accel_lag_s: float = 0.1
    guidance_steps: int = 4


class FleetWorld:
    """True state of n vehicles in the fleet's NED frame.

    ``position_m``, ``velocity_mps``, ``accel_mps2`` are ``(n, 3)``; the acceleration is the one that acted
    over the last step. ``time_s`` counts from the start, a whole number of steps.
    """

    def __init__(
        self,
        position_m: Array,
        velocity_mps: Array,
        paths: Sequence[Path],
        *,
        dynamics: Dynamics | None = None,
        yaw_rad: Array | None = None,
        yaw_rate_radps: float = 0.0,
        on_ground: Array | None = None,
    ) -> None:
        """Start at ``position_m`` and ``velocity_mps`` ``(n, 3)``; vehicles on the ground start at rest.

        All turn about the vertical at ``yaw_rate_radps``.
        """
        count = len(paths)
        if position_m.shape != (count, 3) or velocity_mps.shape != (count, 3):
            raise ValueError(
                f"world: {count} paths need positions and velocities of shape ({count}, 3), "
                f"found {position_m.shape} and {velocity_mps.shape}"
            )
        self.dynamics = dynamics or Dynamics()
        self.position_m = np.array(position_m, float)
        self.velocity_mps = np.array(velocity_mps, float)
        self.off_m: Array = np.zeros((count, 3))
        """How far from where they are their guidance has the vehicles."""
        self.off_mps: Array = np.zeros((count, 3))
        self.accel_mps2: Array = np.zeros((count, 3))
        self.yaw_rad = np.zeros(count) if yaw_rad is None else np.array(yaw_rad, float)
        self._yaw_step_rad = yaw_rate_radps / STEP_RATE_HZ
        self.landed = np.zeros(count, bool) if on_ground is None else np.array(on_ground, bool)
        self.velocity_mps[self.landed] = 0.0
        self.step_index = 0
        self.step_s = 1.0 / STEP_RATE_HZ
        self._paths = list(paths)
        self._begun_s = [0.0] * count
        self._landing_d_m: dict[int, float] = {}
        self._gain = lqr_gain(self.dynamics.guidance_steps * self.step_s)
        lag_s = self.dynamics.accel_lag_s
        self._follow = 1.0 if lag_s == 0.0 else -math.expm1(-self.step_s / lag_s)
        self._command_mps2: Array = np.zeros((count, 3))
        self._accel_before_mps2 = self.accel_mps2
        self._attitudes = self._both_attitudes()
        self._attitudes_step = 0

    @property
    def time_s(self) -> float:
        """Time since the start."""
        return self.step_index / STEP_RATE_HZ

    def step(self) -> None:
        """Move on by one inner step; the acceleration is constant over it."""
        self._accel_before_mps2 = self.accel_mps2
        if self.step_index % self.dynamics.guidance_steps == 0:
            self._guide()
        self.accel_mps2 = self.accel_mps2 + self._follow * (self._command_mps2 - self.accel_mps2)
        if self.landed.any():
            self.accel_mps2[self.landed] = 0.0
        self.position_m += self.velocity_mps * self.step_s + 0.5 * self.accel_mps2 * self.step_s**2
        self.velocity_mps += self.accel_mps2 * self.step_s
        self.yaw_rad += self._yaw_step_rad
        self.step_index += 1

    def _guide(self) -> None:
        if self._landing_d_m:
            self._touch_down()
        references = [
            path.reference(self.time_s - begun_s) for path, begun_s in zip(self._paths, self._begun_s, strict=True)
        ]
        self._command_mps2 = command(
            self._gain,
            references,
            self.position_m + self.off_m,
            self.velocity_mps + self.off_mps,
            self.dynamics.max_accel_mps2,
        )

    def _touch_down(self) -> None:
        for slot, ground_d_m in list(self._landing_d_m.items()):
            slow = float(np.linalg.norm(self.velocity_mps[slot])) < TOUCHDOWN_MPS
            if slow and self.position_m[slot, 2] > ground_d_m - TOUCHDOWN_M:
                self.landed[slot] = True
                self.velocity_mps[slot] = 0.0
                del self._landing_d_m[slot]

    def fly(self, slot: int, path: Path) -> None:
        """Begin a path now; a vehicle on the ground takes off for it."""
        self._landing_d_m.pop(slot, None)
        self._paths[slot] = path
        self._begun_s[slot] = self.time_s
        self.landed[slot] = False

    def land(self, slot: int, ground_d_m: float) -> None:
        """Descend where the vehicle is; it stays at rest once it is down."""
        north, east, _ = (float(axis) for axis in self.position_m[slot])
        self.fly(slot, Waypoints(((north, east, ground_d_m),)))
        self._landing_d_m[slot] = ground_d_m

    def specific_force_ned(self) -> Array:
        """What ideal accelerometers feel, ``(n, 3)`` NED m/s^2: acceleration minus gravity."""
        return np.asarray(self.accel_mps2 - np.array((0.0, 0.0, self.dynamics.gravity_mps2)))

    def _both_attitudes(self) -> Array:
        """Attitudes before and after the last step, ``(2, n, 4)``, computed when somebody looks."""
        both = np.concatenate((self._accel_before_mps2, self.accel_mps2))
        force = both - np.array((0.0, 0.0, self.dynamics.gravity_mps2))
        yaw = np.concatenate((self.yaw_rad - self._yaw_step_rad, self.yaw_rad))
        return quaternions.from_thrust(force, yaw).reshape(2, -1, 4)

    def _update_attitudes(self) -> None:
        if self._attitudes_step != self.step_index:
            self._attitudes = self._both_attitudes()
            self._attitudes_step = self.step_index

    def attitude(self) -> Array:
        """Quaternions ``(n, 4)`` w x y z, body FRD into NED."""
        self._update_attitudes()
        return np.asarray(self._attitudes[1])

    def body_rates(self) -> Array:
        """Mean angular velocity over the last step, ``(n, 3)`` body rad/s."""
        self._update_attitudes()
        before, after = self._attitudes
        turn = quaternions.multiply(quaternions.conjugate(before), after)
        return np.asarray(quaternions.to_rotation_vector(turn) / self.step_s)
