"""MAVLink messages to samples: units, scaling, invalid markers and what differs between autopilots.

Only raw sensors and the attitude become measurements. Positions of the autopilot's own filter never do:
once our estimate is fed back to it, they would be our own words.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from agent.config.tables import SensorsTable
from agent.mavlink.boot_times import WRAP_MS_S, WRAP_US_S, turns
from agent.mavlink.codec import Message, mavlink
from agent.mavlink.components import SENSORS
from agent.mavlink.utc_stamps import UtcStamps, unrolled
from agent.sensing.barometer import pressure_altitude_m
from agent.sensing.frames import FleetFrame, from_euler, normalised
from agent.sensing.latency import Stamp, gps_prior, imu_latency_s
from agent.sensing.receivers import ReceiverChoice
from agent.sensing.samples import (
    AttitudeSample,
    AutopilotEstimate,
    BaroSample,
    GpsSample,
    GroundSample,
    ImuSample,
    Sample,
    Triple,
)

MILLI_G_MPS2 = 9.80665e-3
UNKNOWN_16 = 65535
PREFERENCE_HOLD_S = 1.0
"""A message serves once those that are better have been silent for this long."""
MAX_STAMP_AGE_S = 5.0
MAX_STAMP_LEAD_S = 0.2
UNIX_US = 10**15
"""A ``time_usec`` above this is Unix time (after 2001), below it time since boot."""
GPS_SIGMA_FLOOR_M = 0.02
"""Least 1-sigma of a fix, whatever the receiver claims: RTK is no better than its antenna's phase centre."""
FROZEN_FIXES = 3
"""A fix that has come so often in a row, to the last digit of position and velocity, is no new measurement."""
MOVING_MPS = 0.5
"""Above it a fix that repeats contradicts its own velocity: its next one is many of its digits away. A receiver at
rest may say the same for long, as some filter their output."""
GPS_SPEED_SIGMA_MPS = 0.3
"""Where the receiver does not report a speed accuracy."""
GPS_RANGE_ERROR_M = 2.5
"""1-sigma of a pseudorange (UERE), single frequency: sigma = dilution times this where the receiver reports none."""
_SCALED_IMUS = (
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU3,
)
_PRESSURES = (
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE2,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE3,
)
"""The best one first: of PX4 HIGHRES_IMU comes more often."""
UNKNOWN_8 = 255
GROUND_SIGMA_M, GROUND_SHARE = 0.1, 0.02
"""1-sigma of a range finder that does not tell its own: at least, and of the distance."""
INVALID_QUALITY = 1
_ACCEL_AND_GYRO = 0b111111
_ABSOLUTE_PRESSURE = int(mavlink.HIGHRES_IMU_UPDATED_ABS_PRESSURE)
MAX_FORCE_MPS2, MAX_TURN_RADPS = 1000.0, 100.0
"""Per axis; beyond what any IMU of a drone can measure (100 g, 5700 deg/s), so no measurement."""

StampS = Callable[[float, float], float | None]
"""(boot time, arrival) to fleet time in s; ``None`` if it cannot be told."""


_AIDED = mavlink.ESTIMATOR_PRED_POS_HORIZ_REL | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
"""Flags of which an aided estimator has one: they go at once with the fix, those of its estimate after seconds."""


@dataclass(slots=True)
class _HeardReceiver:
    """What is remembered of one of the autopilot's receivers."""

    number: int
    """From 0."""
    has_fix: bool | None = None
    """Whether its last message said that it has a fix; ``None``: none came."""
    last_fix: tuple[int, ...] = ()
    """Time, place and velocity, as sent."""
    repeats: int = 0
    """How often the last fix has come again, with another time."""
    frozen: bool = False
    utc: UtcStamps = field(default_factory=UtcStamps)
    on_boot_clock: bool = False
    """Whether it has ever stamped a fix with the time since boot."""


