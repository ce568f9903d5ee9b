"""Which outside positions an autopilot takes, as strictly as the real ones.

PX4: ODOMETRY in four local frames from a vision estimator, VISION_POSITION_ESTIMATE; it wants less than
0.2 s between samples to start and stops after 0.4 s. ArduPilot: ODOMETRY only as LOCAL_FRD/BODY_FRD (anything
else is dropped without a word) and VISION_POSITION_ESTIMATE, healthy for 0.3 s. VISION_SPEED_ESTIMATE is not
simulated: it is counted as not handled, as PX4 does. GLOBAL_POSITION_SENSOR and GPS_INPUT: `global_feed`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agent.mavlink.dialect import mavlink
from agent.sensing.frames import normalised, rotated
from sim_bridge.autopilot.flavours import Flavour
from sim_bridge.world.quaternions import Array

PX4_START_GAP_S, PX4_STOP_GAP_S = 0.2, 0.4
ARDUPILOT_HEALTHY_S = 0.3
MAX_DISTANCE_M, MAX_SPEED_MPS = 1e5, 1e3
HANDLED = frozenset({"ODOMETRY", "VISION_POSITION_ESTIMATE"})
PX4_LOCAL_FRAMES = frozenset(
    {
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_LOCAL_ENU,
        mavlink.MAV_FRAME_LOCAL_FRD,
        mavlink.MAV_FRAME_LOCAL_FLU,
    }
)
PX4_BODY_FRAMES = frozenset({mavlink.MAV_FRAME_BODY_NED, 9, mavlink.MAV_FRAME_BODY_FRD})
PX4_VISION_ESTIMATORS = frozenset(
    {
        mavlink.MAV_ESTIMATOR_TYPE_UNKNOWN,
        mavlink.MAV_ESTIMATOR_TYPE_NAIVE,
        mavlink.MAV_ESTIMATOR_TYPE_VISION,
        mavlink.MAV_ESTIMATOR_TYPE_VIO,
    }
)


@dataclass(frozen=True, slots=True)
class Fed:
    """An accepted outside state relative to the autopilot's origin, NED; velocity ``None`` if not given."""

    position_m: Array
    velocity_mps: Array | None
    position_sigma_m: Array = field(default_factory=lambda: np.full(3, 0.3))
    """Per axis, as this autopilot reads the covariance."""
    velocity_sigma_mps: Array = field(default_factory=lambda: np.full(3, 0.1))


