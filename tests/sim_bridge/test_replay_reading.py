"""The logs of a replay read by a second process: the same samples and counts, errors, and an end in every case."""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from agent.config_tables import SensorsTable
from agent.frames import FleetFrame
from agent.samples import AttitudeSample, ImuSample
from sim_bridge.logs import open_log
from sim_bridge.logs.events import Format, LogCounts, LogError, LogEvent, LogSurvey, SystemSurvey, UnixZero
from sim_bridge.replay import reading
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.plan import Vehicle
from sim_bridge.replay.reading import BATCH, log_arrivals, read_beside
from tests.support.logs import FRAME, LOGS

SYSTEM = SystemSurvey(1, "px4", 0.0, 100.0, 0, {}, None, None, None, "fleet", None)


@dataclass
class MadeLog:
    """A log of ``count`` samples, 100 a second; ``trouble`` is called once half of them are out."""

    count: int
    trouble: Callable[[], None] = lambda: None
    path: Path = Path("made.tlog")
    format: Format = "tlog"
    frame: FleetFrame = FRAME
    counts: LogCounts = field(default_factory=LogCounts)

    def survey(self) -> LogSurvey:
        return LogSurvey(UnixZero(0.0, 0.0, "host"), 0.0, 100.0, {1: SYSTEM})

    def events(self) -> Iterator[LogEvent]:
        self.counts = LogCounts()
        for k in range(self.count):
            if k == self.count // 2:
                self.trouble()
            event = LogEvent(0.01 * k, 1, AttitudeSample(0.01 * k, (1.0, 0.0, 0.0, 0.0)))
            self.counts.count(event)
            yield event


@pytest.fixture(autouse=True)
def forking(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A second process even where the tests' own threads would speak against it; none is left behind."""
    monkeypatch.setattr(reading, "_may_fork", lambda: True)
    before = set(multiprocessing.active_children())
    yield
    assert set(multiprocessing.active_children()) == before


def vehicles_of(*names: str) -> list[Vehicle]:
    sources = [open_log(LOGS / name, frame=FRAME, sensors=SensorsTable()) for name in names]
    found = [(source, survey) for source in sources for survey in source.survey().systems.values()]
    return [Vehicle(source, survey, k + 1, 10.0 + 0.25 * k) for k, (source, survey) in enumerate(found)]


@pytest.mark.parametrize("with_truth", [True, False])
def test_who_reads_makes_no_difference(with_truth: bool) -> None:
    # GIVEN recorded logs of several formats, with samples of every kind
    vehicles = vehicles_of("copter.tlog.gz", "px4.tlog.gz", "copter.BIN.gz")
    here = list(log_arrivals(vehicles, to_s=math.inf, with_truth=with_truth))
    counts = [vehicle.source.counts for vehicle in vehicles]
    # WHEN another process reads them
    with read_beside(vehicles, to_s=math.inf, with_truth=with_truth) as logs:
        beside = list(logs)
    # THEN samples, order and counts are the same to the last bit
    assert len(here) > 4 * BATCH
    assert beside == here
    assert [vehicle.source.counts for vehicle in vehicles] == counts
    assert all(vehicle.source.counts.used for vehicle in vehicles)


def test_reading_ends_behind_the_part_that_is_asked_for() -> None:
    vehicle = Vehicle(MadeLog(5000), SYSTEM, 1, 0.0)
    with read_beside([vehicle], to_s=20.0, with_truth=True) as logs:
        times_s = [arrival_s for arrival_s, _, _ in logs]
    assert times_s[-2] <= 20.0 < times_s[-1]
    assert vehicle.source.counts.used[1]["attitude"] == len(times_s)


def test_a_replay_that_ends_early_leaves_no_reader_behind() -> None:
    # GIVEN far more than a pipe holds
    vehicle = Vehicle(MadeLog(200_000), SYSTEM, 1, 0.0)
    # WHEN nobody wants more than the first sample (the fixture looks for the process)
    with read_beside([vehicle], to_s=math.inf, with_truth=True) as logs:
        assert next(logs)[2] == AttitudeSample(0.0, (1.0, 0.0, 0.0, 0.0))


def test_an_error_in_a_log_is_raised_as_it_was() -> None:
    def broken() -> None:
        raise LogError("flight.BIN", "a record", "nonsense")

    with (
        read_beside([Vehicle(MadeLog(100, broken), SYSTEM, 1, 0.0)], to_s=math.inf, with_truth=True) as logs,
        pytest.raises(LogError, match=r"flight\.BIN: expected a record, found nonsense") as caught,
    ):
        list(logs)
    assert (caught.value.path, caught.value.expected, caught.value.found) == ("flight.BIN", "a record", "nonsense")


def test_a_reader_that_is_killed_is_one_clear_error() -> None:
    own = os.getpid()

    def killed() -> None:
        assert os.getpid() != own
        os._exit(9)

    vehicle = Vehicle(MadeLog(4 * BATCH, killed), SYSTEM, 1, 0.0)
    with (
        read_beside([vehicle], to_s=math.inf, with_truth=True) as logs,
        pytest.raises(ReplayError, match=r"made\.tlog: expected to be read to the end"),
    ):
        list(logs)


def test_without_a_second_process_it_is_read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "_may_fork", lambda: False)
    own, readers = os.getpid(), []
    vehicle = Vehicle(MadeLog(10, lambda: readers.append(os.getpid())), SYSTEM, 1, 0.0)
    with read_beside([vehicle], to_s=math.inf, with_truth=True) as logs:
        assert len(list(logs)) == 10
    assert readers == [own]


def test_times_are_shifted_to_fleet_time() -> None:
    vehicle = Vehicle(MadeLog(3), replace(SYSTEM), 7, 5.0)
    with read_beside([vehicle], to_s=math.inf, with_truth=True) as logs:
        arrival_s, agent_id, sample = list(logs)[1]
    assert (arrival_s, agent_id) == (5.01, 7)
    assert not isinstance(sample, ImuSample)
    assert sample.t_s == 5.01
