"""Telemetry logs of a ground station (``.tlog``): MAVLink frames of one or several vehicles."""

from __future__ import annotations

import struct
from collections import Counter, defaultdict
from collections.abc import Collection, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Literal

from agent.config.tables import SensorsTable
from agent.mavlink.boot_times import SHOW_MS, WRAP_MS_S, WRAP_US_S, turns
from agent.mavlink.codec import Message, mavlink
from agent.mavlink.components import AUTOPILOT_COMPONENT, FLAVOURS, SENSORS, Standing, speaks_for_vehicle, standing
from agent.mavlink.sample_adapter import UNIX_US
from agent.mavlink.utc_stamps import clocks_agree, quickest_s, unrolled
from agent.mavlink.velocities import VELOCITY_MESSAGES
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.boot_clock import BootClockFit, LogBootClock
from sim_bridge.replay.logs.events import (
    Flavour,
    Format,
    GeodeticPoint,
    LogCounts,
    LogError,
    LogEvent,
    LogSample,
    LogSurvey,
    SystemSurvey,
    UnixZero,
)
from sim_bridge.replay.logs.files import opened
from sim_bridge.replay.logs.gps_time import RECEIVER_LATENCY_SIGMA_S, GpsTimeFit
from sim_bridge.replay.logs.stamps import StampRepair, without_outliers
from sim_bridge.replay.logs.surveyed import OwnWords, SurveyedLog
from sim_bridge.replay.logs.telemetry.frames import Frame, FrameReader, decoded
from sim_bridge.replay.logs.telemetry.pace import Pace, PaceSurvey
from sim_bridge.replay.logs.telemetry.vehicle import ESTIMATES, TRUTHS, LoggedVehicle

_NAMED = {
    message_id: mavlink.mavlink_map[message_id].msgname
    for message_id in (
        *SENSORS,
        *VELOCITY_MESSAGES,
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_SIM_STATE,
        mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_SIMSTATE,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    )
}
_WANTED = frozenset(_NAMED)
_KIND_OF_SENSOR = {_NAMED[message_id]: kind for message_id, kind in SENSORS.items()}
_MS, _US = struct.Struct("<I"), struct.Struct("<Q")
_HIGHRES_IMU, _RAW_IMU = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, mavlink.MAVLINK_MSG_ID_RAW_IMU
_BOOT_US = {_HIGHRES_IMU, _RAW_IMU}
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
    raw_clock: BootClockFit = field(default_factory=lambda: BootClockFit(WRAP_US_S))
    """By RAW_IMU alone."""
    shown: tuple[float, float] | None = None
    """The last boot time of another message than RAW_IMU, and its arrival."""
    pace: PaceSurvey = field(default_factory=PaceSurvey)
    utc: GpsTimeFit = field(default_factory=GpsTimeFit)
    """Arrival and UTC of fixes."""
    receivers: set[int] = field(default_factory=set)
    flavours: Counter[Flavour] = field(default_factory=Counter)
    origin: GeodeticPoint | None = None
    home: GeodeticPoint | None = None
    first_fix: GeodeticPoint | None = None

    @property
    def kinds(self) -> set[str]:
        """The sensors that it sends."""
        return {_KIND_OF_SENSOR[name] for name in self.messages if name in _KIND_OF_SENSOR}

    def on_boot_time(self, message_id: int, boot_s: float, arrival_s: float) -> None:
        """Take in the boot time that a message shows; RAW_IMU's may have wrapped, which the others tell."""
        if message_id == _RAW_IMU:
            self.raw_clock.add(boot_s, arrival_s)
            if self.shown is None:
                return
            expected_s = self.shown[0] + arrival_s - self.shown[1]
            boot_s += turns(boot_s, expected_s, WRAP_US_S) * WRAP_US_S
        else:
            self.shown = boot_s, arrival_s
            self.pace.add(boot_s, arrival_s)
        self.clock.add(boot_s, arrival_s)


