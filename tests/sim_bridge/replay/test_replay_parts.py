"""Parts of the replay: tracks on disk, statistics, windows, assignment of logs, files of truth."""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.logs.events import Format, LogCounts, LogEvent, LogSurvey, SystemSurvey, UnixZero
from sim_bridge.replay.naming import names_apart
from sim_bridge.replay.plan import LEAD_S, make_plan
from sim_bridge.replay.side_files.truth_files import TruthFile
from sim_bridge.replay.statistics import Spread, Thinned
from sim_bridge.replay.tracks import TrackWriter, WrittenTrack
from sim_bridge.replay.what_if import GpsDrop, GpsDrops, ReplaySpan

FRAME = FleetFrame(47.397742, 8.545594, 489.4, True, None)


def fleet(*ids: int) -> FleetConfig:
    agents = [{"id": i, "mavlink": f"udpin:127.0.0.1:{15000 + i}"} for i in ids]
    origin = {"lat_deg": FRAME.lat_deg, "lon_deg": FRAME.lon_deg, "alt_m": FRAME.alt_m}
    return config_from({"fleet": {"name": "test", "origin": origin}, "agents": agents}, "test")


# --- tracks --------------------------------------------------------------------------------------------------


def test_a_track_gives_back_a_cubic_between_its_samples_and_nothing_in_gaps(tmp_path: Path) -> None:
    # GIVEN a cubic motion sampled every 0.1 s, silent between 2 and 4 s
    def at(t: np.ndarray) -> np.ndarray:
        return np.stack([t**3, 2 * t**2, -t], axis=1)

    def velocity(t: np.ndarray) -> np.ndarray:
        return np.stack([3 * t**2, 4 * t, -np.ones_like(t)], axis=1)

    times = np.array([0.1 * k for k in range(60) if not 2.0 < 0.1 * k < 4.0])
    path = tmp_path / "a.track"
    writer = TrackWriter(path)
    for t, p, v in zip(times, at(times), velocity(times), strict=True):
        writer.write(float(t), tuple(p), tuple(v))
    writer.write(1.0, (0.0, 0.0, 0.0), None)
    writer.close()
    # WHEN it is read between the samples THEN positions are exact
    wanted = np.array([0.05, 1.234, 1.999, 3.0, 5.55, 99.0])
    states = WrittenTrack(path).at(wanted, max_gap_s=0.5)
    known = [0, 1, 2, 4]
    assert states[known, :3] == pytest.approx(at(wanted[known]), abs=1e-9)
    assert states[known, 3:] == pytest.approx(velocity(wanted[known]), abs=0.02)
    assert np.isnan(states[[3, 5]]).all()
    assert writer.written == len(times)


def test_a_track_without_velocities_is_linear(tmp_path: Path) -> None:
    writer = TrackWriter(tmp_path / "a.track")
    writer.write(0.0, (0.0, 0.0, math.nan), None)
    writer.write(0.2, (1.0, 2.0, math.nan), None)
    writer.close()
    state = WrittenTrack(tmp_path / "a.track").at(np.array([0.05]), 1.0)[0]
    assert state[[0, 1, 3, 4]] == pytest.approx([0.25, 0.5, 5.0, 10.0])
    assert np.isnan(state[2])
    assert len(WrittenTrack(tmp_path / "none.track")) == 0


# --- statistics ----------------------------------------------------------------------------------------------


@settings(max_examples=50)
@given(st.lists(st.floats(1e-4, 1e4), min_size=1, max_size=200), st.sampled_from([10, 50, 95]))
def test_a_stream_has_the_figures_of_the_whole(values: list[float], percent: int) -> None:
    spread = Spread()
    for part in np.array_split(np.array([*values, math.nan]), 3):
        spread.add(part)
    assert spread.count == len(values)
    assert spread.rms == pytest.approx(math.sqrt(np.mean(np.square(values))))
    assert spread.mean == pytest.approx(np.mean(values))
    exact = np.percentile(values, percent, method="inverted_cdf")
    assert spread.percentile(percent) == pytest.approx(exact, rel=0.006)


def test_of_nothing_there_are_no_figures() -> None:
    assert (Spread().rms, Spread().mean, Spread().percentile(50)) == (None, None, None)


def test_a_thinned_series_stays_small_and_spans_everything() -> None:
    series = Thinned(limit=100)
    for k in range(10_000):
        series.add(np.array([float(k)]))
    table = series.table(1)[:, 0]
    assert len(table) <= 101
    assert table[0] == 0.0
    assert table[-1] >= 10_000 - 2 * series.step
    assert set(np.diff(table)) == {float(series.step)}


