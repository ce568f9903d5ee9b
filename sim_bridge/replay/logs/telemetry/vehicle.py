"""The samples of one vehicle of a telemetry log.

Sensors are converted by the daemon's own `SampleAdapter`, so that a replay sees what the flight would have.
What only a log is asked for is added here: the simulator's truth, and the autopilot's estimate in the fleet's
frame.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

from agent.config.tables import SensorsTable
from agent.mavlink.boot_times import WRAP_MS_S
from agent.mavlink.codec import Message, mavlink
from agent.mavlink.components import SENSORS
from agent.mavlink.sample_adapter import SampleAdapter
from agent.mavlink.velocities import VelocityAdapter
from agent.sensing.frames import FleetFrame, from_euler, normalised
from agent.sensing.samples import (
    AutopilotEstimate,
    BaroSample,
    FlowSample,
    Quaternion,
    RangeSample,
    Triple,
    VelocitySample,
)
from sim_bridge.replay.logs.boot_clock import LogBootClock
from sim_bridge.replay.logs.events import GeodeticPoint, LogSample, SystemSurvey, TruthSample

TRUTHS = ("SIM_STATE", "HIL_STATE_QUATERNION", "SIMSTATE")
"""Messages that hold the simulator's truth, the best one first."""
ESTIMATES = ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")
"""Messages that hold the autopilot's estimate: about its own origin, and geodetic."""
FRESH_BOOT_S = 0.02
"""Truth bears no time: it is of the instant of the message before it, if that came this shortly before."""