class SampleAdapter:
    """The samples of one autopilot.

    ``skipped`` counts messages that gave none, by reason, ``noted`` what was dealt with. Fleet times come from
    ``fleet_time_of_boot``; ``epoch_unix_s`` makes fleet time of the stamps that are Unix time. ``receivers`` are the
    numbers of those that will have fixes, where that is known.
    """

    def __init__(
        self,
        frame: FleetFrame,
        sensors: SensorsTable,
        epoch_unix_s: float,
        fleet_time_of_boot: StampS,
        receivers: Collection[int] | None = None,
        own_receiver: int | None = None,
    ) -> None:
        """``own_receiver`` is the number of the one whose fixes are what we gave the autopilot."""
        self._frame = frame
        self._sensors = sensors
        self._epoch_unix_s = epoch_unix_s
        self._fleet_time_of_boot = fleet_time_of_boot
        self._known_receivers = receivers
        self._own_receiver = own_receiver
        self._heard_s: dict[str, dict[int, float]] = {}
        """When each message of a kind last came, by its place among them."""
        self.flavour = "other"
        """``ardupilot``, ``px4`` or ``other``, set by the owner once the autopilot is known: only ArduPilot scales
        RAW_IMU, and the sensors of each are late in their own way."""
        self.received: Counter[str] = Counter()
        """Messages of sensors, by kind."""
        self.skipped: Counter[str] = Counter()
        self.noted: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget the streams seen, as after a reboot."""
        self._heard_s.clear()
        self._receivers = (_HeardReceiver(0), _HeardReceiver(1))
        self._choice = ReceiverChoice(self._known_receivers)
        self.fix_type = 0
        """The last word on its fix of the receiver that is listened to."""
        self.aided = True
        """Whether the autopilot's own estimator is aided by positions, by its last word."""
        self._was_aided = False

    @property
    def without_fix(self) -> bool:
        """Whether all receivers that spoke last said that they have no fix."""
        return {receiver.has_fix for receiver in self._receivers} - {None} == {False}

    @property
    def frozen(self) -> bool:
        """Whether a receiver repeats a fix that its own velocity contradicts."""
        return any(receiver.frozen for receiver in self._receivers)

    def convert(self, message: Message, arrival_s: float) -> Sample | None:
        """The sample of a message that arrived at fleet time ``arrival_s``; ``None`` if it gives none."""
        converter = _CONVERTERS.get(message.get_msgId())
        kind = SENSORS.get(message.get_msgId())
        if kind is not None:
            self.received[kind] += 1
        return None if converter is None else converter(self, message, arrival_s)

    def pressure_beside(self, message: Message, arrival_s: float) -> Sample | None:
        """The barometer's sample in a message of the IMU's; ``None`` if there is none in it."""
        if message.get_msgId() != mavlink.MAVLINK_MSG_ID_HIGHRES_IMU or message.id:
            return None
        if not message.fields_updated & _ABSOLUTE_PRESSURE:
            return None
        self.received["baro"] += 1
        return self._pressure(message.abs_pressure, message.time_usec, arrival_s, message.get_msgId(), WRAP_US_S)

    # --- IMU and attitude ----------------------------------------------------------------------------------

    def _highres_imu(self, message: Message, arrival_s: float) -> Sample | None:
        if message.id:
            return self._skip("imu: not the first one")
        if message.fields_updated & _ACCEL_AND_GYRO != _ACCEL_AND_GYRO:
            return self._skip("imu: nothing new")
        if not self._serves("imu", 0, arrival_s):
            return None
        force = (message.xacc, message.yacc, message.zacc)
        turn = (message.xgyro, message.ygyro, message.zgyro)
        return self._imu(message.time_usec, force, turn, arrival_s)

    def _raw_imu(self, message: Message, arrival_s: float) -> Sample | None:
        if self.flavour != "ardupilot":
            return self._skip("imu: RAW_IMU unscaled")
        if message.id:
            return self._skip("imu: not the first one")
        if not self._serves("imu", 1, arrival_s):
            return None
        return self._imu(message.time_usec, *_in_thousandths(message), arrival_s)

    def _scaled_imu(self, message: Message, arrival_s: float) -> Sample | None:
        """SCALED_IMU, SCALED_IMU2 and 3: the autopilot's first, second and third one."""
        if not self._serves("imu", 2 + _SCALED_IMUS.index(message.get_msgId()), arrival_s):
            return None
        return self._imu(message.time_boot_ms * 1000, *_in_thousandths(message), arrival_s, WRAP_MS_S)

    def _imu(
        self, time_usec: int, force: Triple, turn: Triple, arrival_s: float, wrap_s: float = WRAP_US_S
    ) -> Sample | None:
        if not _finite(*force, *turn):
            return self._skip("imu: not finite")
        if max(map(abs, force)) > MAX_FORCE_MPS2 or max(map(abs, turn)) > MAX_TURN_RADPS:
            return self._skip("imu: out of range")
        t_s = self._stamp(time_usec, arrival_s, "imu", wrap_s)
        return None if t_s is None else ImuSample(t_s - imu_latency_s(self.flavour, self._sensors), force, turn)

    def _attitude_quaternion(self, message: Message, arrival_s: float) -> Sample | None:
        # repr_offset_q only serves displays of tailsitters; the attitude is q alone.
        quaternion = normalised((message.q1, message.q2, message.q3, message.q4))
        if quaternion is None:
            return self._skip("attitude: no unit quaternion")
        if not self._serves("attitude", 0, arrival_s):
            return None
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "attitude", WRAP_MS_S)
        return None if t_s is None else AttitudeSample(t_s, quaternion, self.aided, self.frozen)

    def _attitude(self, message: Message, arrival_s: float) -> Sample | None:
        if not _finite(message.roll, message.pitch, message.yaw):
            return self._skip("attitude: not finite")
        if not self._serves("attitude", 1, arrival_s):
            return None
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "attitude", WRAP_MS_S)
        quaternion = from_euler(message.roll, message.pitch, message.yaw)
        return None if t_s is None else AttitudeSample(t_s, quaternion, self.aided, self.frozen)

    def _estimator_status(self, message: Message, _arrival_s: float) -> Sample | None:
        """ESTIMATOR_STATUS and EKF_STATUS_REPORT have the same flags for what is asked here."""
        aided = bool(message.flags & _AIDED) and not message.flags & mavlink.ESTIMATOR_CONST_POS_MODE
        self._was_aided = self._was_aided or aided
        self.aided = aided or not self._was_aided  # before its first position it stands still: gravity levels it
        return None

    # --- barometer -----------------------------------------------------------------------------------------

    def _scaled_pressure(self, message: Message, arrival_s: float) -> Sample | None:
        """SCALED_PRESSURE, SCALED_PRESSURE2 and 3: the autopilot's first, second and third barometer."""
        boot_us = message.time_boot_ms * 1000
        return self._pressure(message.press_abs, boot_us, arrival_s, message.get_msgId(), WRAP_MS_S)

    def _pressure(
        self, pressure_hpa: float, time_usec: int, arrival_s: float, message_id: int, wrap_s: float
    ) -> Sample | None:
        altitude_m = pressure_altitude_m(pressure_hpa)
        if altitude_m is None:
            return self._skip("baro: no pressure of air")
        if not self._serves("baro", _PRESSURES.index(message_id), arrival_s):
            return None
        t_s = self._stamp(time_usec, arrival_s, "baro", wrap_s)
        return None if t_s is None else BaroSample(t_s, altitude_m)

    def _distance_sensor(self, message: Message, arrival_s: float) -> Sample | None:
        """DISTANCE_SENSOR in cm, its variance in cm2; of several that look down the one with the lowest number."""
        if message.orientation != mavlink.MAV_SENSOR_ROTATION_PITCH_270:
            return self._skip("ground: looks elsewhere")
        distance_m = message.current_distance * 1e-2
        within = message.min_distance < message.current_distance < message.max_distance
        if not within or message.signal_quality == INVALID_QUALITY:
            return self._skip("ground: out of its reach")
        if not self._serves("ground", message.id, arrival_s):
            return None
        known = message.covariance not in (0, UNKNOWN_8)
        sigma_m = math.sqrt(message.covariance) * 1e-2 if known else GROUND_SIGMA_M + GROUND_SHARE * distance_m
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "ground", WRAP_MS_S)
        return None if t_s is None else GroundSample(t_s, distance_m, sigma_m)

    # --- GPS -----------------------------------------------------------------------------------------------

    def _gps_raw_int(self, message: Message, arrival_s: float) -> Sample | None:
        return self._gps(message, arrival_s, self._receivers[0])

    def _gps2_raw(self, message: Message, arrival_s: float) -> Sample | None:
        return self._gps(message, arrival_s, self._receivers[1])

    def _gps(self, message: Message, arrival_s: float, receiver: _HeardReceiver) -> Sample | None:
        """The fix of a receiver, if it is the one to be listened to."""
        if receiver.number == self._own_receiver:
            return self._skip("gps: given by us")
        fix = (message.time_usec, message.lat, message.lon, message.alt, message.vel, message.cog)
        lost = not self._has_fix(message)  # ArduPilot says so with the time and place of the last one
        receiver.has_fix = not lost
        if not lost and message.time_usec and fix == receiver.last_fix:
            return self._skip("gps: sent again")
        sample = self._no_fix("gps: no fix") if lost else self._fix(message, arrival_s, receiver)
        if sample is None:
            self._choice.without_fix(receiver.number)
            self.fix_type = self.fix_type if receiver.number else message.fix_type
            return None
        if not self._choice.takes(receiver.number, arrival_s):
            return self._skip("gps: not the first one")
        self.fix_type = message.fix_type
        return sample

    def _has_fix(self, message: Message) -> bool:
        return self._sensors.gps_min_fix <= int(message.fix_type) <= int(mavlink.GPS_FIX_TYPE_PPP)

    def _fix(self, message: Message, arrival_s: float, receiver: _HeardReceiver) -> GpsSample | None:
        if not (abs(message.lat) <= 900_000_000 and abs(message.lon) <= 1_800_000_000) or (
            message.lat == 0 and message.lon == 0
        ):
            return self._no_fix("gps: no position")
        height = self._frame.height(message.alt * 1e-3, message.alt_ellipsoid * 1e-3 or None)
        if height is None:
            return self._no_fix("gps: no height of the fleet's sort")
        horizontal = self._accuracy_m(message.h_acc, message.eph)
        vertical = self._accuracy_m(message.v_acc, message.epv)
        if horizontal is None:
            return self._no_fix("gps: no accuracy")
        t_s, kind = self._fix_time(message.time_usec, arrival_s, receiver)
        if t_s is None:
            return None
        if self._is_frozen(message, receiver):  # of what is refused for another reason, nothing is remembered
            return self._no_fix("gps: frozen")
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
            latency=gps_prior(self.flavour, kind, self._sensors),
            receiver=receiver.number,
            speed_may_be_norm=self.flavour == "px4",
        )

    def _fix_time(self, time_usec: int, arrival_s: float, receiver: _HeardReceiver) -> tuple[float | None, Stamp]:
        """Fleet time of a fix, and what it is of; ``None``, and counted, if it is unknown or cannot be true."""
        if not time_usec:  # PX4 sends time 0 while its receiver does not know UTC: then arrival is all there is
            return arrival_s, "arrival"
        if time_usec <= UNIX_US:
            t_s = self._stamp(time_usec, arrival_s, "gps", WRAP_US_S)
            receiver.on_boot_clock = receiver.on_boot_clock or t_s is not None
            return t_s, "boot"
        arrival_unix_s = arrival_s + self._epoch_unix_s
        unix_s = unrolled(time_usec * 1e-6, arrival_unix_s)
        if abs(unix_s - time_usec * 1e-6) > 1.0:
            self.noted["fixes whose weeks have rolled over"] += 1
        shift_s = receiver.utc.shift_s(unix_s, arrival_unix_s)
        if shift_s == 0.0:
            return self._plausible(unix_s - self._epoch_unix_s, arrival_s, "gps"), "utc"
        if shift_s is None and receiver.on_boot_clock:  # a single one is no other clock, but wrong
            self.skipped["gps: wrong time"] += 1
            return None, "utc"
        self.noted["fixes placed by arrival, as their UTC and our clock differ"] += 1
        if shift_s is None:
            return arrival_s, "arrival"
        return self._plausible(unix_s + shift_s - self._epoch_unix_s, arrival_s, "gps"), "arrival"

    def _is_frozen(self, message: Message, receiver: _HeardReceiver) -> bool:
        """Whether the receiver repeats itself though it says that it moves; remembers the fix."""
        fix = (message.time_usec, message.lat, message.lon, message.alt, message.vel, message.cog)
        receiver.repeats = receiver.repeats + 1 if fix[1:] == receiver.last_fix[1:] else 0
        receiver.last_fix = fix
        moves = message.vel != UNKNOWN_16 and message.vel * 1e-2 > MOVING_MPS
        receiver.frozen = moves and receiver.repeats >= FROZEN_FIXES - 1
        return receiver.frozen

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
        t_s = self._stamp(message.time_boot_ms * 1000, arrival_s, "local position", WRAP_MS_S)
        return None if t_s is None else AutopilotEstimate(t_s, position, velocity)

    # --- common --------------------------------------------------------------------------------------------

    def _serves(self, kind: str, place: int, arrival_s: float) -> bool:
        """Whether a message is the best of its kind that comes of late; ``place`` is its place among them."""
        heard_s = self._heard_s.setdefault(kind, {})
        heard_s[place] = arrival_s
        if any(better < place and arrival_s - at_s <= PREFERENCE_HOLD_S for better, at_s in heard_s.items()):
            self.skipped[f"{kind}: a better one comes"] += 1
            return False
        return True

    def _stamp(self, time_usec: int, arrival_s: float, kind: str, wrap_s: float) -> float | None:
        """Fleet time of a stamp; ``None``, and counted, if it is unknown or cannot be true.

        A stamp of the boot clock begins anew every ``wrap_s``, if its sender has it so.
        """
        if time_usec > UNIX_US:
            return self._plausible(time_usec * 1e-6 - self._epoch_unix_s, arrival_s, kind)
        boot_s = time_usec * 1e-6
        t_s = self._fleet_time_of_boot(boot_s, arrival_s)
        if t_s is None:
            self.skipped[f"{kind}: clock unknown"] += 1
            return None
        begun = turns(t_s, arrival_s, wrap_s, wrap_s / 4)  # over a turn, what is known of the drift says little
        if begun:
            t_s = self._fleet_time_of_boot(boot_s + begun * wrap_s, arrival_s)
            assert t_s is not None  # it was known above
        return self._plausible(t_s, arrival_s, kind)

    def _plausible(self, t_s: float, arrival_s: float, kind: str) -> float | None:
        """A fleet time, unless it cannot be true: then it is counted."""
        if -MAX_STAMP_LEAD_S <= arrival_s - t_s <= MAX_STAMP_AGE_S:
            return t_s
        self.skipped[f"{kind}: wrong time"] += 1
        return None

    def _no_fix(self, reason: str) -> GpsSample | None:
        self.skipped[reason] += 1
        return None

    def _skip(self, reason: str) -> Sample | None:
        self.skipped[reason] += 1
        return None


def _in_thousandths(message: Message) -> tuple[Triple, Triple]:
    """Specific force in m/s2 and turn rate in rad/s of a message in thousandths of g and rad/s."""
    x, y, z = (value * MILLI_G_MPS2 for value in (message.xacc, message.yacc, message.zacc))
    p, q, r = (value * 1e-3 for value in (message.xgyro, message.ygyro, message.zgyro))
    return (x, y, z), (p, q, r)


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


_CONVERTERS: dict[int, Callable[[SampleAdapter, Message, float], Sample | None]] = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: SampleAdapter._highres_imu,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: SampleAdapter._raw_imu,
    **dict.fromkeys(_SCALED_IMUS, SampleAdapter._scaled_imu),
    **dict.fromkeys(_PRESSURES[1:], SampleAdapter._scaled_pressure),
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: SampleAdapter._distance_sensor,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: SampleAdapter._attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: SampleAdapter._attitude,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: SampleAdapter._gps_raw_int,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: SampleAdapter._gps2_raw,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: SampleAdapter._local_position_ned,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: SampleAdapter._estimator_status,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: SampleAdapter._estimator_status,
}
