"""What the sources of all formats have in common: a survey that is made once, and the frame that follows from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from agent.config.tables import MavlinkTable, SensorsTable
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.events import LogCounts, LogSurvey
from sim_bridge.replay.logs.frames import frame_about


@dataclass(frozen=True, slots=True)
class OwnWords:
    """What of a log may be what fleetloc gave the autopilot, and is no measurement."""

    component_id: int = MavlinkTable().component_id
    """Of the daemon on the links."""
    odometry: bool = False
    """Whether autopilots were given odometry: logs of theirs do not say by whom."""


class SurveyedLog(ABC):
    """A `LogSource` but for its format and events; ``frame`` is that of its positions, ``None``: the log's own."""

    def __init__(
        self, path: Path, frame: FleetFrame | None, sensors: SensorsTable, ours: OwnWords = OwnWords()
    ) -> None:
        self.path = path
        self._ours = ours
        self._given_frame = frame
        self._sensors = sensors
        self._survey: LogSurvey | None = None
        self.counts = LogCounts()

    @property
    def frame(self) -> FleetFrame:
        """The frame given, else one about the first origin, home or fix of the log."""
        return self._given_frame or frame_about(self.survey().systems.values())

    def survey(self) -> LogSurvey:
        """One pass over the log, made once and kept; raises `LogError` if it holds no vehicle."""
        if self._survey is None:
            self._survey = self._made_survey()
        return self._survey

    @abstractmethod
    def _made_survey(self) -> LogSurvey:
        """The survey, made anew."""
