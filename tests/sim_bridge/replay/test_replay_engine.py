"""The engine of the replay on flights made up sample by sample: accuracy, repetition, what-if, ends and silences."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample, Triple
from estimators.factory import make_estimator
from estimators.model.layout import Layout, position
from sim_bridge.faults.fault_tables import FaultTable
from sim_bridge.replay.engine import Replay, ReplayCounts
from sim_bridge.replay.feed import Feed, Inputs
from sim_bridge.replay.injection import Injection
from sim_bridge.replay.logs.events import (
    Format,
    LogCounts,
    LogEvent,
    LogSample,
    LogSurvey,
    SystemSurvey,
    TruthSample,
    UnixZero,
)
from sim_bridge.replay.plan import make_plan
from sim_bridge.replay.side_files.range_files import RangeLine
from sim_bridge.replay.synthesis import Synthesiser, SyntheticNoise
from sim_bridge.replay.what_if import GpsDrop, GpsDrops
from tests.support.holding import held
from transport.messages.measurement_body import RangeMeasurement

ROOMS = {"agent", "estimators", "sim_bridge", "transport"}
FRAME = FleetFrame(47.0, 8.0, 400.0, msl=True)
GRAVITY_MPS2 = 9.8
RADIUS_M, LAP_S = 6.0, 12.0
SECONDS = 10.0
CENTRES = {1: (0.0, 0.0, -8.0), 2: (0.0, 20.0, -10.0), 3: (20.0, 0.0, -13.0)}
SETTLED_S = 4.0


def motion(agent: int, t_s: float) -> tuple[Triple, Triple, Triple]:
    """Position, velocity, acceleration on a circle whose height rises and falls."""
    rate = 2 * math.pi / LAP_S
    phase = rate * t_s + agent
    north, east, down = CENTRES[agent]
    c, s = math.cos(phase), math.sin(phase)
    place = (north + RADIUS_M * c, east + RADIUS_M * s, down + 2.0 * s)
    velocity = (-RADIUS_M * rate * s, RADIUS_M * rate * c, 2.0 * rate * c)
    accel = (-RADIUS_M * rate**2 * c, -RADIUS_M * rate**2 * s, -2.0 * rate**2 * s)
    return place, velocity, accel


@dataclass
class FlightLog:
    """A level flight of one drone with a receiver that is good to 0.1 m; silent where ``silence`` says."""

    system_id: int
    path: Path = Path("made.tlog")
    seconds: float = SECONDS
    silence: tuple[float, float] = (math.inf, math.inf)
    late_s: float = 0.0
    format: Format = "tlog"
    frame: FleetFrame = FRAME
    counts: LogCounts = field(default_factory=LogCounts)

    def survey(self) -> LogSurvey:
        system = SystemSurvey(
            system_id=self.system_id,
            flavour="px4",
            first_s=0.0,
            last_s=self.seconds,
            reboots=0,
            messages={},
            origin=None,
            home=None,
            first_fix=None,
            estimate_frame="fleet",
            truth_from="made up",
        )
        return LogSurvey(UnixZero(1.8e9, 0.0, "host"), 0.0, self.seconds, {self.system_id: system})

    def events(self) -> Iterator[LogEvent]:
        rng = np.random.default_rng(self.system_id)
        for k in range(int(self.seconds * 100)):
            t_s = 0.01 * k
            if not self.silence[0] <= t_s < self.silence[1]:
                for sample in self._samples(k, t_s, rng):
                    yield LogEvent(t_s + self.late_s, self.system_id, sample)

    def _samples(self, k: int, t_s: float, rng: np.random.Generator) -> Iterator[LogSample]:
        place, velocity, accel = motion(self.system_id, t_s)
        if k % 2 == 0:
            north, east, down = accel
            yield ImuSample(t_s, (north, east, down - GRAVITY_MPS2), (0.0, 0.0, 0.0))
        if k % 5 == 0:
            yield TruthSample(t_s, place, velocity, (1.0, 0.0, 0.0, 0.0))
            yield AttitudeSample(t_s, (1.0, 0.0, 0.0, 0.0))
        if k % 20 == 0:
            n, e, d = (p + 0.1 * float(rng.standard_normal()) for p in place)
            yield GpsSample(t_s, (n, e, d), 0.1, 0.1, velocity[:2], None, 0.1, 3)
        if k % 50 == 0:
            yield AutopilotEstimate(t_s, place, velocity)


def fleet(*settings: str) -> FleetConfig:
    origin = {"lat_deg": FRAME.lat_deg, "lon_deg": FRAME.lon_deg, "alt_m": FRAME.alt_m}
    document = {
        "fleet": {"name": "test", "origin": origin},
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{15000 + i}"} for i in CENTRES],
        "sensors": {"gravity_mps2": GRAVITY_MPS2, "accel_sigma_mps2": 0.05, "gps_latency_s": 0.0},
    }
    return config_from(document, "test", settings)


class Run:
    """A replay of made-up flights and all that came out of it."""

    def __init__(
        self,
        *settings: str,
        logs: tuple[FlightLog, ...] | None = None,
        drops: tuple[str, ...] = (),
        ranges: list[RangeLine] | None = None,
        synthetic: bool = True,
        from_s: float = 0.0,
        to_s: float = math.inf,
        at_stamps: bool = False,
        faults: tuple[FaultTable, ...] = (),
    ) -> None:
        self.estimates: dict[int, list[EstimateReady]] = {}
        self.references: dict[int, list[object]] = {}
        config = fleet(*settings)
        plan = make_plan(config, logs or tuple(FlightLog(i) for i in CENTRES))
        config = _with_epoch(config, plan.epoch_unix_s)
        self.start_s = plan.start_s
        windows = GpsDrops([GpsDrop.parsed(text) for text in drops], config.ids, plan.start_s, plan.end_s)
        source: Synthesiser | list[RangeLine] | None = ranges
        if source is None and synthetic:
            source = Synthesiser({i: config.neighbours(i) for i in config.ids}, SyntheticNoise(), 1)
        end_s = min(plan.end_s, plan.start_s + to_s)
        injection = Injection(faults, 1, plan.start_s)
        inputs = Inputs(plan, windows, plan.start_s + from_s, end_s, None, source, at_stamps, injection=injection)
        self.layout = Layout(config.ids)
        self.closed = 0
        self.replay = Replay(config, Feed(inputs, self), make_estimator, self.on_estimate)
        self.counts: ReplayCounts = self.replay.run()
        counted = {name for drone in self.replay.drones.values() for name in drone.agent.core.counters}
        assert not {"estimator faults", "core faults"} & counted

    def on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.estimates.setdefault(agent.agent_id, []).append(ready)

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        self.references.setdefault(agent_id, []).append(sample)

    def close(self) -> None:
        self.closed += 1

    def errors_m(self, agent_id: int, from_s: float = SETTLED_S) -> np.ndarray:
        """Distances of the own estimates from the truth, from a time after the start."""
        own = position(self.layout.slot(agent_id))
        errors = [
            math.dist(ready.estimate.mean[own], motion(agent_id, ready.t_s - self.start_s)[0])
            for ready in self.estimates[agent_id]
            if ready.t_s >= self.start_s + from_s
        ]
        return np.array(errors)


def _with_epoch(config: FleetConfig, epoch_unix_s: float | None) -> FleetConfig:
    import msgspec

    fleet_table = msgspec.structs.replace(config.fleet, epoch_unix_s=epoch_unix_s or 0.0)
    return msgspec.structs.replace(config, fleet=fleet_table)


@pytest.fixture(scope="module")
def whole() -> Run:
    return Run()


def test_every_drone_knows_its_place_better_than_its_receiver_does(whole: Run) -> None:
    for agent_id in CENTRES:
        assert len(whole.estimates[agent_id]) == pytest.approx(10 * SECONDS, abs=3)
        assert np.sqrt(np.mean(whole.errors_m(agent_id) ** 2)) < 0.1
        assert whole.counts.agents[agent_id]["range: samples"] > 150


def test_references_come_out_for_the_comparison(whole: Run) -> None:
    kinds = {kind: sum(isinstance(s, kind) for s in whole.references[2]) for kind in (TruthSample, GpsSample)}
    assert kinds == {TruthSample: int(SECONDS * 20), GpsSample: int(SECONDS * 5)}
    assert whole.closed == 1


def test_twice_is_equal_bit_by_bit(whole: Run) -> None:
    again = Run()
    for agent_id, estimates in whole.estimates.items():
        for one, other in zip(estimates, again.estimates[agent_id], strict=True):
            assert one.estimate.mean.tobytes() == other.estimate.mean.tobytes()
            assert one.estimate.covariance.tobytes() == other.estimate.covariance.tobytes()
    assert again.counts.agents == whole.counts.agents


def test_a_drone_whose_gps_is_dropped_flies_on_by_ranges_and_says_so_in_its_counters() -> None:
    # GIVEN the last 5 s without fixes of drone 2
    run = Run(drops=("2:-5,",))
    # THEN the fixes were counted as left out, the others' were used, and the drone is still located
    skipped = {i: run.counts.agents[i].get("skipped gps: dropped on request", 0) for i in CENTRES}
    assert skipped == {1: 0, 2: 25, 3: 0}
    assert np.median(run.errors_m(2, SECONDS - 5.0)) < 0.5
    # and without ranges it knows less
    alone = Run(drops=("2:-5,",), synthetic=False)
    assert alone.estimates[2][-1].estimate.covariance[6, 6] > 4 * run.estimates[2][-1].estimate.covariance[6, 6]


def test_loss_and_delay_act_on_the_virtual_radio(whole: Run) -> None:
    lost = Run("transport.loss=1.0", to_s=5.0)
    assert all(lost.counts.agents[i]["packets received"] == 0 for i in CENTRES)
    assert all(lost.counts.agents[i]["injected losses"] > 50 for i in CENTRES)
    late = Run("transport.delay_s=0.2", to_s=5.0)
    assert late.counts.agents[1]["measurements: late"] > 50
    assert whole.counts.agents[1]["measurements: late"] < 10


def test_ranges_of_a_file_reach_their_observer_and_those_of_others_are_counted() -> None:
    start_s = 10.0
    lines = [RangeLine(start_s + 0.1 * k, 1, 2, 15.0, 0.1) for k in range(40)]
    lines += [RangeLine(start_s + 4.0, 9, 1, 15.0, 0.1), RangeLine(start_s + 4.1, 2, 9, 15.0, 0.1)]
    run = Run(ranges=lines, to_s=5.0)
    assert run.counts.agents[1]["range: samples"] == 40
    assert run.counts.ranges == {"delivered": 41, "observer without a log": 1}
    assert run.counts.agents[2]["skipped uwb not a neighbour"] == 1


def test_ranges_to_anchors_reach_the_drone_whichever_end_wrote_them() -> None:
    lines = [RangeLine(14.0, 9, 1, 15.0, 0.1), RangeLine(14.1, 1, 9, 15.0, 0.1)]
    run = Run("anchors=[{id=9,position_m=[0,0,0]}]", ranges=lines, to_s=5.0)
    assert run.counts.ranges == {"delivered": 2}
    assert run.counts.agents[1]["range: samples"] == 2


def test_a_drone_whose_log_ends_is_gone_and_the_others_go_on() -> None:
    logs = (FlightLog(1, seconds=6.0), FlightLog(2), FlightLog(3))
    run = Run(logs=logs)
    assert run.estimates[1][-1].t_s <= run.start_s + 6.2
    assert run.estimates[2][-1].t_s >= run.start_s + SECONDS - 0.3
    assert np.sqrt(np.mean(run.errors_m(2) ** 2)) < 0.12
    assert all(ready.on_time for ready in run.estimates[2])


def test_a_long_silence_is_left_out_and_the_agents_begin_anew_after_it() -> None:
    # GIVEN logs that say nothing for over a minute
    logs = tuple(FlightLog(i, seconds=84.0, silence=(4.0, 78.0)) for i in CENTRES)
    run = Run(logs=logs)
    # THEN no estimates are made up in between, and there are good ones after it
    times = np.array([ready.t_s - run.start_s for ready in run.estimates[1]])
    assert run.counts.leaps == 1
    assert run.counts.left_out_s == pytest.approx(73.0, abs=0.1)
    assert np.count_nonzero((times > 6.0) & (times < 77.0)) < 5
    assert run.counts.agents[1]["ticks: left out"] > 500
    assert np.sqrt(np.mean(run.errors_m(1, 82.0) ** 2)) < 0.2


def test_samples_may_be_delivered_at_their_stamps() -> None:
    # GIVEN logs whose recorder had everything 0.4 s late
    logs = tuple(FlightLog(i, late_s=0.4) for i in CENTRES)
    as_logged, as_stamped = Run(logs=logs), Run(logs=logs, at_stamps=True)
    # THEN the estimates are made of the past, or as on board
    assert as_logged.errors_m(1).mean() > 2 * as_stamped.errors_m(1).mean()
    assert np.sqrt(np.mean(as_stamped.errors_m(1) ** 2)) < 0.1


def test_a_part_of_the_logs_can_be_replayed() -> None:
    run = Run(to_s=2.0)
    assert run.counts.last_s == pytest.approx(run.start_s + 2.0, abs=0.02)
    assert run.estimates[1][-1].t_s <= run.start_s + 2.2


def test_a_drone_whose_log_ends_before_the_part_is_not_there() -> None:
    run = Run(logs=(FlightLog(1, seconds=3.0), FlightLog(2), FlightLog(3)), from_s=5.0, to_s=8.0)
    assert 1 not in run.estimates
    assert run.estimates[2][-1].t_s > run.start_s + 7.5
    assert np.sqrt(np.mean(run.errors_m(2, 7.0) ** 2)) < 0.15


def test_samples_of_other_systems_in_a_log_are_not_taken() -> None:
    class Mixed(FlightLog):
        def events(self) -> Iterator[LogEvent]:
            for event in super().events():
                yield replace(event, system_id=77)
                yield event

    run = Run(logs=(Mixed(1, seconds=3.0), FlightLog(2, seconds=3.0), FlightLog(3, seconds=3.0)))
    assert run.counts.agents[1]["gps: samples"] == 15


class Forgetful(Run):
    """Keeps nothing of what comes out."""

    def on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        pass

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        pass


def test_a_longer_log_leaves_no_more_behind() -> None:
    """GIVEN flights longer than any monitor remembers THEN a replay holds as much at the end of either."""
    short, long = (
        held(Forgetful(logs=tuple(FlightLog(i, seconds=seconds) for i in CENTRES)).replay) for seconds in (34.0, 46.0)
    )
    ours = [kind for kind in short if kind.__module__.split(".")[0] in ROOMS]
    assert {ImuSample, TruthSample, RangeMeasurement} <= set(ours)
    assert {kind: long[kind] for kind in ours} == {kind: short[kind] for kind in ours}
    assert long.total() < 1.2 * short.total()  # 12 s more of measurements alone are 900 objects of a drone