class LoggedVehicle:
    """Messages of one autopilot, in order of arrival, to samples on log time; ``wanted`` are the ids of those."""

    def __init__(
        self, frame: FleetFrame, sensors: SensorsTable, epoch_unix_s: float, clock: LogBootClock, found: SystemSurvey
    ) -> None:
        self._frame = frame
        self._clock = clock
        self._adapter = SampleAdapter(frame, sensors, epoch_unix_s, clock.log_s, found.receivers)
        self._adapter.flavour = found.flavour
        self._velocities = VelocityAdapter(epoch_unix_s, clock.log_s)
        self._session = -1
        self._boot: tuple[float, float, float] | None = None
        self._origin_m = None if found.origin is None else self._ned(found.origin)
        self._skipped: Counter[str] = Counter()
        sensors_and_own = frozenset(SENSORS)
        self._converters: dict[int, Callable[[Message, float], LogSample | None]] = {
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._gps_global_origin
        }
        if self._origin_m is None and found.messages.get("GLOBAL_POSITION_INT"):
            self._converters[mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT] = self._global_position_int
        else:
            sensors_and_own |= {mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED}
        if found.truth_from is not None:
            message_id, converter = {
                "SIM_STATE": (mavlink.MAVLINK_MSG_ID_SIM_STATE, self._sim_state),
                "HIL_STATE_QUATERNION": (mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, self._hil_state),
                "SIMSTATE": (mavlink.MAVLINK_MSG_ID_SIMSTATE, self._simstate),
            }[found.truth_from]
            self._converters[message_id] = converter
        self.wanted = sensors_and_own | self._converters.keys()

    @property
    def skipped(self) -> Counter[str]:
        """Messages that gave no sample, by reason."""
        return self._adapter.skipped + self._velocities.skipped + self._skipped

    @property
    def noted(self) -> Counter[str]:
        """What was dealt with in messages that gave one."""
        return self._adapter.noted

    def on_boot_time(self, boot_s: float, arrival_s: float, wrap_s: float) -> None:
        """Note the boot time that a message shows, before its `samples` are asked for; it wraps after ``wrap_s``."""
        self._boot = (boot_s, arrival_s, wrap_s)
        session = self._clock.session(arrival_s)
        if session != self._session:
            if self._session >= 0:
                self._adapter.reset()
                self._velocities.reset()
            self._session = session

    def samples(self, message_id: int, message: Message, arrival_s: float) -> list[LogSample]:
        """The samples of one of the `wanted` messages."""
        beside = self._adapter.pressure_beside(message, arrival_s)
        assert beside is None or isinstance(beside, BaroSample)
        both = self._sample(message_id, message, arrival_s), beside
        return [sample for sample in both if sample is not None]

    def velocity(
        self, message: Message, arrival_s: float, component: int, *, of_autopilot: bool
    ) -> VelocitySample | FlowSample | None:
        """What a component of the vehicle says of a velocity."""
        return self._velocities.convert(message, arrival_s, component, of_autopilot=of_autopilot)

    def _sample(self, message_id: int, message: Message, arrival_s: float) -> LogSample | None:
        converter = self._converters.get(message_id)
        if converter is not None:
            return converter(message, arrival_s)
        sample = self._adapter.convert(message, arrival_s)
        if isinstance(sample, AutopilotEstimate) and self._origin_m is not None:
            return AutopilotEstimate(sample.t_s, _sum(sample.position_m, self._origin_m), sample.velocity_mps)
        assert not isinstance(sample, RangeSample)  # MAVLink carries none
        return sample

    # --- the autopilot's estimate ----------------------------------------------------------------------------

    def _gps_global_origin(self, message: Message, arrival_s: float) -> LogSample | None:
        point = GeodeticPoint(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3)
        origin_m = self._ned(point)
        if origin_m is not None and self._origin_m is not None:
            self._origin_m = origin_m
        return None

    def _global_position_int(self, message: Message, arrival_s: float) -> LogSample | None:
        if not (message.lat or message.lon):
            return self._skip("global position: none")
        position_m = self._ned(GeodeticPoint(message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3))
        t_s = self._clock.unwrapped_s(message.time_boot_ms * 1e-3, arrival_s, WRAP_MS_S)
        if position_m is None or t_s is None:
            return self._skip("global position: no height of the fleet's sort, or clock unknown")
        return AutopilotEstimate(t_s, position_m, (message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2))

    def _ned(self, point: GeodeticPoint) -> Triple | None:
        if not (abs(point.lat_deg) <= 90.0 and abs(point.lon_deg) <= 180.0 and math.isfinite(point.alt_msl_m)):
            return None
        height_m = self._frame.height(point.alt_msl_m, None)
        return None if height_m is None else self._frame.ned(point.lat_deg, point.lon_deg, height_m)

    # --- truth -----------------------------------------------------------------------------------------------

    def _sim_state(self, message: Message, arrival_s: float) -> LogSample | None:
        if message.lat_int or message.lon_int:
            lat_deg, lon_deg = message.lat_int * 1e-7, message.lon_int * 1e-7
        else:  # before the integers came: degrees, or 1e7 times that, as floats
            scale = 1e-7 if abs(message.lat) > 90.0 or abs(message.lon) > 180.0 else 1.0
            lat_deg, lon_deg = message.lat * scale, message.lon * scale
        quaternion = normalised((message.q1, message.q2, message.q3, message.q4))
        velocity = (message.vn, message.ve, message.vd)
        return self._truth(arrival_s, GeodeticPoint(lat_deg, lon_deg, message.alt), velocity, quaternion)

    def _hil_state(self, message: Message, arrival_s: float) -> LogSample | None:
        w, x, y, z = message.attitude_quaternion
        point = GeodeticPoint(message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
        velocity = (message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2)
        return self._truth(arrival_s, point, velocity, normalised((w, x, y, z)))

    def _simstate(self, message: Message, arrival_s: float) -> LogSample | None:
        angles = (message.roll, message.pitch, message.yaw)
        quaternion = from_euler(*angles) if all(map(math.isfinite, angles)) else None
        point = GeodeticPoint(message.lat * 1e-7, message.lng * 1e-7, self._frame.alt_m)
        t_s = self._truth_time(arrival_s)
        if not (abs(point.lat_deg) <= 90.0 and abs(point.lon_deg) <= 180.0):
            return self._skip("truth: not finite or no place")
        north_m, east_m, _ = self._frame.ned(point.lat_deg, point.lon_deg, point.alt_msl_m)
        return TruthSample(t_s, (north_m, east_m, 0.0), None, quaternion, has_height=False)

    def _truth(
        self, arrival_s: float, point: GeodeticPoint, velocity: Triple, quaternion: Quaternion | None
    ) -> LogSample | None:
        position_m = self._ned(point)
        if position_m is None or not all(map(math.isfinite, velocity)):
            return self._skip("truth: not finite or no place")
        return TruthSample(self._truth_time(arrival_s), position_m, velocity, quaternion)

    def _truth_time(self, arrival_s: float) -> float:
        """Simulators send truth in one burst with stamped messages of the same instant."""
        if self._boot is not None and arrival_s - self._boot[1] <= FRESH_BOOT_S:
            t_s = self._clock.unwrapped_s(self._boot[0], arrival_s, self._boot[2])
            if t_s is not None:
                return t_s
        return arrival_s

    def _skip(self, reason: str) -> LogSample | None:
        self._skipped[reason] += 1
        return None


def _sum(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
