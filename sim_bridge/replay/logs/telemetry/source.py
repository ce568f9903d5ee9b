"""Telemetry logs of a ground station (``.tlog``): MAVLink frames of one or several vehicles."""

from __future__ import annotations

import struct
from collections import Counter, defaultdict
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Literal

from agent.config.tables import SensorsTable
from agent.mavlink.codec import Message, mavlink
from agent.mavlink.sample_adapter import UNIX_US
from agent.mavlink.session import FLAVOURS
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.boot_clock import BootClockFit, LogBootClock
from sim_bridge.replay.logs.events import (
    Flavour,
    Format,
    GeodeticPoint,
    LogCounts,
    LogError,
    LogEvent,
    LogSurvey,
    SystemSurvey,
    UnixZero,
)
from sim_bridge.replay.logs.files import opened
from sim_bridge.replay.logs.stamps import StampRepair, without_outliers
from sim_bridge.replay.logs.surveyed import SurveyedLog
from sim_bridge.replay.logs.telemetry.frames import Frame, FrameReader, decoded
from sim_bridge.replay.logs.telemetry.vehicle import ESTIMATES, TRUTHS, LoggedVehicle

_NAMED = {
    message_id: mavlink.mavlink_map[message_id].msgname
    for message_id in (
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_SIM_STATE,
        mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_SIMSTATE,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    )
}
_WANTED = frozenset(_NAMED)
_MS, _US = struct.Struct("<I"), struct.Struct("<Q")
_BOOT_MS_AT = {
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 8,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 0,
}
"""Where ``time_boot_ms`` is in the payload: the stamps that show the boot clock."""
_BOOT_US = {mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, mavlink.MAVLINK_MSG_ID_RAW_IMU}
"""Messages that begin with ``time_usec``. (GPS_RAW_INT does too, but bears the time of the fix, long ago.)"""
OLDEST_UNIX_S = 1e9
"""A stamp before 2001 is of a clock that was never set."""
FEWEST_MESSAGES = 5
"""Of a vehicle: in a damaged log single frames pass their checksum by chance."""
HOST_CLOCK_SIGMA_S = 0.05
"""Of a ground station's clock against UTC, if the network sets it; logs of one recorder agree far better."""

_STAMP = attrgetter("stamp_us")

Source = tuple[int, int]
"""System and component id."""
Placed = tuple[float, Source, int, bytes, float | None]
"""Log time, source, message id, payload, boot time in s where the message shows the boot clock."""


@dataclass(slots=True)
class _SourceSurvey:
    """What the survey collects of one source."""

    first_s: float
    last_s: float = 0.0
    messages: Counter[str] = field(default_factory=Counter)
    clock: BootClockFit = field(default_factory=BootClockFit)
    flavours: Counter[Flavour] = field(default_factory=Counter)
    origin: GeodeticPoint | None = None
    home: GeodeticPoint | None = None
    first_fix: GeodeticPoint | None = None


