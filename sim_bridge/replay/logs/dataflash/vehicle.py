"""Dataflash records of one ArduPilot vehicle to samples on log time.

Stamps are the records' own ``TimeUS``; a fix has the receiver's, ``GPA.SMS``, which is also what GPS_RAW_INT
bears on a link.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Callable

from agent.config.tables import SensorsTable
from agent.mavlink.boot_times import WRAP_MS_S
from agent.mavlink.sample_adapter import GROUND_SHARE, GROUND_SIGMA_M
from agent.mavlink.velocities import MAX_MPS, SIGMA_MPS, flow_of
from agent.sensing.barometer import pressure_altitude_m
from agent.sensing.frames import FleetFrame, from_euler, normalised
from agent.sensing.receivers import ReceiverChoice
from agent.sensing.samples import (
    AttitudeSample,
    AutopilotEstimate,
    BaroSample,
    FlowSample,
    GpsSample,
    GroundSample,
    ImuSample,
    Triple,
    VelocitySample,
)
from sim_bridge.replay.logs.dataflash.records import Values
from sim_bridge.replay.logs.events import GeodeticPoint, LogSample, SystemSurvey, TruthSample
from sim_bridge.replay.logs.gps_samples import ReceiverFix, gps_sample, imu_sample

_IMU = ("TimeUS", "I", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
_GPS = ("TimeUS", "I", "Status", "GMS", "GWk", "HDop", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ")
_GPA = ("TimeUS", "I", "VDop", "HAcc", "VAcc", "SAcc", "SMS")
WANTED: dict[str, tuple[str, ...]] = {
    "PARM": ("TimeUS", "Name", "Value"),
    "ORGN": ("TimeUS", "Type", "Lat", "Lng", "Alt"),
    **dict.fromkeys(("IMU", "IMU2", "IMU3"), _IMU),
    "ATT": ("TimeUS", "Roll", "Pitch", "Yaw"),
    **dict.fromkeys(("BARO", "BAR2", "BAR3"), ("TimeUS", "I", "Press")),
    **dict.fromkeys(("GPS", "GPS2"), _GPS),
    **dict.fromkeys(("GPA", "GPA2"), _GPA),
    "VISV": ("TimeUS", "VX", "VY", "VZ", "VErr", "Ign", "Q"),
    "OF": ("TimeUS", "Qual", "flowX", "flowY", "bodyX", "bodyY"),
    "RFND": ("TimeUS", "Instance", "Dist", "Stat", "Orient"),
    "XKF1": ("TimeUS", "C", "VN", "VE", "VD", "PN", "PE", "PD"),
    "NKF1": ("TimeUS", "C", "VN", "VE", "VD", "PN", "PE", "PD"),
    "XKF4": ("TimeUS", "PI"),
    "SIM": ("TimeUS", "Lat", "Lng", "Alt", "Q1", "Q2", "Q3", "Q4"),
    "SIM2": ("TimeUS", "PN", "PE", "PD", "VN", "VE", "VD"),
}
_NUMBERED = {
    "IMU2": ("IMU", 1), "IMU3": ("IMU", 2), "GPS2": ("GPS", 1), "GPA2": ("GPA", 1), "BAR2": ("BARO", 1),
    "BAR3": ("BARO", 2),
}  # fmt: skip
"""Before the field ``I`` came, each further sensor had a record of its own."""
SAME_INSTANT_S = 0.005
"""Records of one loop of the autopilot are stamped this close."""
MAX_GPS_AGE_S = 5.0
LOOKS_DOWN, RANGE_FINDER_GOOD = 25, 4
"""ROTATION_PITCH_270, and RangeFinder's status of a distance in its reach."""
ROUNDING_S = 0.002
"""SMS is in whole milliseconds, and may be of the very instant of the record."""
BESIDE_S = 0.03
"""Over so short a time a simulator's last position and velocity say where it is now."""
MOST_HOMES = 1024
MAX_AWAY_M = 1e6
"""And m/s: beyond what a simulated vehicle can be away from its home, so damage."""


def point_of(values: Values) -> GeodeticPoint | None:
    """The place of a record with Lat, Lng (deg) and Alt (m, mean sea level); ``None`` if there is none in it."""
    lat_deg, lon_deg, alt_m = values.get("Lat", 0.0), values.get("Lng", 0.0), values.get("Alt", math.nan)
    inside = abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and math.isfinite(alt_m)
    return GeodeticPoint(lat_deg, lon_deg, alt_m) if inside and (lat_deg or lon_deg) else None