# --- windows -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "window"),
    [
        ("2", (100.0, 300.0)),
        ("2:-90,", (210.0, 300.0)),
        ("2:30,60", (130.0, 160.0)),
        ("2:,50", (100.0, 150.0)),
        ("2:30", (130.0, 300.0)),
        ("2:-90,-10", (210.0, 290.0)),
    ],
)
def test_a_drop_of_gps_is_read_as_it_is_written(text: str, window: tuple[float, float]) -> None:
    drops = GpsDrops([GpsDrop.parsed(text)], (1, 2), 100.0, 300.0)
    assert drops.windows == {2: [window]}
    middle_s = sum(window) / 2
    assert drops.holds(2, middle_s)
    assert not drops.holds(1, middle_s)
    assert not drops.holds(2, window[0] - 0.01)


@pytest.mark.parametrize("text", ["", "x", "2:a,b", "2:1,2,3", "2:nan,", "2;3"])
def test_a_drop_that_cannot_be_read_is_refused(text: str) -> None:
    with pytest.raises(ReplayError, match="--drop-gps: expected"):
        GpsDrop.parsed(text)


@pytest.mark.parametrize("text", ["3:0,1", "2:60,30", "2:500,600"])
def test_a_drop_of_nobody_or_of_no_time_is_refused(text: str) -> None:
    with pytest.raises(ReplayError, match="--drop-gps: expected"):
        GpsDrops([GpsDrop.parsed(text)], (1, 2), 100.0, 300.0)


def test_a_drop_outside_of_what_is_replayed_is_refused_and_cut_at_its_edges() -> None:
    drops = GpsDrops([GpsDrop.parsed("2:30,80")], (1, 2), 100.0, 300.0, (150.0, 200.0))
    assert drops.windows == {2: [(150.0, 180.0)]}
    with pytest.raises(ReplayError, match=r"a part of what is replayed, 50\.0 to 100\.0 s, found 120\.0 to 130\.0 s"):
        GpsDrops([GpsDrop.parsed("2:120,130")], (1, 2), 100.0, 300.0, (150.0, 200.0))


def test_files_of_one_name_are_told_apart_by_their_folders() -> None:
    assert names_apart([Path("x/a.BIN"), Path("y/b.BIN")]) == {Path("x/a.BIN"): "a.BIN", Path("y/b.BIN"): "b.BIN"}
    alike = [Path("day/1/a.BIN"), Path("day/2/a.BIN"), Path("day/2/a.BIN"), Path("a.BIN")]
    assert list(names_apart(alike).values()) == ["1/a.BIN", "2/a.BIN", "a.BIN"]


def test_an_open_window_is_infinite() -> None:
    assert ReplaySpan().resolved(0.0, 10.0) == (-math.inf, math.inf)


# --- which log is which agent --------------------------------------------------------------------------------


@dataclass
class FakeLog:
    """A log of vehicles that say nothing."""

    path: Path
    systems: tuple[int, ...]
    unix: UnixZero
    first_s: float = 5.0
    last_s: float = 105.0
    format: Format = "dataflash"
    frame: FleetFrame = FRAME
    counts: LogCounts = field(default_factory=LogCounts)

    def survey(self) -> LogSurvey:
        return LogSurvey(self.unix, self.first_s, self.last_s, {i: self._system(i) for i in self.systems})

    def _system(self, system_id: int) -> SystemSurvey:
        return SystemSurvey(
            system_id=system_id,
            flavour="px4",
            first_s=self.first_s,
            last_s=self.last_s,
            reboots=0,
            messages={},
            origin=None,
            home=None,
            first_fix=None,
            estimate_frame="none",
            truth_from=None,
        )

    def events(self) -> Iterator[LogEvent]:
        return iter(())


def log(name: str, *systems: int, unix_s: float | None = 1.8e9, first_s: float = 5.0) -> FakeLog:
    unix = UnixZero(0.0, math.inf, "unknown") if unix_s is None else UnixZero(unix_s, 0.1, "gps")
    return FakeLog(Path(name), systems, unix, first_s=first_s, last_s=first_s + 100.0)


def assignment(config: FleetConfig, *logs: FakeLog) -> dict[int, tuple[str, int]]:
    plan = make_plan(config, logs)
    return {v.agent_id: (v.source.path.name, v.survey.system_id) for v in plan.vehicles}


def test_vehicles_go_to_the_agents_with_their_system_ids() -> None:
    assert assignment(fleet(1, 2, 3), log("c", 3), log("ab", 1, 2)) == {1: ("ab", 1), 2: ("ab", 2), 3: ("c", 3)}


def test_a_part_of_the_fleet_may_have_logs() -> None:
    assert assignment(fleet(1, 2, 3), log("c", 3)) == {3: ("c", 3)}


def test_equal_system_ids_go_by_the_order_of_the_logs() -> None:
    assert assignment(fleet(1, 2), log("b", 1), log("a", 1)) == {1: ("b", 1), 2: ("a", 1)}


def test_one_vehicle_and_one_agent_belong_together_whatever_the_ids() -> None:
    assert assignment(fleet(7), log("a", 1)) == {7: ("a", 1)}


