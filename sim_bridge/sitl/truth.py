"""Ground truth out of what a simulated autopilot says of its simulator.

ArduPilot: SIM_STATE, whose integer latitude and longitude are exact; firmware that has none of them there has them in
SIMSTATE, which in turn has no height. PX4: HIL_STATE_QUATERNION. None of these messages has a usable stamp, so each
gets one from its neighbours in the stream: frames keep their order, so that it was sent between the boot times of the
stamped messages before and after it, and in between in proportion to the arrivals. A burst after a stall of the host
is thereby spread over the time that it is of, where arrivals alone would be wrong by the whole stall. Sans-I/O.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

from agent.mavlink.codec import Message, mavlink
from agent.sensing.frames import FleetFrame, normalised
from agent.sensing.samples import Triple
from sim_bridge.world import geodesy

TRUTH_HZ = 50.0
"""Rate at which the simulators' truth is asked for and recorded: 0.2 m of flight at 10 m/s apart."""
MAX_WAITING = 64
"""Truths that no stamped message follows; older ones are given up."""
STAMPED_IN_US = {mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, mavlink.MAVLINK_MSG_ID_RAW_IMU}
"""Their ``time_usec`` is the boot time, as ``time_boot_ms`` is wherever it occurs."""
MAX_HEIGHT_AGE_S = 0.2
"""SIMSTATE takes its height and velocity from a SIM_STATE no older than this."""
TRUTH_MESSAGES = {
    "ardupilot": mavlink.MAVLINK_MSG_ID_SIM_STATE,
    "px4": mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
}
"""What each autopilot can be asked for; it refuses the other's."""


@dataclass(frozen=True, slots=True)
class TrueSample:
    """Where a simulated vehicle was: boot time of its autopilot, NED m and m/s in the fleet frame, heading."""

    boot_s: float
    position_m: Triple
    velocity_mps: Triple
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class _Unstamped:
    """A truth that waits for its time."""

    arrived_s: float
    position_m: Triple
    velocity_mps: Triple
    yaw_rad: float

    def stamped(self, before: tuple[float, float], after: tuple[float, float]) -> TrueSample:
        """Between two stamped messages, each (boot time, arrival)."""
        span_s = after[1] - before[1]
        share = (self.arrived_s - before[1]) / span_s if span_s > 0.0 else 0.5
        boot_s = before[0] + share * (after[0] - before[0])
        return TrueSample(boot_s, self.position_m, self.velocity_mps, self.yaw_rad)


def boot_time_s(message: Message) -> float | None:
    """The boot time that a message of an autopilot says; ``None`` if it says none."""
    if message.get_msgId() in STAMPED_IN_US:
        return 1e-6 * float(message.time_usec)
    boot_ms = getattr(message, "time_boot_ms", None)
    return None if boot_ms is None else 1e-3 * float(boot_ms)


class TruthTap:
    """Reads the truth of one vehicle; ``ignored`` counts truth messages that gave none, by reason."""

    def __init__(self, frame: FleetFrame) -> None:
        self._frame = frame
        self._stamped: tuple[float, float] | None = None
        self._waiting: deque[_Unstamped] = deque()
        self._height: tuple[float, float, Triple] | None = None
        self.needs_simstate = False
        """This firmware's SIM_STATE lacks the exact position: ask for SIMSTATE too."""
        self.ignored: Counter[str] = Counter()

    def reset(self) -> None:
        """Forget the boot clock, as after a reboot."""
        self._stamped = None
        self._waiting.clear()
        self._height = None

    def on_stamped(self, boot_s: float, now_s: float) -> list[TrueSample]:
        """A message with a boot time arrived at ``now_s``: the truths that came before it, in order.

        One stamped earlier than another before it says nothing new.
        """
        before = self._stamped
        if before is not None and boot_s < before[0]:
            return []
        self._stamped = (boot_s, now_s)
        waiting, self._waiting = self._waiting, deque()
        if before is None:
            self.ignored.update("boot time unknown" for _ in waiting)
            return []
        return [truth.stamped(before, self._stamped) for truth in waiting]

    def on_message(self, message: Message, now_s: float) -> None:
        """A message of the autopilot arrived; a truth in it waits for the next stamped message."""
        match message.get_msgId():
            case mavlink.MAVLINK_MSG_ID_SIM_STATE:
                self._sim_state(message, now_s)
            case mavlink.MAVLINK_MSG_ID_SIMSTATE:
                self._simstate(message, now_s)
            case mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION:
                self._hil_state(message, now_s)

    def _sim_state(self, message: Message, now_s: float) -> None:
        velocity = (message.vn, message.ve, message.vd)
        if message.lat_int == 0 and message.lon_int == 0:
            self.needs_simstate = True
            self._height = (now_s, message.alt, velocity)
            return
        self._take((message.lat_int, message.lon_int), message.alt, velocity, message.yaw, now_s)

    def _simstate(self, message: Message, now_s: float) -> None:
        if not self.needs_simstate:
            return  # SIM_STATE says it all
        if self._height is None or now_s - self._height[0] > MAX_HEIGHT_AGE_S:
            self.ignored["SIMSTATE without height"] += 1
            return
        _, alt_m, velocity = self._height
        self._take((message.lat, message.lng), alt_m, velocity, message.yaw, now_s)

    def _hil_state(self, message: Message, now_s: float) -> None:
        w, x, y, z = message.attitude_quaternion
        quaternion = normalised((w, x, y, z))
        if quaternion is None:
            self.ignored["no unit quaternion"] += 1
            return
        w, x, y, z = quaternion
        yaw_rad = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        velocity = (1e-2 * message.vx, 1e-2 * message.vy, 1e-2 * message.vz)
        self._take((message.lat, message.lon), 1e-3 * message.alt, velocity, yaw_rad, now_s)

    def _take(self, place: tuple[int, int], alt_msl_m: float, velocity: Triple, yaw_rad: float, now_s: float) -> None:
        lat_deg, lon_deg = 1e-7 * place[0], 1e-7 * place[1]
        if not all(map(math.isfinite, (alt_msl_m, *velocity, yaw_rad))):
            self.ignored["not finite"] += 1
        elif abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0 or place == (0, 0):
            self.ignored["no position"] += 1
        else:
            position_m = self._frame.ned(lat_deg, lon_deg, geodesy.from_msl_m(self._frame, alt_msl_m))
            self._waiting.append(_Unstamped(now_s, position_m, velocity, yaw_rad))
            if len(self._waiting) > MAX_WAITING:
                self._waiting.popleft()
                self.ignored["no stamped message after it"] += 1
