"""The logs of a replay read by processes beside it: the same samples and counts, errors, and an end in every case."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import pytest

from agent.config.tables import SensorsTable
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample
from sim_bridge import side_process
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.feed import MARK_S, Arrival, Feed, Inputs
from sim_bridge.replay.logs import open_log
from sim_bridge.replay.logs.events import (
    Format,
    LogCounts,
    LogError,
    LogEvent,
    LogSource,
    LogSurvey,
    SystemSurvey,
    TruthSample,
    UnixZero,
)
from sim_bridge.replay.plan import PlannedVehicle, ReplayPlan
from sim_bridge.replay.reading import BATCH, read_beside, surveyed
from sim_bridge.replay.side_files.range_files import RangeCounts, RangeLine, read_ranges
from sim_bridge.replay.side_files.truth_files import TruthFile
from sim_bridge.replay.synthesis import Synthesiser, SyntheticNoise
from sim_bridge.replay.what_if import GpsDrop, GpsDrops
from tests.support.logs import FRAME, LOGS

SYSTEM = SystemSurvey(1, "px4", 0.0, 100.0, 0, {}, None, None, None, "fleet", None)


def _nothing() -> None:
    pass


@dataclass
class MadeLog:
    """A log of ``count`` samples, 100 a second; ``trouble`` is called once half of them are out."""

    count: int
    trouble: Callable[[], None] = _nothing
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


class Empty(MadeLog):
    def survey(self) -> LogSurvey:
        raise LogError("flight.BIN", "a vehicle", "none")


class Killed(MadeLog):
    def survey(self) -> LogSurvey:
        assert multiprocessing.parent_process() is not None
        os._exit(9)


@pytest.fixture(autouse=True)
def forking(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A second process even where the tests' own threads would speak against it; none is left behind."""
    monkeypatch.setattr(side_process, "may_fork", lambda: True)
    before = set(multiprocessing.active_children())
    yield
    assert set(multiprocessing.active_children()) == before