class TlogSource(SurveyedLog):
    """A `LogSource` over a ``.tlog``, plain or gzip.

    A vehicle is every system with a heartbeat of an autopilot; where none of any autopilot was recorded, every system
    whose component 1 sent sensors. Which component that is, `agent.mavlink.components` tells.
    """

    format: Format = "tlog"

    def __init__(
        self, path: Path, frame: FleetFrame | None, sensors: SensorsTable, ours: OwnWords = OwnWords()
    ) -> None:
        super().__init__(path, frame, sensors, ours)
        self._sources: dict[int, Source] = {}
        self._clocks: dict[int, LogBootClock] = {}
        self._pace: Pace | None = None
        self._recorder_zero_s = 0.0
        """Unix time of log time 0 by the recorder's clock."""
        self._clock_notes: Counter[str] = Counter()

    def events(self) -> Iterator[LogEvent]:
        """The samples of all vehicles in order of arrival."""
        survey = self.survey()
        counts = self.counts = LogCounts()
        frame = self.frame
        vehicles = {
            self._sources[system_id]: LoggedVehicle(
                frame, self._sensors, self._recorder_zero_s, self._clocks[system_id], found
            )
            for system_id, found in survey.systems.items()
        }
        try:
            with closing(self._placed(counts, StampRepair(counts.notes))) as placed:
                for arrival_s, source, message_id, payload, boot_s in placed:
                    vehicle = vehicles.get(source)
                    if message_id in VELOCITY_MESSAGES:
                        vehicle = vehicles.get(self._sources.get(source[0], source))
                    if vehicle is None:
                        counts.skipped["from no autopilot"] += 1
                        continue
                    if boot_s is not None:
                        wrap_s = WRAP_US_S if message_id == _RAW_IMU else WRAP_MS_S
                        vehicle.on_boot_time(boot_s, arrival_s, wrap_s)
                    samples: list[LogSample] = []
                    if message_id in VELOCITY_MESSAGES:
                        samples = self._velocities(vehicle, source, decoded(message_id, payload), arrival_s)
                    elif message_id in vehicle.wanted:
                        samples = vehicle.samples(message_id, decoded(message_id, payload), arrival_s)
                    for sample in samples:
                        event = LogEvent(arrival_s, source[0], sample)
                        counts.count(event)
                        yield event
        finally:
            for vehicle in vehicles.values():
                counts.skipped.update(vehicle.skipped)
                counts.notes.update(vehicle.noted)
            counts.notes.update(self._clock_notes)

    def _velocities(
        self, vehicle: LoggedVehicle, source: Source, message: Message, arrival_s: float
    ) -> list[LogSample]:
        """What a component says of its vehicle's velocity; our own words are nobody's."""
        component, of_autopilot = source[1], source == self._sources[source[0]]
        if component == self._ours.component_id:
            self.counts.skipped["odometry: of our own component id"] += 1
            return []
        of_autopilot = of_autopilot or component == AUTOPILOT_COMPONENT
        sample = vehicle.velocity(message, arrival_s, component, of_autopilot=of_autopilot)
        return [] if sample is None else [sample]

    def _placed(self, counts: LogCounts, repair: StampRepair) -> Generator[Placed, None, None]:
        """The wanted messages with their log times; those with stamps that are not believed are left out."""
        with opened(self.path, counts.skipped) as file:
            reader = FrameReader(file, _WANTED, counts.skipped, counts.notes)
            wanted = 0
            frames = without_outliers(reader, _STAMP, _restamped, counts.notes)
            for stamp_us, system_id, component_id, message_id, payload in frames:
                wanted += 1
                boot_s = _boot_s(message_id, payload)
                of_clock = None if message_id == _RAW_IMU else boot_s  # that one may have wrapped
                arrival_s = repair.place(stamp_us, system_id << 8 | component_id, of_clock)
                if arrival_s is None:
                    counts.skipped["wrong stamp of the recorder"] += 1
                else:
                    arrival_s = arrival_s if self._pace is None else self._pace.log_s(arrival_s)
                    yield arrival_s, (system_id, component_id), message_id, payload, boot_s
            counts.notes["messages of no interest"] += reader.frames - wanted

    def _made_survey(self) -> LogSurvey:
        heard, repair, counts = self._heard()
        self._sources = _autopilots(heard)
        if not self._sources:
            raise LogError(self.path, "frames of an autopilot", _what_else(heard, counts))
        busiest = max(self._sources.values(), key=lambda source: heard[source].messages.total())
        self._pace = heard[busiest].pace.pace()
        if self._pace is not None:
            heard, repair, counts = self._heard()  # anew, on the vehicles' time
        found = {system_id: heard[source] for system_id, source in self._sources.items()}
        self._clocks = {system_id: LogBootClock(_clock(each).sessions()) for system_id, each in found.items()}
        self._clock_notes = sum((_clock_notes(_clock(each)) for each in found.values()), Counter())
        if self._pace is not None:
            self._clock_notes[f"simulator at {self._pace.mean:.2f} of real time: its clock is the log's"] = 1
        systems = {system_id: _system(system_id, each) for system_id, each in found.items()}
        first_s = min((each.first_s for each in heard.values()), default=0.0)
        last_s = max((each.last_s for each in heard.values()), default=0.0)
        return LogSurvey(self._unix(repair, found.values()), first_s, last_s, systems)

    def _heard(self) -> tuple[dict[Source, _SourceSurvey], StampRepair, LogCounts]:
        """One pass over the log."""
        counts = LogCounts()
        repair = StampRepair(counts.notes)
        heard: dict[Source, _SourceSurvey] = {}
        for arrival_s, source, message_id, payload, boot_s in self._placed(counts, repair):
            found = heard.get(source)
            if found is None:
                found = heard[source] = _SourceSurvey(arrival_s)
            found.last_s = arrival_s
            found.messages[_NAMED[message_id]] += 1
            if boot_s is not None:
                found.on_boot_time(message_id, boot_s, arrival_s)
            take = _TAKE.get(message_id)
            if take is not None:
                take(found, decoded(message_id, payload))
        return heard, repair, counts

    def _unix(self, repair: StampRepair, vehicles: Collection[_SourceSurvey]) -> UnixZero:
        """By the recorder's clock, unless the UTC of fixes contradicts it."""
        drift = 0.0 if self._pace is None else 1.0 / self._pace.mean - 1.0
        zero_s = repair.zero_stamp_s
        self._recorder_zero_s = 0.0 if zero_s is None or zero_s < OLDEST_UNIX_S else zero_s
        pairs = [pair for found in vehicles for pair in found.utc.pairs]
        if self._recorder_zero_s:
            late_s = [
                self._recorder_zero_s + arrival_s - unrolled(unix_s, self._recorder_zero_s)
                for arrival_s, unix_s in pairs
            ]
            if not late_s or clocks_agree(quickest_s(late_s)):
                return UnixZero(self._recorder_zero_s, HOST_CLOCK_SIGMA_S, "host", drift)
        elif pairs:
            late_s = [arrival_s - unix_s for arrival_s, unix_s in pairs]
        else:
            return UnixZero(0.0, float("inf"), "unknown", drift)
        latency_s = RECEIVER_LATENCY_SIGMA_S  # of the quickest, about
        return UnixZero(
            self._recorder_zero_s - quickest_s(late_s) + latency_s, RECEIVER_LATENCY_SIGMA_S, "gps", drift
        )