def instance_of(name: str, values: Values) -> tuple[str, int]:
    """The kind of a record, and which of several sensors it is of, from 0."""
    kind, number = _NUMBERED.get(name, (name, 0))
    return kind, values.get("I", number)


class GpsPairs:
    """Joins GPS (position) and GPA (accuracy) of each receiver, which are logged one after the other."""

    def __init__(self) -> None:
        self._held: dict[int, tuple[float, Values]] = {}
        """The last fix of each receiver, and its log time."""

    def add(self, name: str, values: Values, t_s: float) -> list[tuple[int, Values]]:
        """The fixes that are complete with this record, by receiver: GPS fields, those of GPA where it was logged."""
        kind, receiver = instance_of(name, values)
        complete = [each for each, (at_s, _) in self._held.items() if t_s - at_s > SAME_INSTANT_S]
        if kind == "GPA" and receiver in self._held and receiver not in complete:
            at_s, fix = self._held[receiver]
            self._held[receiver] = at_s, values | fix
        if kind in ("GPS", "GPA") and receiver in self._held and receiver not in complete:
            complete.append(receiver)
        released = [(each, self._held.pop(each)[1]) for each in complete]
        if kind == "GPS" and "Status" in values:
            self._held[receiver] = t_s, values
        return released


class SimHome:
    """Where the simulator's motion (SIM2) begins, from the places (SIM, to 1 cm) that are logged beside it.

    ArduPilot's simulator takes 111.3 km for every degree of latitude, whatever the ellipsoid says, so that places
    and motion disagree by up to 3 mm per metre north: the places near home tell most.
    """

    def __init__(self) -> None:
        self._moved: tuple[float, Triple, Triple] | None = None
        self._frame: FleetFrame | None = None
        self._homes: list[tuple[float, Triple]] = []

    def add(self, name: str, values: Values, t_s: float) -> None:
        """Take in a record, whatever it is."""
        if name == "SIM2" and {"PN", "PE", "PD", "VN", "VE", "VD"} <= values.keys():
            position = (values["PN"], values["PE"], values["PD"])
            self._moved = (t_s, position, (values["VN"], values["VE"], values["VD"]))
        elif name == "SIM" and self._moved is not None and len(self._homes) < MOST_HOMES:
            point = point_of(values)
            age_s = t_s - self._moved[0]
            if point is None or not 0.0 <= age_s <= BESIDE_S:
                return
            if self._frame is None:
                self._frame = FleetFrame(point.lat_deg, point.lon_deg, point.alt_msl_m, msl=True)
            place = self._frame.ned(point.lat_deg, point.lon_deg, point.alt_msl_m)
            moved = moved_on(self._moved[1], self._moved[2], age_s)
            home = (place[0] - moved[0], place[1] - moved[1], place[2] - moved[2])
            self._homes.append((math.hypot(moved[0], moved[1]), home))

    def point(self) -> GeodeticPoint | None:
        """The home; ``None`` if both records were never beside each other."""
        if self._frame is None or not self._homes:
            return None
        nearest = sorted(self._homes)[: -(-len(self._homes) // 4)]
        homes = zip(*(home for _, home in nearest), strict=True)
        north, east, down = (statistics.median(axis) for axis in homes)
        return GeodeticPoint(*self._frame.geodetic((north, east, down)))


def moved_on(position: Triple, velocity: Triple, duration_s: float) -> Triple:
    """A position a moment later."""
    x, y, z = (p + v * duration_s for p, v in zip(position, velocity, strict=True))
    return x, y, z


class DataflashVehicle:
    """Records in the order of the log to samples; ``skipped`` counts what gave none, by reason.

    ``sim_home`` is what the simulator's motion (SIM2) is about, `SimHome`; ``imu`` which IMU is listened to.
    """

    def __init__(
        self,
        frame: FleetFrame,
        sensors: SensorsTable,
        system: SystemSurvey,
        sim_home: GeodeticPoint | None,
        skipped: Counter[str],
        imu: int = 0,
        *,
        odometry_is_ours: bool = False,
    ) -> None:
        """``odometry_is_ours``: what the autopilot was given of its velocity is no measurement."""
        self._imu_number = imu
        self._odometry_is_ours = odometry_is_ours
        self._choice = ReceiverChoice(system.receivers)
        self._frame = frame
        self._sensors = sensors
        self._skipped = skipped
        self._pairs = GpsPairs()
        self._origin_m = None if system.origin is None else self._ned(system.origin)
        self._lane = 0
        self._home_m = None if sim_home is None else self._ned(sim_home)
        self._moved: TruthSample | None = None
        self._converters: dict[str, Callable[[Values, float], LogSample | None]] = {
            "IMU": self._imu,
            "ATT": self._attitude,
            "BARO": self._barometer,
            "VISV": self._odometry,
            "OF": self._flow,
            "RFND": self._range_finder,
            "XKF4": self._primary_lane,
            "ORGN": self._origin,
            "XKF1" if system.messages.get("XKF1") else "NKF1": self._estimate,
            "SIM": self._sim,
            "SIM2": self._sim2,
        }

    def samples(self, name: str, values: Values, t_s: float) -> list[LogSample]:
        """The samples of a record of log time ``t_s``."""
        made: list[LogSample] = []
        for receiver, fix in self._pairs.add(name, values, t_s):
            gps = self._gps(fix, t_s, receiver)
            if gps is None:
                self._choice.without_fix(receiver)
            elif self._choice.takes(receiver, t_s):
                made.append(gps)
            else:
                self._skip("gps: not the first one")
        name, number = instance_of(name, values)
        if name == "IMU" and number != self._imu_number:
            self._skip("imu: not the first one")
            return made
        if name == "BARO" and number:
            self._skip("baro: not the first one")
            return made
        converter = self._converters.get(name)
        if converter is not None:
            try:
                sample = converter(values, t_s)
            except KeyError as label:  # an old or foreign layout lacks a field
                self._skip(f"{name} without {label.args[0]}")
                sample = None
            if sample is not None:
                made.append(sample)
        return made

    # --- sensors ---------------------------------------------------------------------------------------------

    def _imu(self, values: Values, t_s: float) -> LogSample | None:
        force = (values["AccX"], values["AccY"], values["AccZ"])
        turn = (values["GyrX"], values["GyrY"], values["GyrZ"])
        sample = imu_sample(t_s, force, turn, "ardupilot", self._sensors)
        return sample if isinstance(sample, ImuSample) else self._skip(sample)

    def _attitude(self, values: Values, t_s: float) -> LogSample | None:
        angles = (values["Roll"], values["Pitch"], values["Yaw"])
        if not all(map(math.isfinite, angles)) or max(map(abs, angles)) > 720.0:
            return self._skip("attitude: not finite or out of range")
        return AttitudeSample(t_s, from_euler(*map(math.radians, angles)))

    def _barometer(self, values: Values, t_s: float) -> LogSample | None:
        """BARO: the pressure in Pa. Its heights are above where the autopilot was armed."""
        altitude_m = pressure_altitude_m(values["Press"])
        return self._skip("baro: no pressure of air") if altitude_m is None else BaroSample(t_s, altitude_m)

    def _odometry(self, values: Values, t_s: float) -> LogSample | None:
        """VISV: the velocity in NED that a companion gave the autopilot, turned by its alignment of headings."""
        velocity = (values["VX"], values["VY"], values["VZ"])
        if self._odometry_is_ours:
            return self._skip("odometry: may be ours")
        if not all(map(math.isfinite, velocity)) or max(map(abs, velocity)) > MAX_MPS:
            return self._skip("odometry: not finite or out of range")
        if values.get("Ign") or values.get("Q", 0) < 0:
            return self._skip("odometry: says that it failed")
        told = values.get("VErr", math.nan)
        sigma_mps = told if math.isfinite(told) and told > 0.0 else SIGMA_MPS
        return VelocitySample(t_s, velocity, (sigma_mps, sigma_mps, sigma_mps), in_body=False)

    def _flow(self, values: Values, t_s: float) -> LogSample | None:
        """OF: rates about the axes of the body, rad/s, of the picture and of the body itself."""
        flow, turning = (values["flowX"], values["flowY"]), (values["bodyX"], values["bodyY"])
        made = flow_of(t_s, flow, turning, values["Qual"])
        return made if isinstance(made, FlowSample) else self._skip(f"flow: {made}")

    def _range_finder(self, values: Values, t_s: float) -> LogSample | None:
        """RFND: m; of several the first."""
        if values.get("Instance", 0) or values["Orient"] != LOOKS_DOWN:
            return self._skip("ground: not the first one that looks down")
        distance_m = values["Dist"]
        if values["Stat"] != RANGE_FINDER_GOOD or not 0.0 < distance_m < math.inf:
            return self._skip("ground: out of its reach")
        return GroundSample(t_s, distance_m, GROUND_SIGMA_M + GROUND_SHARE * distance_m)

    def _gps(self, values: Values, now_s: float, receiver: int) -> LogSample | None:
        point = point_of(values)
        if point is None:
            return self._skip("gps: no position")
        t_s = now_s
        if values.get("SMS"):  # the same clock as TimeUS, in ms
            age_s = (values["TimeUS"] * 1e-6 - values["SMS"] * 1e-3 + ROUNDING_S) % WRAP_MS_S - ROUNDING_S
            t_s -= age_s
            if age_s > MAX_GPS_AGE_S:
                return self._skip("gps: wrong time")
        fix = ReceiverFix(
            t_s=t_s,
            fix_type=values["Status"],
            lat_deg=point.lat_deg,
            lon_deg=point.lon_deg,
            alt_msl_m=point.alt_msl_m,
            alt_ellipsoid_m=None,
            horizontal_sigma_m=values.get("HAcc"),
            vertical_sigma_m=values.get("VAcc"),
            hdop=values.get("HDop"),
            vdop=values.get("VDop"),
            speed_mps=values.get("Spd"),
            course_rad=None if "GCrs" not in values else math.radians(values["GCrs"]),
            down_mps=values.get("VZ"),
            speed_sigma_mps=values.get("SAcc"),
        )
        sample = gps_sample(fix, self._frame, "ardupilot", self._sensors, receiver)
        return sample if isinstance(sample, GpsSample) else self._skip(sample)

    # --- the autopilot's estimate ----------------------------------------------------------------------------

    def _primary_lane(self, values: Values, t_s: float) -> LogSample | None:
        self._lane = values["PI"]
        return None

    def _origin(self, values: Values, t_s: float) -> LogSample | None:
        point = point_of(values)
        if values["Type"] == 0 and point is not None and self._origin_m is not None:
            self._origin_m = self._ned(point) or self._origin_m
        return None

    def _estimate(self, values: Values, t_s: float) -> LogSample | None:
        if values.get("C", 0) != self._lane:
            return None
        position = (values["PN"], values["PE"], values["PD"])
        velocity = (values["VN"], values["VE"], values["VD"])
        if not all(map(math.isfinite, position + velocity)):
            return self._skip("autopilot estimate: not finite")
        if self._origin_m is not None:
            position = _sum(position, self._origin_m)
        return AutopilotEstimate(t_s, position, velocity)

    # --- truth -----------------------------------------------------------------------------------------------

    def _sim(self, values: Values, t_s: float) -> LogSample | None:
        """SIM gives attitude and place; where SIM2 is logged too, that knows the motion better."""
        quaternion = normalised((values["Q1"], values["Q2"], values["Q3"], values["Q4"]))
        if self._home_m is not None:
            if self._moved is None or not 0.0 <= t_s - self._moved.t_s <= BESIDE_S:
                return self._skip("truth: attitude without motion beside it")
            assert self._moved.velocity_mps is not None
            position = moved_on(self._moved.position_m, self._moved.velocity_mps, t_s - self._moved.t_s)
            return TruthSample(t_s, position, self._moved.velocity_mps, quaternion)
        point = point_of(values)
        position_m = None if point is None else self._ned(point)
        if position_m is None:
            return self._skip("truth: no place")
        return TruthSample(t_s, position_m, None, quaternion)

    def _sim2(self, values: Values, t_s: float) -> LogSample | None:
        if self._home_m is None:
            return self._skip("truth: no place")
        moved = (values["PN"], values["PE"], values["PD"])
        velocity = (values["VN"], values["VE"], values["VD"])
        if not all(map(math.isfinite, moved + velocity)) or max(map(abs, moved + velocity)) > MAX_AWAY_M:
            return self._skip("truth: not finite or out of range")
        self._moved = TruthSample(t_s, _sum(moved, self._home_m), velocity, None)
        return self._moved

    # --- common ----------------------------------------------------------------------------------------------

    def _ned(self, point: GeodeticPoint) -> Triple | None:
        height_m = self._frame.height(point.alt_msl_m, None)
        return None if height_m is None else self._frame.ned(point.lat_deg, point.lon_deg, height_m)

    def _skip(self, reason: str) -> LogSample | None:
        self._skipped[reason] += 1
        return None


def _sum(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