class File:
    """References go to a file, since those of another process are not heard of here."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w")

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        self._file.write(f"{agent_id} {arrival_s!r} {sample}\n")

    def close(self) -> None:
        self._file.close()


class Nobody:
    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        pass

    def close(self) -> None:
        pass


def vehicles_of(*names: str) -> list[PlannedVehicle]:
    sources = [open_log(LOGS / name, frame=FRAME, sensors=SensorsTable()) for name in names]
    found = [(source, survey) for source in sources for survey in source.survey().systems.values()]
    return [PlannedVehicle(source, survey, k + 1, 10.0 + 0.25 * k) for k, (source, survey) in enumerate(found)]


def feed_of(source: LogSource, to_s: float = math.inf) -> Feed:
    plan = ReplayPlan((PlannedVehicle(source, SYSTEM, 1, 0.0),), None, "made up")
    return Feed(Inputs(plan, GpsDrops([], (1,), 0.0, 1.0), 0.0, to_s), Nobody())


def recorded(folder: Path, truth: str) -> Feed:
    """Recorded logs of several formats; truth and ranges of files, or of the logs and made."""
    folder.mkdir()
    vehicles = vehicles_of("copter.tlog.gz", "px4.tlog.gz", "copter.BIN.gz")
    start_s, end_s = min(v.first_s for v in vehicles), max(v.last_s for v in vehicles)
    drops = GpsDrops([GpsDrop.parsed("1:2,9")], (1, 2, 3), start_s, end_s)
    plan = ReplayPlan(tuple(vehicles), None, "made up")
    references = File(folder / "references")
    if truth == "of the logs":
        maker = Synthesiser({1: (2, 3), 2: (1,), 3: (1,)}, SyntheticNoise(), 4)
        return Feed(Inputs(plan, drops, start_s, end_s, None, maker), references)
    times_s = [start_s + 0.1 * k for k in range(100)]
    table = folder / "truth.csv"
    rows = [f"{time_s},{n},0,0" for n, time_s in enumerate(times_s)]
    table.write_text("\n".join(["time_boot_s,n,e,d", *rows, rows[5]]) + "\n")
    ranges = folder / "ranges.csv"
    lines = [f"{time_s},1,2,5.0,0.1" for time_s in times_s]
    ranges.write_text("\n".join(["time_s,observer,target,range_m,sigma_m", *lines, "1,2"]) + "\n")
    file, counts = TruthFile(table, FRAME), RangeCounts()
    return Feed(
        Inputs(
            plan,
            drops,
            start_s,
            end_s,
            {1: file.samples("boot")},
            read_ranges(ranges, counts),
            range_counts=counts,
            truth_skipped={1: file.skipped},
        ),
        references,
    )


@pytest.mark.parametrize("truth", ["of the logs", "of files"])
def test_who_reads_makes_no_difference(tmp_path: Path, truth: str) -> None:
    # GIVEN recorded logs, with samples of every kind
    here = recorded(tmp_path / "here", truth)
    heard = list(here.arrivals())
    # WHEN another process reads them
    beside = recorded(tmp_path / "beside", truth)
    with read_beside(beside) as arrivals:
        heard_beside = list(arrivals)
    # THEN samples, order, references and counts are the same to the last bit
    assert len(heard) > 3 * BATCH
    assert heard_beside == heard
    assert beside.tallies() == here.tallies()
    assert here.dropped[1] > 10
    assert all(counts.used for counts in here.tallies().logs)
    tallies = here.tallies()
    assert tallies.made["too far"] > 100 if truth == "of the logs" else tallies.ranges.skipped.total() == 1
    assert truth == "of the logs" or tallies.truth_skipped[1] == {"time not rising": 1}
    written = [(tmp_path / name / "references").read_text() for name in ("here", "beside")]
    assert written[0] == written[1]
    assert written[0].count("TruthSample") > 90
    assert written[0].count("GpsSample") > here.dropped[1]


def test_agents_hear_how_late_it_is_while_only_references_come() -> None:
    class OnlyTruth(MadeLog):
        def events(self) -> Iterator[LogEvent]:
            for event in super().events():
                yield replace(event, sample=TruthSample(event.arrival_s, (0.0, 0.0, 0.0), None, None))

    heard = list(feed_of(OnlyTruth(1000)).arrivals())
    assert {content for _, _, content in heard} == {None}
    times_s = [time_s for time_s, _, _ in heard]
    assert times_s[-1] == 9.99
    assert all(MARK_S < after - before < MARK_S + 0.02 for before, after in pairwise(times_s[:-1]))


def test_reading_ends_behind_the_part_that_is_asked_for() -> None:
    source = MadeLog(5000)
    with read_beside(feed := feed_of(source, to_s=20.0)) as arrivals:
        times_s = [arrival_s for arrival_s, _, _ in arrivals]
    assert times_s[-1] == 20.0
    assert feed.tallies().logs[0].used[1]["attitude"] == len(times_s) + 1


def test_a_replay_that_ends_early_leaves_no_reader_behind() -> None:
    # GIVEN far more than a pipe holds
    # WHEN nobody wants more than the first sample (the fixture looks for the process)
    with read_beside(feed_of(MadeLog(200_000))) as arrivals:
        assert next(arrivals)[2] == AttitudeSample(0.0, (1.0, 0.0, 0.0, 0.0))


def test_an_error_in_a_log_is_raised_as_it_was() -> None:
    def broken() -> None:
        raise LogError("flight.BIN", "a record", "nonsense")

    with (
        read_beside(feed_of(MadeLog(100, broken))) as arrivals,
        pytest.raises(LogError, match=r"flight\.BIN: expected a record, found nonsense") as caught,
    ):
        list(arrivals)
    assert (caught.value.path, caught.value.expected, caught.value.found) == ("flight.BIN", "a record", "nonsense")


def test_a_full_disk_is_raised_as_it_was() -> None:
    class Full(Nobody):
        def on_reference(
            self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
        ) -> None:
            raise OSError(28, "No space left on device")

    feed = Feed(recorded_inputs(), Full())
    with read_beside(feed) as arrivals, pytest.raises(OSError, match="No space left"):
        list(arrivals)


def recorded_inputs() -> Inputs:
    vehicles = vehicles_of("copter.tlog.gz")
    plan = ReplayPlan(tuple(vehicles), None, "made up")
    return Inputs(plan, GpsDrops([], (1,), 0.0, 1.0), -math.inf, math.inf)


def test_a_reader_that_is_killed_is_one_clear_error() -> None:
    own = os.getpid()

    def killed() -> None:
        assert os.getpid() != own
        os._exit(9)

    with (
        read_beside(feed_of(MadeLog(4 * BATCH, killed))) as arrivals,
        pytest.raises(ReplayError, match=r"made\.tlog: expected to be read to the end"),
    ):
        list(arrivals)


def test_without_a_second_process_it_is_read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side_process, "may_fork", lambda: False)
    own, readers = os.getpid(), []
    with read_beside(feed_of(MadeLog(10, lambda: readers.append(os.getpid())))) as arrivals:
        assert len(list(arrivals)) == 10
    assert readers == [own]


def test_times_are_shifted_to_fleet_time() -> None:
    plan = ReplayPlan((PlannedVehicle(MadeLog(3), replace(SYSTEM), 7, 5.0),), None, "made up")
    with read_beside(Feed(Inputs(plan, GpsDrops([], (7,), 0.0, 1.0), 0.0, math.inf), Nobody())) as arrivals:
        heard: list[Arrival] = list(arrivals)
    arrival_s, agent_id, sample = heard[1]
    assert (arrival_s, agent_id) == (5.01, 7)
    assert not isinstance(sample, (ImuSample, RangeLine, type(None)))
    assert sample.t_s == 5.01


def test_logs_surveyed_side_by_side_are_read_as_if_they_had_not_been() -> None:
    names = ("copter.tlog.gz", "px4.tlog.gz", "copter.BIN.gz")
    one_by_one = [open_log(LOGS / name, frame=FRAME, sensors=SensorsTable()) for name in names]
    together = surveyed([open_log(LOGS / name, frame=FRAME, sensors=SensorsTable()) for name in names])
    for one, other in zip(one_by_one, together, strict=True):
        assert one.survey() == other.survey()
        assert list(one.events()) == list(other.events())
        assert one.counts == other.counts


def test_a_log_that_cannot_be_surveyed_is_named() -> None:
    good = open_log(LOGS / "px4.tlog.gz", frame=FRAME, sensors=SensorsTable())

    with pytest.raises(LogError, match=r"flight\.BIN: expected a vehicle, found none"):
        surveyed([good, Empty(3)])


def test_copies_end_at_once_with_what_is_raised_beside_them() -> None:
    # GIVEN copies at work that would never end
    def interrupted() -> None:
        with side_process.workers(2) as pool:
            for _ in range(2):
                pool.submit(signal.pause)
            raise KeyboardInterrupt

    # WHEN the one that waits for them is interrupted
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    # THEN none is left (the fixture looks for them, too)
    assert not multiprocessing.active_children()


def test_a_reader_killed_in_the_midst_of_a_message_is_the_same_clear_error() -> None:
    # GIVEN a reader that fills its pipe while nobody listens
    feed = feed_of(MadeLog(200_000))
    with read_beside(feed) as arrivals:
        next(arrivals)
        (reader,) = multiprocessing.active_children()
        reader.kill()
        with pytest.raises(ReplayError, match=r"made\.tlog: expected to be read to the end"):
            list(arrivals)


def test_a_survey_that_is_killed_is_one_clear_error() -> None:
    with pytest.raises(ReplayError, match=r"made\.tlog, other\.tlog: expected to be surveyed"):
        surveyed([Killed(3), Killed(3, path=Path("other.tlog"))])