def _restamped(frame: Frame, stamp_us: int) -> Frame:
    return frame._replace(stamp_us=stamp_us)


def _boot_s(message_id: int, payload: bytes) -> float | None:
    """Boot time that a message shows; ``None`` if it shows none."""
    at = SHOW_MS.get(message_id)
    if at is not None:
        return float(_MS.unpack(payload[at : at + 4].ljust(4, b"\0"))[0] * 1e-3)
    if message_id in _BOOT_US:
        time_us: int = _US.unpack(payload[:8].ljust(8, b"\0"))[0]
        return time_us * 1e-6 if 0 < time_us <= UNIX_US else None
    return None


# --- what the survey takes out of a message ------------------------------------------------------------------


def _heartbeat(found: _SourceSurvey, message: Message) -> None:
    if speaks_for_vehicle(message):
        flavour: Flavour = FLAVOURS.get(message.autopilot, "other")  # type: ignore[assignment]
        found.flavours[flavour] += 1


def _gps_raw_int(found: _SourceSurvey, message: Message) -> None:
    _fix(found, message, 0)


def _gps2_raw(found: _SourceSurvey, message: Message) -> None:
    _fix(found, message, 1)


def _fix(found: _SourceSurvey, message: Message, receiver: int) -> None:
    if message.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX:
        return
    found.receivers.add(receiver)
    if found.first_fix is None:
        found.first_fix = _point(message.lat, message.lon, message.alt)
    if message.time_usec > UNIX_US:
        found.utc.add(found.last_s, message.time_usec * 1e-6)


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
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: _gps2_raw,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _origin,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: _home,
}


# --- what the survey concludes -------------------------------------------------------------------------------


def _autopilots(heard: dict[Source, _SourceSurvey]) -> dict[int, Source]:
    """The autopilot's source of each system; systems without any sensor are none where others have some."""
    candidates = {
        source: found
        for source, found in sorted(heard.items())
        if found.flavours and (found.messages.total() >= FEWEST_MESSAGES or len(heard) == 1)
    }
    if not candidates:
        candidates = {
            source: found
            for source, found in sorted(heard.items())
            if source[1] == AUTOPILOT_COMPONENT and found.kinds
        }
    if any(found.kinds for found in candidates.values()):
        candidates = {source: found for source, found in candidates.items() if found.kinds}
    chosen: dict[int, Source] = {}
    for source in candidates:
        other = chosen.get(source[0])
        if other is None or _rank(heard, other) < _rank(heard, source):
            chosen[source[0]] = source
    return chosen


def _rank(heard: dict[Source, _SourceSurvey], source: Source) -> tuple[Standing, int]:
    found = heard[source]
    return standing(source[1], found.kinds, found.flavours), found.flavours.total()


def _clock(found: _SourceSurvey) -> BootClockFit:
    """The boot clock by all messages, or by RAW_IMU where no other shows it."""
    return found.clock if found.clock.heard else found.raw_clock


def _system(system_id: int, found: _SourceSurvey) -> SystemSurvey:
    return SystemSurvey(
        system_id=system_id,
        flavour=found.flavours.most_common(1)[0][0] if found.flavours else "unknown",
        first_s=found.first_s,
        last_s=found.last_s,
        reboots=_clock(found).reboots,
        messages=dict(found.messages),
        origin=found.origin,
        home=found.home,
        first_fix=found.first_fix,
        estimate_frame=_estimate_frame(found),
        truth_from=next((name for name in TRUTHS if found.messages[name]), None),
        receivers=tuple(sorted(found.receivers)) or (0,),
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
