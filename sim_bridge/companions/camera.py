"""A companion computer with a camera: it tells the vehicle's velocity on the autopilot's link (ODOMETRY).

As visual odometry does: in the body's axes, with a scale and a heading that are a little wrong for good, and stamped
by a clock of its own. Sans-I/O.
"""

from __future__ import annotations

import math

import numpy as np

from agent.mavlink.codec import Encoder
from agent.mavlink.dialect import mavlink
from sim_bridge.world import quaternions
from sim_bridge.world.quaternions import Array

COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
SIGMA_MPS = 0.05
"""White noise per axis, which it tells."""
SCALE_SIGMA = 0.01
"""Of its scale, and in rad of its mounting about the vertical; which it does not tell."""
BOOT_S = 4321.0
"""What its clock shows at the start."""
GRID_TOLERANCE = 1e-6
_UNKNOWN = math.nan


class Camera:
    """The camera of one vehicle, ``rate_hz`` times a second."""

    def __init__(self, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz, self._rng = rate_hz, rng
        self._scale = 1.0 + SCALE_SIGMA * float(rng.standard_normal())
        turn = SCALE_SIGMA * float(rng.standard_normal())
        cosine, sine = math.cos(turn), math.sin(turn)
        self._mounting = np.array(((cosine, -sine, 0.0), (sine, cosine, 0.0), (0.0, 0.0, 1.0)))
        self._taken = 0

    def velocity(self, time_s: float, velocity_ned: Array, attitude: Array) -> Array | None:
        """Velocity ``(3,)`` m/s body FRD at a time since the start, if one is due; ``attitude`` w x y z into NED."""
        count = int(time_s * self._rate_hz + GRID_TOLERANCE)
        if count <= self._taken:
            return None
        self._taken = count
        true = quaternions.rotate(quaternions.conjugate(attitude[None]), velocity_ned[None])[0]
        return np.asarray(self._scale * self._mounting @ true + SIGMA_MPS * self._rng.standard_normal(3))


class Companion:
    """Puts what a camera says into frames."""

    def __init__(self, system_id: int, camera: Camera) -> None:
        self.camera = camera
        self._encoder = Encoder(system_id, COMPONENT)

    def frame(self, time_s: float, velocity_ned: Array, attitude: Array) -> bytes | None:
        """An ODOMETRY frame, if one is due; arguments as of `Camera.velocity`."""
        velocity = self.camera.velocity(time_s, velocity_ned, attitude)
        if velocity is None:
            return None
        vx, vy, vz = velocity.tolist()
        covariance = [_UNKNOWN] * 21
        for at in (0, 6, 11):
            covariance[at] = SIGMA_MPS**2
        message = mavlink.MAVLink_odometry_message(
            round(1e6 * (BOOT_S + time_s)),
            mavlink.MAV_FRAME_LOCAL_FRD,
            mavlink.MAV_FRAME_BODY_FRD,
            _UNKNOWN, _UNKNOWN, _UNKNOWN, [_UNKNOWN] * 4,
            vx, vy, vz, _UNKNOWN, _UNKNOWN, _UNKNOWN,
            [_UNKNOWN] * 21, covariance,
            estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VIO,
            quality=100,
        )  # fmt: skip
        return self._encoder.encode(message)
