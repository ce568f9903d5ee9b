"""MAVLink messages to samples: units, scaling, invalid markers and what differs between autopilots.

Only raw sensors and the attitude become measurements. Positions of the autopilot's own filter never do:
once our estimate is fed back to it, they would be our own words.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

from agent.config.tables import SensorsTable
from agent.mavlink.codec import Message, mavlink
from agent.sensing.frames import FleetFrame, from_euler, normalised
from agent.sensing.latency import Stamp, gps_prior, imu_latency_s
from agent.sensing.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample, Sample, Triple

MILLI_G_MPS2 = 9.80665e-3
UNKNOWN_16 = 65535
PREFERENCE_HOLD_S = 1.0
"""A second-best message serves once the better one has been silent for this long."""
MAX_STAMP_AGE_S = 5.0
MAX_STAMP_LEAD_S = 0.2
UNIX_US = 10**15
"""A ``time_usec`` above this is Unix time (after 2001), below it time since boot."""
GPS_SIGMA_FLOOR_M = 0.02
"""Least 1-sigma of a fix, whatever the receiver claims: RTK is no better than its antenna's phase centre."""
GPS_SPEED_SIGMA_MPS = 0.3
"""Where the receiver does not report a speed accuracy."""
GPS_RANGE_ERROR_M = 2.5
"""1-sigma of a pseudorange (UERE), single frequency: sigma = dilution times this where the receiver reports none."""
_ACCEL_AND_GYRO = 0b111111
MAX_FORCE_MPS2, MAX_TURN_RADPS = 1000.0, 100.0
"""Per axis; beyond what any IMU of a drone can measure (100 g, 5700 deg/s), so no measurement."""

StampS = Callable[[float, float], float | None]
"""(boot time, arrival) to fleet time in s; ``None`` if it cannot be told."""