class Refused(Exception):
    """A message that the autopilot does not use; ``announced`` if it says so in a STATUSTEXT."""

    def __init__(self, reason: str, announced: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.announced = announced


class ExternalFeed:
    """Judges the messages of an outside position and keeps count of them."""

    def __init__(self, flavour: Flavour, parameter: Callable[[str], float]) -> None:
        """``parameter`` reads one of the autopilot's parameters by name."""
        self._flavour = flavour
        self._parameter = parameter
        self.accepted = 0
        self.rejected: Counter[str] = Counter()
        self.reset_counter: int | None = None
        self.source_set = 1
        self.spoofed = False
        """Whether it was told that its own receiver is lied to."""
        self._last_s = -math.inf
        self._fusing = False

    def accept(self, message: Any, attitude: Array, now: float) -> Fed | None:
        """The state in an ODOMETRY or VISION_POSITION_ESTIMATE; ``None`` if the autopilot drops it silently.

        ``attitude`` ``(4,)`` turns body velocities on PX4; ArduPilot uses the message's own. Raises `Refused`
        where the autopilot speaks up.
        """
        try:
            if message.get_type() not in HANDLED:
                raise Refused(f"{message.get_type()} not handled")
            px4 = self._flavour.name == "px4"
            fed = self._px4(message, attitude) if px4 else self._ardupilot(message)
            if not np.isfinite(fed.position_m).all():
                raise Refused("no position")
            if np.abs(fed.position_m).max() > MAX_DISTANCE_M:
                raise Refused("too far")  # the real ones' innovation gates
            if fed.velocity_mps is not None and np.abs(fed.velocity_mps).max() > MAX_SPEED_MPS:
                raise Refused("too fast")
        except Refused as refused:
            self.rejected[refused.reason] += 1
            if refused.announced:
                raise
            return None
        self._fusing = now - self._last_s < (PX4_STOP_GAP_S if self._fusing else PX4_START_GAP_S)
        self._last_s = now
        self.accepted += 1
        self.reset_counter = int(message.reset_counter)
        return fed

    def uses_gps(self) -> bool:
        """Whether navigation uses its own receiver: PX4 by EKF2_GPS_CTRL, ArduPilot by its source set."""
        if self._flavour.name == "px4":
            return bool(int(self._parameter("EKF2_GPS_CTRL")) & 1)
        return not self.spoofed and self._parameter(f"EK3_SRC{min(self.source_set, 2)}_POSXY") == 3

    def uses_height(self) -> bool:
        """Whether navigation takes the feed's height: PX4 by EKF2_EV_CTRL, ArduPilot by its source set."""
        if self._flavour.name == "px4":
            return bool(int(self._parameter("EKF2_EV_CTRL")) & 2)
        return self._parameter("EK3_SRC2_POSZ") == 6

    def healthy(self, now: float) -> bool:
        """Whether samples came lately enough for the autopilot."""
        if self._flavour.name == "px4":
            return self._fusing and now - self._last_s <= PX4_STOP_GAP_S
        return now - self._last_s <= ARDUPILOT_HEALTHY_S

    def fused(self, now: float) -> bool:
        """Whether navigation uses the feed: PX4 by EKF2_EV_CTRL, ArduPilot by its source set."""
        if self._flavour.name == "px4":
            return bool(int(self._parameter("EKF2_EV_CTRL")) & 1) and self.healthy(now)
        source = f"EK3_SRC{self.source_set}_POSXY"
        return self.source_set <= 2 and self._parameter(source) == 6 and self.healthy(now)

    def _px4(self, message: Any, attitude: Array) -> Fed:
        if message.get_type() == "VISION_POSITION_ESTIMATE":
            return Fed(np.array((message.x, message.y, message.z)), None)
        if message.frame_id not in PX4_LOCAL_FRAMES:
            raise Refused(f"frame_id {message.frame_id}")
        if message.child_frame_id not in PX4_LOCAL_FRAMES | PX4_BODY_FRAMES:
            raise Refused(f"child_frame_id {message.child_frame_id}")
        if message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_MOCAP:
            raise Refused("estimator_type 6 (EKF2 ignores motion capture)")
        if message.estimator_type not in PX4_VISION_ESTIMATORS:
            raise Refused(f"estimator_type {message.estimator_type}", announced=True)
        position = _to_ned((message.x, message.y, message.z), message.frame_id)
        if message.child_frame_id in PX4_BODY_FRAMES:
            w, x, y, z = attitude.tolist()
            velocity = np.array(rotated((w, x, y, z), (message.vx, message.vy, message.vz)))
        else:
            velocity = _to_ned((message.vx, message.vy, message.vz), message.child_frame_id)
        known = velocity if np.isfinite(velocity).all() else None
        return Fed(position, known, _sigmas(message.pose_covariance, 0.1), _sigmas(message.velocity_covariance, 0.1))

    def _ardupilot(self, message: Any) -> Fed:
        if self._parameter("VISO_TYPE") == 0:
            raise Refused("VISO_TYPE 0")
        if message.get_type() == "VISION_POSITION_ESTIMATE":
            return Fed(np.array((message.x, message.y, message.z)), None)
        frames = (message.frame_id, message.child_frame_id)
        if frames != (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD):
            raise Refused(f"frames {frames[0]}/{frames[1]}")
        if message.quality < self._parameter("VISO_QUAL_MIN"):
            raise Refused("quality")
        w, x, y, z = message.q
        quaternion = normalised((w, x, y, z))
        if quaternion is None:
            raise Refused("no attitude")
        velocity = np.array(rotated(quaternion, (message.vx, message.vy, message.vz)))
        known = velocity if np.isfinite(velocity).all() else None
        c, least_m = message.pose_covariance, self._parameter("VISO_POS_M_NSE")
        seen_m = least_m if math.isnan(c[0]) else math.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2)
        sigma_m = np.full(3, min(max(seen_m, least_m), 100.0))
        position = np.array((message.x, message.y, message.z))
        return Fed(position, known, sigma_m, np.full(3, self._parameter("VISO_VEL_M_NSE")))


def _sigmas(covariance: Any, least: float) -> Array:
    """Per axis of PX4's parameters and a MAVLink covariance; ``least`` where that says nothing."""
    variances = np.array((covariance[0], covariance[6], covariance[11]))
    return np.asarray(np.sqrt(np.maximum(np.nan_to_num(variances, nan=least**2), least**2)))


def _to_ned(vector: tuple[float, float, float], frame: int) -> Array:
    """Axes of PX4's local frames into NED; FRD and FLU count as turned to north."""
    x, y, z = vector
    if frame == mavlink.MAV_FRAME_LOCAL_ENU:
        return np.array((y, x, -z))
    if frame == mavlink.MAV_FRAME_LOCAL_FLU:
        return np.array((x, -y, -z))
    return np.array((x, y, z))
