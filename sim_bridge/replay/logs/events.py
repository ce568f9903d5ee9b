"""What a flight log gives: samples with the time at which the recorder had them, and what is known of the log.

*Log time* is the log's own common clock in seconds:

========== ================================================================= ==========================
format     log time 0                                                        shared by
========== ================================================================= ==========================
tlog       the first stamp of the ground station; at the vehicle's pace      all systems in the file
dataflash  boot of the autopilot                                             one vehicle
ulog       boot of the autopilot                                             one vehicle
========== ================================================================= ==========================

`LogSurvey.unix` says what Unix time that was, so that logs of several vehicles can be laid side by side.
Everything is converted at this edge: positions are NED metres in the fleet's frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from agent.sensing.frames import FleetFrame
from agent.sensing.samples import (
    AttitudeSample,
    AutopilotEstimate,
    BaroSample,
    FlowSample,
    GpsSample,
    GroundSample,
    ImuSample,
    Quaternion,
    Triple,
    VelocitySample,
)

Format = Literal["tlog", "dataflash", "ulog"]
Flavour = Literal["px4", "ardupilot", "other", "unknown"]


class LogError(ValueError):
    """A log that cannot be read: names the file, what was expected and what was found, in one line."""

    def __init__(self, path: Path | str, expected: str, found: str) -> None:
        super().__init__(f"{path}: expected {expected}, found {found}")
        self.path = str(path)
        self.expected = expected
        self.found = found

    def __reduce__(self) -> tuple[type[LogError], tuple[str, str, str], dict[str, Any]]:
        return type(self), (self.path, self.expected, self.found), self.__dict__


@dataclass(frozen=True, slots=True)
class TruthSample:
    """Where a simulated vehicle truly was: NED m in the fleet's frame, m/s, body FRD to NED.

    ``has_height`` is false where the source knows the horizontal position alone (SIMSTATE): the third
    component is then 0 and must not be used.
    """

    t_s: float
    position_m: Triple
    velocity_mps: Triple | None
    quaternion: Quaternion | None
    has_height: bool = True


LogSample = (
    ImuSample
    | AttitudeSample
    | GpsSample
    | BaroSample
    | GroundSample
    | VelocitySample
    | FlowSample
    | AutopilotEstimate
    | TruthSample
)
"""Samples on log time. An `AutopilotEstimate` of a log is in the frame that `SystemSurvey.estimate_frame` says:
the fleet's, unless the log does not tell where the autopilot's own origin is."""

KINDS: dict[type, str] = {
    ImuSample: "imu",
    AttitudeSample: "attitude",
    GpsSample: "gps",
    BaroSample: "baro",
    GroundSample: "ground",
    VelocitySample: "odometry",
    FlowSample: "flow",
    AutopilotEstimate: "autopilot estimate",
    TruthSample: "truth",
}
"""Names of the samples in counters."""


@dataclass(frozen=True, slots=True)
class LogEvent:
    """A sample, and the log time at which the recorder had it (never decreasing from event to event)."""

    arrival_s: float
    system_id: int
    sample: LogSample


@dataclass(frozen=True, slots=True)
class UnixZero:
    """The Unix time ``unix_s`` of log time 0, 1-sigma, and how it is known.

    ``gps``: from the receiver's time; ``host``: the clock of the computer that recorded or was synchronised
    with; ``unknown``: nothing in the log tells, ``unix_s`` is 0 and ``sigma_s`` infinite. ``drift`` is what
    Unix time gains on log time per second: 0 for a tlog, 1e-5 for a crystal, up to 2e-2 for a slow simulator.
    """

    unix_s: float
    sigma_s: float
    known_by: Literal["gps", "host", "unknown"]
    drift: float = 0.0

    def at(self, t_s: float) -> float:
        """Unix time of a log time."""
        return self.unix_s + (1.0 + self.drift) * t_s


@dataclass(frozen=True, slots=True)
class GeodeticPoint:
    """Degrees, and metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    alt_msl_m: float


@dataclass(frozen=True, slots=True)
class SystemSurvey:
    """One vehicle of a log: its first and last log time, and how much it said.

    ``messages`` counts the valid messages of interest by their name in the format. ``origin`` is that of the
    autopilot's local frame (the first one said), ``first_fix`` the first position of its receiver.
    ``estimate_frame`` says what the positions of `AutopilotEstimate` are about: the fleet's origin, or the
    autopilot's own unknown one.
    """

    system_id: int
    flavour: Flavour
    first_s: float
    last_s: float
    reboots: int
    messages: Mapping[str, int]
    origin: GeodeticPoint | None
    home: GeodeticPoint | None
    first_fix: GeodeticPoint | None
    estimate_frame: Literal["fleet", "own", "none"]
    truth_from: str | None
    """The message that holds the simulator's truth; absent on real flights."""
    receivers: tuple[int, ...] = (0,)
    """The GNSS receivers that had fixes, by number from 0."""


@dataclass(frozen=True, slots=True)
class LogSurvey:
    """What one pass over a log tells."""

    unix: UnixZero
    first_s: float
    last_s: float
    systems: Mapping[int, SystemSurvey]


@dataclass(slots=True)
class LogCounts:
    """What became of a log's content while its events were read."""

    used: dict[int, Counter[str]] = field(default_factory=dict)
    """Samples by system and kind (`KINDS`)."""
    skipped: Counter[str] = field(default_factory=Counter)
    """What gave no sample, by reason: messages and records, except where the reason says bytes."""
    notes: Counter[str] = field(default_factory=Counter)
    """What was seen and dealt with: MAVLink 1 frames, reboots, clock jumps, messages of no interest."""

    def count(self, event: LogEvent) -> None:
        """Note a sample that was given out."""
        kinds = self.used.get(event.system_id)
        if kinds is None:
            kinds = self.used[event.system_id] = Counter()
        kinds[KINDS[type(event.sample)]] += 1


class LogSource(Protocol):
    """One log file. Reading it again gives the same events."""

    counts: LogCounts
    """Of the last reading, complete once `events` is exhausted."""

    @property
    def path(self) -> Path:
        """Where the log is."""

    @property
    def format(self) -> Format:
        """The kind of log."""

    @property
    def frame(self) -> FleetFrame:
        """The frame of positions: the one given, or about the log's own origin or first fix."""

    def survey(self) -> LogSurvey:
        """One pass over the whole log, made once and kept; raises `LogError`."""

    def events(self) -> Iterator[LogEvent]:
        """The samples in the order in which the recorder had them; memory does not grow with the log."""