class SampleAdapter:
    """The samples of one autopilot.

    ``skipped`` counts messages that gave none, by reason. Fleet times come from ``fleet_time_of_boot``;
    ``epoch_unix_s`` makes fleet time of the stamps that are Unix time.
    """

    def __init__(
        self, frame: FleetFrame, sensors: SensorsTable, epoch_unix_s: float, fleet_time_of_boot: StampS
    ) -> None:
        self._frame = frame
        self._sensors = sensors
        self._epoch_unix_s = epoch_unix_s
        self._fleet_time_of_boot = fleet_time_of_boot
        self._last_preferred_s: dict[str, float] = {}
        self._last_fix: tuple[int, int, int, int] | None = None
        self.flavour = "other"
        """``ardupilot``, ``px4`` or ``other``, set by the owner once the autopilot is known: only ArduPilot scales
        RAW_IMU, and the sensors of each are late in their own way."""
        self.fix_type = 0
        """The receiver's last word on its fix."""
        self.skipped: Counter[str] = Counter()

    def reset(self) -> None:
        """Forget the streams seen, as after a reboot."""
        self._last_preferred_s.clear()
        self._last_fix = None
        self.fix_type = 0

    def convert(self, message: Message, arrival_s: float) -> Sample | None:
        """The sample of a message that arrived at fleet time ``arrival_s``; ``None`` if it gives none."""
        converter = _CONVERTERS.get(message.get_msgId())
        return None if converter is None else converter(self, message, arrival_s)

    # --- IMU and attitude ----------------------------------------------------------------------------------

    def _highres_imu(self, message: Message, arrival_s: float) -> Sample | None:
        if message.id:
            return self._skip("imu: not the first one")
        if message.fields_updated & _ACCEL_AND_GYRO != _ACCEL_AND_GYRO:
            return self._skip("imu: nothing new")
        self._last_preferred_s["imu"] = arrival_s
        force = (message.xacc, message.yacc, message.zacc)
        turn = (message.xgyro, message.ygyro, message.zgyro)
        return self._imu(message.time_usec, force, turn, arrival_s)

    def _raw_imu(self, message: Message, arrival_s: float) -> Sample | None:
        if self.flavour != "ardupilot":
            return self._skip("imu: RAW_IMU unscaled")
        if not self._is_second_choice_due("imu", arrival_s) or message.id:
            return None
        force = (
            message.xacc * MILLI_G_MPS2,
            message.yacc * MILLI_G_MPS2,
            message.zacc * MILLI_G_MPS2,
        )
        turn = (message.xgyro * 1e-3, message.ygyro * 1e-3, message.zgyro * 1e-3)
        return self._imu(message.time_usec, force, turn, arrival_s)

    def _imu(self, time_usec: int, force: Triple, turn: Triple, arrival_s: float) -> Sample | None:
        if not _finite(*force, *turn):
            return self._skip("imu: not finite")
        if max(map(abs, force)) > MAX_FORCE_MPS2 or max(map(abs, turn)) > MAX_TURN_RADPS:
            return self._skip("imu: out of range")
        t_s = self._stamp(time_usec, arrival_s, "imu")
        return None if t_s is None else ImuSample(t_s - imu_latency_s(self.flavour, self._sensors), force, turn)

    def _attitude_quaternion(self, message: Message, arrival_s: float) -> Sample | None:
        # repr_offset_q only serves displays of tailsitters; the attitude is q alone.
        quaternion = normalised((message.q1, message.q2, message.q3, message.q4))
        if quaternion is None:
            return self._skip("attitude: no unit quaternion")
        self._last_preferred_s["attitude"] = arrival_s
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "attitude")
        return None if t_s is None else AttitudeSample(t_s, quaternion)

    def _attitude(self, message: Message, arrival_s: float) -> Sample | None:
        if not self._is_second_choice_due("attitude", arrival_s):
            return None
        if not _finite(message.roll, message.pitch, message.yaw):
            return self._skip("attitude: not finite")
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "attitude")
        quaternion = from_euler(message.roll, message.pitch, message.yaw)
        return None if t_s is None else AttitudeSample(t_s, quaternion)

    # --- GPS -----------------------------------------------------------------------------------------------

    def _gps_raw_int(self, message: Message, arrival_s: float) -> Sample | None:
        self.fix_type = message.fix_type
        if not self._sensors.gps_min_fix <= message.fix_type <= mavlink.GPS_FIX_TYPE_PPP:
            return self._skip("gps: no fix")
        fix = (message.time_usec, message.lat, message.lon, message.alt)
        if message.time_usec and fix == self._last_fix:
            return self._skip("gps: sent again")
        self._last_fix = fix
        if not (abs(message.lat) <= 900_000_000 and abs(message.lon) <= 1_800_000_000) or (
            message.lat == 0 and message.lon == 0
        ):
            return self._skip("gps: no position")
        height = self._frame.height(message.alt * 1e-3, message.alt_ellipsoid * 1e-3 or None)
        if height is None:
            return self._skip("gps: no height of the fleet's sort")
        horizontal = self._accuracy_m(message.h_acc, message.eph)
        vertical = self._accuracy_m(message.v_acc, message.epv)
        if horizontal is None:
            return self._skip("gps: no accuracy")
        # PX4 sends time 0 while its receiver does not know UTC: then arrival is all there is.
        t_s = self._stamp(message.time_usec, arrival_s, "gps") if message.time_usec else arrival_s
        if t_s is None:
            return None
        ground, norm = self._speeds(message)
        return GpsSample(
            t_s=t_s,
            position_m=self._frame.ned(message.lat * 1e-7, message.lon * 1e-7, height),
            horizontal_sigma_m=horizontal,
            vertical_sigma_m=1.5 * horizontal if vertical is None else vertical,
            ground_velocity_mps=ground,
            speed_mps=norm,
            speed_sigma_mps=message.vel_acc * 1e-3 or GPS_SPEED_SIGMA_MPS,
            fix_type=message.fix_type,
            latency=gps_prior(self.flavour, _stamp_kind(message.time_usec), self._sensors),
        )

    def _accuracy_m(self, accuracy_mm: int, dilution_centi: int) -> float | None:
        """1-sigma in m: the receiver's own, else from the dilution of precision (which is not metres).

        0 is "unknown": MAVLink 1 and truncated frames carry it.
        """
        if accuracy_mm:
            return max(accuracy_mm * 1e-3, GPS_SIGMA_FLOOR_M)
        if dilution_centi in (0, UNKNOWN_16):
            return None
        return max(max(dilution_centi * 1e-2, 0.5) * GPS_RANGE_ERROR_M, GPS_SIGMA_FLOOR_M)

    def _speeds(self, message: Message) -> tuple[tuple[float, float] | None, float | None]:
        """Ground velocity or norm of the velocity, whichever ``vel`` is configured to be."""
        kind = self._sensors.gps_speed
        if kind == "off" or message.vel == UNKNOWN_16:
            return None, None
        speed = message.vel * 1e-2
        if kind == "norm":
            return None, speed
        if message.cog == UNKNOWN_16:
            return None, None
        course = math.radians(message.cog * 1e-2)
        return (speed * math.cos(course), speed * math.sin(course)), None

    # --- for comparison ------------------------------------------------------------------------------------

    def _local_position_ned(self, message: Message, arrival_s: float) -> Sample | None:
        position = (message.x, message.y, message.z)
        velocity = (message.vx, message.vy, message.vz)
        if not _finite(*position, *velocity):
            return self._skip("local position: not finite")
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "local position")
        return None if t_s is None else AutopilotEstimate(t_s, position, velocity)

    # --- common --------------------------------------------------------------------------------------------

    def _is_second_choice_due(self, kind: str, arrival_s: float) -> bool:
        return arrival_s - self._last_preferred_s.get(kind, -math.inf) > PREFERENCE_HOLD_S

    def _stamp(self, time_usec: int, arrival_s: float, kind: str) -> float | None:
        """Fleet time of a stamp; ``None``, and counted, if it is unknown or cannot be true."""
        if time_usec > UNIX_US:
            t_s: float | None = time_usec * 1e-6 - self._epoch_unix_s
        else:
            t_s = self._fleet_time_of_boot(time_usec * 1e-6, arrival_s)
        if t_s is None:
            self.skipped[f"{kind}: clock unknown"] += 1
            return None
        if not -MAX_STAMP_LEAD_S <= arrival_s - t_s <= MAX_STAMP_AGE_S:
            self.skipped[f"{kind}: wrong time"] += 1
            return None
        return t_s

    def _skip(self, reason: str) -> Sample | None:
        self.skipped[reason] += 1
        return None


def _stamp_kind(time_usec: int) -> Stamp:
    if not time_usec:
        return "arrival"
    return "utc" if time_usec > UNIX_US else "boot"


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


_CONVERTERS: dict[int, Callable[[SampleAdapter, Message, float], Sample | None]] = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: SampleAdapter._highres_imu,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: SampleAdapter._raw_imu,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: SampleAdapter._attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: SampleAdapter._attitude,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: SampleAdapter._gps_raw_int,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: SampleAdapter._local_position_ned,
}