class TlogSource(SurveyedLog):
    """A `LogSource` over a ``.tlog``, plain or gzip.

    A vehicle is every system with a heartbeat of an autopilot; where no heartbeat was recorded at all, every
    system whose component 1 sent something that only an autopilot knows.
    """

    format: Format = "tlog"

    def __init__(self, path: Path, frame: FleetFrame | None, sensors: SensorsTable) -> None:
        super().__init__(path, frame, sensors)
        self._sources: dict[int, Source] = {}
        self._clocks: dict[int, LogBootClock] = {}
        self._clock_notes: Counter[str] = Counter()

    def events(self) -> Iterator[LogEvent]:
        """The samples of all vehicles in order of arrival."""
        survey = self.survey()
        counts = self.counts = LogCounts()
        frame = self.frame
        vehicles = {
            self._sources[system_id]: LoggedVehicle(
                frame, self._sensors, survey.unix.unix_s, self._clocks[system_id], found
            )
            for system_id, found in survey.systems.items()
        }
        try:
            with closing(self._placed(counts, StampRepair(counts.notes))) as placed:
                for arrival_s, source, message_id, payload, boot_s in placed:
                    vehicle = vehicles.get(source)
                    if vehicle is None:
                        counts.skipped["from no autopilot"] += 1
                        continue
                    if boot_s is not None:
                        vehicle.on_boot_time(boot_s, arrival_s)
                    if message_id not in vehicle.wanted:
                        continue
                    sample = vehicle.sample(message_id, decoded(message_id, payload), arrival_s)
                    if sample is not None:
                        event = LogEvent(arrival_s, source[0], sample)
                        counts.count(event)
                        yield event
        finally:
            for vehicle in vehicles.values():
                counts.skipped.update(vehicle.skipped)
            counts.notes.update(self._clock_notes)

    def _placed(self, counts: LogCounts, repair: StampRepair) -> Generator[Placed, None, None]:
        """The wanted messages with their log times; those with stamps that are not believed are left out."""
        with opened(self.path, counts.skipped) as file:
            reader = FrameReader(file, _WANTED, counts.skipped, counts.notes)
            wanted = 0
            frames = without_outliers(reader, _STAMP, _restamped, counts.notes)
            for stamp_us, system_id, component_id, message_id, payload in frames:
                wanted += 1
                boot_s = _boot_s(message_id, payload)
                arrival_s = repair.place(stamp_us, system_id, boot_s)
                if arrival_s is None:
                    counts.skipped["wrong stamp of the recorder"] += 1
                else:
                    yield arrival_s, (system_id, component_id), message_id, payload, boot_s
            counts.notes["messages of no interest"] += reader.frames - wanted

    def _made_survey(self) -> LogSurvey:
        counts = LogCounts()
        repair = StampRepair(counts.notes)
        heard: dict[Source, _SourceSurvey] = {}
        first_s, last_s = 0.0, 0.0
        for arrival_s, source, message_id, payload, boot_s in self._placed(counts, repair):
            found = heard.get(source)
            if found is None:
                found = heard[source] = _SourceSurvey(arrival_s)
            found.last_s = last_s = arrival_s
            found.messages[_NAMED[message_id]] += 1
            if boot_s is not None:
                found.clock.add(boot_s, arrival_s)
            take = _TAKE.get(message_id)
            if take is not None:
                take(found, decoded(message_id, payload))
        self._sources = _autopilots(heard)
        if not self._sources:
            raise LogError(self.path, "frames of an autopilot", _what_else(heard, counts))
        self._clocks = {
            system_id: LogBootClock(heard[source].clock.sessions()) for system_id, source in self._sources.items()
        }
        self._clock_notes = sum((_clock_notes(heard[source].clock) for source in self._sources.values()), Counter())
        systems = {system_id: _system(system_id, heard[source]) for system_id, source in self._sources.items()}
        return LogSurvey(_unix(repair), first_s, last_s, systems)


def _restamped(frame: Frame, stamp_us: int) -> Frame:
    return frame._replace(stamp_us=stamp_us)


def _boot_s(message_id: int, payload: bytes) -> float | None:
    """Boot time that a message shows; ``None`` if it shows none."""
    at = _BOOT_MS_AT.get(message_id)
    if at is not None:
        return float(_MS.unpack(payload[at : at + 4].ljust(4, b"\0"))[0] * 1e-3)
    if message_id in _BOOT_US:
        time_us: int = _US.unpack(payload[:8].ljust(8, b"\0"))[0]
        return time_us * 1e-6 if 0 < time_us <= UNIX_US else None
    return None


# --- what the survey takes out of a message ------------------------------------------------------------------


def _heartbeat(found: _SourceSurvey, message: Message) -> None:
    if message.autopilot != mavlink.MAV_AUTOPILOT_INVALID and message.type != mavlink.MAV_TYPE_GCS:
        flavour: Flavour = FLAVOURS.get(message.autopilot, "other")  # type: ignore[assignment]
        found.flavours[flavour] += 1