@pytest.mark.parametrize("logs", [(log("a", 1), log("b", 1)), (log("a", 9),), (log("a"),)])
def test_logs_that_do_not_fit_are_refused_in_one_line(logs: tuple[FakeLog, ...]) -> None:
    with pytest.raises(ReplayError, match="expected"):
        make_plan(fleet(1, 2, 3), logs)


def test_logs_are_laid_side_by_side_by_their_unix_time() -> None:
    # GIVEN a vehicle that booted 40 s before the other
    plan = make_plan(fleet(1, 2), [log("a", 1, unix_s=1.8e9), log("b", 2, unix_s=1.8e9 - 40.0, first_s=45.0)])
    # THEN both begin together, and the epoch is a whole second before
    assert plan.vehicles[0].first_s == pytest.approx(plan.vehicles[1].first_s)
    assert plan.epoch_unix_s == 1.8e9 + 5.0 - LEAD_S
    assert plan.start_s == pytest.approx(LEAD_S)


def test_logs_whose_clocks_run_slow_are_together_in_the_middle_of_the_flight() -> None:
    # GIVEN two autopilots that lose 2 % and 1 %, one booted 50 s before the other
    slow = [log("a", 1, unix_s=1.8e9), log("b", 2, unix_s=1.8e9 - 50.0, first_s=55.0)]
    for one, drift in zip(slow, (0.02, 0.01), strict=True):
        one.unix = replace(one.unix, drift=drift)
    first, second = make_plan(fleet(1, 2), slow).vehicles
    # THEN the boot times of one Unix instant are one fleet time
    instant_s = 1.8e9 + 55.8
    booted = [(instant_s - 1.8e9) / 1.02, (instant_s - 1.8e9 + 50.0) / 1.01]
    assert booted[0] + first.shift_s == pytest.approx(booted[1] + second.shift_s, abs=0.01)


def test_a_better_clock_replaces_the_logs_own() -> None:
    plan = make_plan(fleet(1, 2), [log("a", 1), log("b", 2)], {1: 1.8e9 + 3.0})
    first, second = plan.vehicles
    assert second.first_s - first.first_s == pytest.approx(3.0)


def test_logs_that_know_no_time_begin_together() -> None:
    plan = make_plan(fleet(1, 2), [log("a", 1, unix_s=None, first_s=3.0), log("b", 2, unix_s=None, first_s=77.0)])
    assert plan.epoch_unix_s is None
    assert plan.vehicles[0].first_s == plan.vehicles[1].first_s


def test_logs_of_different_days_are_refused() -> None:
    with pytest.raises(ReplayError, match="of the same flight"):
        make_plan(fleet(1, 2), [log("a", 1), log("b", 2, unix_s=1.8e9 + 86_400.0)])


# --- files of truth ------------------------------------------------------------------------------------------


def test_truth_is_read_on_either_clock_and_the_recorders_jitter_is_taken_out(tmp_path: Path) -> None:
    # GIVEN a file with both clocks, the recorder's late now and then, and a broken line
    rng = np.random.default_rng(3)
    late_s = np.where(rng.random(500) < 0.2, rng.uniform(0.0, 0.15, 500), 0.0)
    lines = ["# common NED frame: origin lat 47.397742 lon 8.545594 alt 490.4", "time_boot_s,unix_s,n,e,d,vn,ve,vd"]
    for k in range(500):
        boot_s = 30.0 + 0.02 * k
        lines.append(f"{boot_s:.3f},{1.8e9 + boot_s + late_s[k]:.4f},{k},0,-1,50,0,0")
    lines.insert(20, "1,2,x,4,5,6,7,8")
    path = tmp_path / "truth.csv.gz"
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    file = TruthFile(path, FRAME)
    # THEN the clocks are related as they are, and heights are about the fleet's origin, a metre lower
    assert file.unix_of_boot_s() == pytest.approx(1.8e9, abs=1e-3)
    samples = list(file.samples("boot"))
    assert len(samples) == 500
    assert samples[0].t_s == 30.0
    assert samples[0].position_m == pytest.approx((0.0, 0.0, -2.0), abs=1e-6)
    assert file.skipped == {"no numbers": 1}
    unix = list(file.samples("unix"))
    assert [s.t_s for s in unix] == pytest.approx([1.8e9 + s.t_s for s in samples], abs=1e-3)


def test_a_file_that_is_no_truth_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ReplayError, match="expected truth: a header line with n, e, d"):
        list(TruthFile(path, FRAME).samples("boot"))
    path.write_text("")
    with pytest.raises(ReplayError, match="no line that can be read"):
        list(TruthFile(path, FRAME).samples("boot"))
    path.write_text("n,e,d,unix_s\n1,2,3,4\n")
    with pytest.raises(ReplayError, match="time_boot_s"):
        list(TruthFile(path, FRAME).samples("boot"))
