"""ArduPilot dataflash logs (``.BIN``): log time is the autopilot's boot time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from agent.config.tables import SensorsTable
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.dataflash.records import RecordReader, Values, text_of
from sim_bridge.replay.logs.dataflash.vehicle import (
    WANTED,
    DataflashVehicle,
    GpsPairs,
    SimHome,
    instance_of,
    point_of,
)
from sim_bridge.replay.logs.events import (
    Format,
    GeodeticPoint,
    LogCounts,
    LogError,
    LogEvent,
    LogSurvey,
    SystemSurvey,
)
from sim_bridge.replay.logs.files import opened
from sim_bridge.replay.logs.gps_time import GpsTimeFit, unix_of_week
from sim_bridge.replay.logs.stamps import StampRepair, without_outliers
from sim_bridge.replay.logs.surveyed import OwnWords, SurveyedLog

_SYSTEM_ID_PARAMETERS = ("SYSID_THISMAV", "MAV_SYSID")
"""The MAVLink system id, by its old and its new name."""
CONFIRM_RECORDS = 20
"""Records in a row that must agree on a jump of TimeUS: one with a damaged description shows wrong times often."""
_FIX_3D = 3


Record = tuple[str, Values]


def _stamp(record: Record) -> int:
    time_us: int = record[1]["TimeUS"]
    return time_us


def _restamped(record: Record, time_us: int) -> Record:
    return record[0], {**record[1], "TimeUS": time_us}


@dataclass(slots=True)
class _Found:
    """What the survey collects."""

    first_s: float | None = None
    last_s: float = 0.0
    system_id: int = 1
    messages: Counter[str] = field(default_factory=Counter)
    origin: GeodeticPoint | None = None
    home: GeodeticPoint | None = None
    first_fix: GeodeticPoint | None = None
    gps_times: dict[int, GpsTimeFit] = field(default_factory=dict)
    """Of each receiver that had fixes."""
    imus: Counter[int] = field(default_factory=Counter)
    """Records of each IMU."""


class DataflashSource(SurveyedLog):
    """A `LogSource` over a dataflash log, plain or gzip."""

    format: Format = "dataflash"

    def __init__(
        self, path: Path, frame: FleetFrame | None, sensors: SensorsTable, ours: OwnWords = OwnWords()
    ) -> None:
        super().__init__(path, frame, sensors, ours)
        self._sim_home: GeodeticPoint | None = None
        self._imu = 0

    def events(self) -> Iterator[LogEvent]:
        """The samples in the order of the log."""
        (system,) = self.survey().systems.values()
        counts = self.counts = LogCounts()
        vehicle = DataflashVehicle(
            self.frame, self._sensors, system, self._sim_home, counts.skipped, self._imu,
            odometry_is_ours=self._ours.odometry,
        )  # fmt: skip
        with closing(self._placed(counts)) as placed:
            for arrival_s, t_s, name, values in placed:
                for sample in vehicle.samples(name, values, t_s):
                    event = LogEvent(arrival_s, system.system_id, sample)
                    counts.count(event)
                    yield event

    def _placed(self, counts: LogCounts) -> Generator[tuple[float, float, str, Values], None, None]:
        """Arrival, own time, name and values of the wanted records; parameters bear no time worth keeping."""
        repair = StampRepair(counts.notes, zero_us=0, confirm_blind=CONFIRM_RECORDS)
        with opened(self.path, counts.skipped) as file:
            reader = RecordReader(file, WANTED, counts.skipped, counts.notes)
            taken = 0
            for name, values in without_outliers(reader, _stamp, _restamped, counts.notes):
                taken += 1
                time_us = values["TimeUS"]
                arrival_s = repair.place(time_us)
                if arrival_s is None:
                    counts.skipped["wrong time"] += 1
                else:
                    yield arrival_s, time_us * 1e-6 + repair.shift_s, name, values
            counts.notes["records of no interest"] += reader.records - taken

    def _made_survey(self) -> LogSurvey:
        counts = LogCounts()
        found = _Found()
        pairs, sim_home = GpsPairs(), SimHome()
        for arrival_s, t_s, name, values in self._placed(counts):
            found.last_s = arrival_s
            found.first_s = arrival_s if found.first_s is None else found.first_s
            found.messages[name] += 1
            sim_home.add(name, values, t_s)
            for receiver, fix in pairs.add(name, values, t_s):
                if fix["Status"] >= min(self._sensors.gps_min_fix, _FIX_3D):
                    _take_fix(found, receiver, fix, t_s)
            kind, number = instance_of(name, values)
            if kind == "IMU":
                found.imus[number] += 1
            if name == "ORGN":
                _take_origin(found, values)
            elif name == "PARM" and text_of(values.get("Name")) in _SYSTEM_ID_PARAMETERS:
                system_id = values.get("Value", 0)
                found.system_id = int(system_id) if 1 <= system_id <= 255 else found.system_id
        if found.first_s is None:
            raise LogError(self.path, "dataflash records with TimeUS", "none that could be read")
        self._sim_home = sim_home.point()
        most = max(found.imus.values(), default=0)
        self._imu = min((number for number, count in found.imus.items() if 2 * count >= most), default=0)
        unix = found.gps_times[min(found.gps_times)].unix_zero() if found.gps_times else GpsTimeFit().unix_zero()
        return LogSurvey(unix, found.first_s, found.last_s, {found.system_id: _system(found)})


def _take_fix(found: _Found, receiver: int, fix: Values, t_s: float) -> None:
    if found.first_fix is None:
        found.first_fix = point_of(fix)
    gps_time = found.gps_times.setdefault(receiver, GpsTimeFit())
    if fix.get("GWk") and "GMS" in fix:
        gps_time.add(t_s, unix_of_week(fix["GWk"], fix["GMS"]))


def _take_origin(found: _Found, values: Values) -> None:
    point = point_of(values)
    if values.get("Type") == 0:
        found.origin = found.origin or point
    else:
        found.home = found.home or point


def _system(found: _Found) -> SystemSurvey:
    estimates = found.messages["XKF1"] or found.messages["NKF1"]
    estimate_frame: Literal["fleet", "own", "none"] = "own" if estimates else "none"
    if estimates and found.origin is not None:
        estimate_frame = "fleet"
    return SystemSurvey(
        system_id=found.system_id,
        flavour="ardupilot",
        first_s=found.first_s or 0.0,
        last_s=found.last_s,
        reboots=0,
        messages=dict(found.messages),
        origin=found.origin,
        home=found.home,
        first_fix=found.first_fix,
        estimate_frame=estimate_frame,
        truth_from=next((name for name in ("SIM2", "SIM") if found.messages[name]), None),
        receivers=tuple(sorted(found.gps_times)) or (0,),
    )