def _gps_raw_int(found: _SourceSurvey, message: Message) -> None:
    if found.first_fix is None and message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
        found.first_fix = _point(message.lat, message.lon, message.alt)


def _origin(found: _SourceSurvey, message: Message) -> None:
    if found.origin is None:
        found.origin = _point(message.latitude, message.longitude, message.altitude)


def _home(found: _SourceSurvey, message: Message) -> None:
    if found.home is None:
        found.home = _point(message.latitude, message.longitude, message.altitude)


def _point(lat_e7: int, lon_e7: int, alt_mm: int) -> GeodeticPoint | None:
    if abs(lat_e7) > 900_000_000 or abs(lon_e7) > 1_800_000_000 or not (lat_e7 or lon_e7):
        return None
    return GeodeticPoint(lat_e7 * 1e-7, lon_e7 * 1e-7, alt_mm * 1e-3)


_TAKE = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: _gps_raw_int,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _origin,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: _home,
}


# --- what the survey concludes -------------------------------------------------------------------------------


def _autopilots(heard: dict[Source, _SourceSurvey]) -> dict[int, Source]:
    """The autopilot's source of each system: the one with most heartbeats."""
    chosen: dict[int, Source] = {}
    for source, found in sorted(heard.items()):
        if found.flavours and (found.messages.total() >= FEWEST_MESSAGES or len(heard) == 1):
            other = chosen.get(source[0])
            if other is None or heard[other].flavours.total() < found.flavours.total():
                chosen[source[0]] = source
    if not any(found.messages["HEARTBEAT"] for found in heard.values()):
        chosen = {source[0]: source for source in sorted(heard) if source[1] == 1}
    return chosen


def _system(system_id: int, found: _SourceSurvey) -> SystemSurvey:
    return SystemSurvey(
        system_id=system_id,
        flavour=found.flavours.most_common(1)[0][0] if found.flavours else "unknown",
        first_s=found.first_s,
        last_s=found.last_s,
        reboots=found.clock.reboots,
        messages=dict(found.messages),
        origin=found.origin,
        home=found.home,
        first_fix=found.first_fix,
        estimate_frame=_estimate_frame(found),
        truth_from=next((name for name in TRUTHS if found.messages[name]), None),
    )


def _clock_notes(clock: BootClockFit) -> Counter[str]:
    """What was dealt with in a vehicle's boot times."""
    return Counter(
        {
            "reboots": clock.reboots,
            "jumps of a boot clock": clock.jumps,
            "boot times that fit no clock": clock.refused,
        }
    )


def _estimate_frame(found: _SourceSurvey) -> Literal["fleet", "own", "none"]:
    local, everywhere = ESTIMATES
    if found.origin is not None and found.messages[local]:
        return "fleet"
    if found.messages[everywhere]:
        return "fleet"
    return "own" if found.messages[local] else "none"


def _unix(repair: StampRepair) -> UnixZero:
    zero_s = repair.zero_stamp_s
    if zero_s is None or zero_s < OLDEST_UNIX_S:
        return UnixZero(0.0, float("inf"), "unknown")
    return UnixZero(zero_s, HOST_CLOCK_SIGMA_S, "host")


def _what_else(heard: dict[Source, _SourceSurvey], counts: LogCounts) -> str:
    """Words for what a log without a vehicle holds instead."""
    if heard:
        names: defaultdict[str, int] = defaultdict(int)
        for name, number in chain.from_iterable(found.messages.items() for found in heard.values()):
            names[name] += number
        said = ", ".join(f"{number} {name}" for name, number in sorted(names.items()))
        return f"{said} from systems {sorted({system_id for system_id, _ in heard})}"
    if counts.notes["messages of no interest"]:
        return f"{counts.notes['messages of no interest']} frames of other kinds"
    return "no frame with a correct checksum"
