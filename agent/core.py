"""The agent, sans-I/O: samples and packets in with a time, packets and estimates out.

The daemon drives it in real time, the simulator in lockstep in virtual time, the replay from a log; what
goes in decides what comes out, bit by bit. ``now_s`` is fleet time and never goes back.

Tick k ends at E = (k+1) T and is worked off in this order:

=============================  =================================================================
by E + guard                   close the timeline; own measurements and input; a packet of them out
by E + exchange                neighbours' packets in; when all are there, or half of the time left is
                               over, the next exchange: a packet out with what the last ones brought
then                           `Estimator.begin`
by E + exchange + rounds       L consensus rounds, each until complete or its share is over
then                           `Estimator.solve`; estimate out
=============================  =================================================================

The estimate is of the tick's start k T, from all measurements nearer to it than to the next tick's.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.far_field import FarField
from agent.fleet.lever_arms import has_arms, orientation_measurement, own_arm
from agent.fleet.measurement_store import MeasurementStore
from agent.fleet.measurements import (
    acceleration_measurement,
    anchor_measurement,
    gps_measurements,
    ground_measurement,
    height_measurement,
    odometry_measurement,
    range_measurement,
    sighting_measurement,
)
from agent.fleet.neighbourhood import rounds_of
from agent.fleet.neighbours import NeighbourTable
from agent.fleet.tracking import ESTIMATOR_FAULTS as ESTIMATOR_FAULTS
from agent.fleet.tracking import EstimatorFactory as EstimatorFactory
from agent.fleet.tracking import FleetTracker, in_layout
from agent.outputs import CoreOutput, EstimateReady, Faulted, HealthChanged, Tell, estimate_message
from agent.sensing.barometer import Barometer
from agent.sensing.climb import without_climb
from agent.sensing.detections import DetectionSample, ned_direction
from agent.sensing.gps_antenna import at_body
from agent.sensing.ground import altitude_of, distance_of
from agent.sensing.latency import GpsLatency
from agent.sensing.odometry import Motion, Odometer, over_ground
from agent.sensing.samples import (
    AttitudeSample,
    BaroSample,
    FlowSample,
    GpsSample,
    GroundSample,
    ImuSample,
    RangeSample,
    Sample,
    VelocitySample,
)
from agent.sensing.timeline import TickInput, Timeline, tick_of
from agent.watch.health import HealthMonitor
from agent.watch.integrity_watch import IntegrityWatch
from agent.watch.position_watch import PositionWatch, TickEvidence
from estimators.estimator import Estimate
from estimators.integrity.finding import Finding
from estimators.integrity.solution import Solution
from estimators.integrity.staleness import Ages, gps_lost
from estimators.integrity.thresholds import GPS_LOST_S
from estimators.model.layout import block
from transport.link.rounds import RoundBarrier
from transport.messages.far_body import FarReports
from transport.messages.information_body import Information
from transport.messages.measurement_body import Measurement, Measurements
from transport.messages.window_body import WindowStates
from transport.security.opening import Received

FIX_SHARE = 0.1
"""Of an interval between fixes in their average."""
USUAL_EXCHANGES = 2
"""Packets of records in every tick; more of `transport.exchanges` only where records of earlier ticks are lacked."""
GROUND_AGE_S = 0.5
"""A range finder's word that is older does not tell how far the ground is."""
MAX_BEHIND_TICKS = 50
"""Further behind (a suspended computer, a clock set forward), the ticks between are left out."""


class _Phase(Enum):
    """What the current tick waits for."""

    END = auto()
    PACKETS = auto()
    ROUND = auto()


class AgentCore:
    """One agent.

    ``counters`` holds what happened by name: ticks, late and refused packets, faults. Raises nothing for
    anything that comes in from outside.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        make_estimator: EstimatorFactory,
        timeline: Timeline,
        first_tick: int | None = None,
    ) -> None:
        """``first_tick`` is waited for: those before it were another core's."""
        self._first_tick = first_tick
        self._config = config
        self._agent_id = agent_id
        self._own = config.agent(agent_id)
        self._places_m = config.places_m
        self._period_s = config.fleet.period_s
        self.layout = config.layout
        """Of all who may come: that of the estimates handed out."""
        self.timeline = timeline
        self.gps_latency = GpsLatency(self._period_s, config.sensors)
        drifts = config.estimator.systematic_errors  # without, what drifts would be taken for true
        self.barometer = Barometer() if config.sensors.barometer and drifts else None
        self._odometers = {kind: Odometer() for kind in ("odometry", "flow")}
        self._ground: GroundSample | None = None
        """The range finder's last word."""
        self.records = MeasurementStore(config, agent_id)
        self.neighbours = NeighbourTable(config, agent_id)
        self.watch = PositionWatch(config.transport.neighbour_timeout_s)
        self.health = HealthMonitor()
        self.counters: Counter[str] = Counter()
        self.integrity = IntegrityWatch(config, agent_id)
        self.fleet = FleetTracker(config, agent_id, make_estimator, self.counters, self.integrity)
        self.far_field = FarField(config, agent_id, self.counters)
        self._link_state = ""
        """Of the autopilot, for the health; told with every `advance`."""
        self._rounds = rounds_of(config)
        self._barrier: RoundBarrier[Information | WindowStates] = RoundBarrier(max(self._rounds, 1))
        self._input: TickInput | None = None
        self._last_fix_s: float | None = None
        self._altitude_m: float | None = None
        """Own altitude above the fleet's origin by the last estimate."""
        self._motion: Motion | None = None
        """Own velocity by the last estimate."""
        self._climb_mps: float | None = None
        """Own rate of climb or descent by the last estimate."""
        self._fix_interval_s: float | None = None
        """Between own fixes, on average."""
        self._tick: int | None = None
        self._phase = _Phase.END
        self._end_s = self._close_s = self._packets_by_s = -math.inf
        """When the tick ends, is closed, and goes on without packets that are missing; set with the tick."""
        self._round = 0
        self._exchange = 0
        self._clock_s = -math.inf
        """When `advance` was called last."""

    @property
    def next_tick(self) -> int | None:
        """The first tick of which nobody has heard anything of this core yet."""
        if self._tick is None:
            return self._first_tick
        return self._tick if self._phase is _Phase.END else self._tick + 1

    # --- what comes in -------------------------------------------------------------------------------------

    def on_sample(self, sample: Sample, now_s: float) -> None:
        """A sample of the autopilot's sensors, whichever."""
        if isinstance(sample, ImuSample):
            self.on_imu(sample, now_s)
        elif isinstance(sample, AttitudeSample):
            self.on_attitude(sample, now_s)
        elif isinstance(sample, GpsSample):
            self.on_gps(sample, now_s)
        elif isinstance(sample, BaroSample):
            self.on_baro(sample, now_s)
        elif isinstance(sample, GroundSample):
            self.on_ground(sample, now_s)
        elif isinstance(sample, VelocitySample):
            self.on_velocity(sample, now_s)
        elif isinstance(sample, FlowSample):
            self.on_flow(sample, now_s)

    def on_imu(self, sample: ImuSample, now_s: float) -> None:
        """An IMU sample."""
        if self._plausible("imu", sample.t_s, now_s):
            self.timeline.add_imu(sample)

    def on_attitude(self, sample: AttitudeSample, now_s: float) -> None:
        """An attitude."""
        if self._plausible("attitude", sample.t_s, now_s):
            self.timeline.add_attitude(sample)
            self.integrity.note_frozen(frozen=sample.receiver_frozen)

    def on_gps(self, sample: GpsSample, now_s: float) -> None:
        """A fix."""
        if not self._plausible("gps", sample.t_s, now_s):
            return
        self._note_fix(now_s)
        corrected = without_climb(self.gps_latency.on_fix(self._at_body(sample)), self._climb_mps)
        position, *others = gps_measurements(self._agent_id, corrected, self._period_s, self._config.sensors)
        self._count_own("gps", position)
        for record in others:
            self._on_own_record(record)

    def _at_body(self, sample: GpsSample) -> GpsSample:
        """A fix less the lever arm of its antenna."""
        arms = self._own.gps_antennas_m
        if sample.receiver >= len(arms):
            return sample
        return at_body(sample, arms[sample.receiver], self.timeline.orientation_at(self.gps_latency.taken_s(sample)))

    def on_baro(self, sample: BaroSample, now_s: float) -> None:
        """A barometer's sample; of those in close succession one is used."""
        if not self._plausible("baro", sample.t_s, now_s):
            return
        if self.barometer is None:
            self.counters["baro: switched off"] += 1
            return
        height = self.barometer.take(sample, self._altitude_m)
        if isinstance(height, str):
            self.counters[f"baro: {height}"] += 1
        else:
            self._count_own("baro", height_measurement(self._agent_id, height, self._period_s))

    def on_ground(self, sample: GroundSample, now_s: float) -> None:
        """A range finder's sample, which tells a height where it is known what is below."""
        ground_m = self._config.sensors.ground_m
        if not self._plausible("ground", sample.t_s, now_s):
            return
        self._ground = sample
        if ground_m is None:
            self.counters["ground: switched off"] += 1
            return
        found = altitude_of(sample, self.timeline.orientation_at(sample.t_s), ground_m)
        if isinstance(found, str):
            self.counters[f"ground: {found}"] += 1
        else:
            self._count_own("ground", ground_measurement(self._agent_id, sample.t_s, *found, self._period_s))

    def on_velocity(self, sample: VelocitySample, now_s: float) -> None:
        """A velocity of another sensor than the receiver."""
        if self._plausible("odometry", sample.t_s, now_s):
            self._take_velocity("odometry", sample)

    def on_flow(self, sample: FlowSample, now_s: float) -> None:
        """Optical flow, which tells a velocity where it is known how far the ground is."""
        if not self._plausible("flow", sample.t_s, now_s):
            return
        distance_m = self._distance_m(sample)
        if distance_m is None:
            self.counters["flow: height unknown"] += 1
        else:
            self._take_velocity("flow", over_ground(sample, distance_m))

    def _distance_m(self, sample: FlowSample) -> float | None:
        """From the camera to the ground: as it says, by the range finder, or by the estimate above known ground."""
        if sample.distance_m is not None:
            return sample.distance_m
        if self._ground is not None and abs(self._ground.t_s - sample.t_s) <= GROUND_AGE_S:
            return self._ground.distance_m
        ground_m, orientation = self._config.sensors.ground_m, self.timeline.orientation_at(sample.t_s)
        if ground_m is None or self._altitude_m is None or orientation is None:
            return None
        return distance_of(self._altitude_m, orientation, ground_m)

    def _take_velocity(self, sensor: str, sample: VelocitySample) -> None:
        """Use a velocity, or count why not."""
        if not self._config.sensors.odometry:
            self.counters[f"{sensor}: switched off"] += 1
            return
        found = self._odometers[sensor].take(sample, self.timeline.orientation_at(sample.t_s), self._motion)
        if isinstance(found, str):
            self.counters[f"{sensor}: {found}"] += 1
        else:
            self._count_own(sensor, odometry_measurement(self._agent_id, sample.t_s, found, self._period_s))

    def on_range(self, sample: RangeSample, now_s: float) -> None:
        """A range that this agent's module measured."""
        anchor_m = self._places_m.get(sample.target)
        if sample.observer != self._agent_id or (anchor_m is None and sample.target not in self.layout.agents):
            self.counters["range: not ours"] += 1
        elif not self._plausible("range", sample.t_s, now_s):
            return
        elif anchor_m is None:
            self._count_own("range", range_measurement(sample, self._period_s, self._config.sensors))
        else:
            arm = own_arm(self._own, sample.tag, self.timeline.orientation_at(sample.t_s))
            self._count_own("range", anchor_measurement(sample, anchor_m, arm, self._period_s, self._config.sensors))

    def on_detection(self, sample: DetectionSample, now_s: float) -> None:
        """Where this agent's camera saw a target; of one seen without a distance the estimate has to have one."""
        if not self._plausible("detection", sample.t_s, now_s):
            return
        direction = ned_direction(sample, self.timeline.orientation_at(sample.t_s))
        away_m = self.fleet.roll.distance_m(self._agent_id, sample.target)
        if direction is None:
            self.counters["detection: attitude unknown"] += 1
        elif sample.distance_m is None and away_m is None:
            self.counters["detection: bearing of a target not found"] += 1
        else:
            record = sighting_measurement(self._agent_id, sample, direction, away_m or 0.0, self._period_s)
            self._count_own("detection", record)

    def on_packet(self, received: Received, now_s: float) -> None:
        """A neighbour's message, opened and checked by the transport."""
        message = received.message
        if received.sender not in self.neighbours:
            self.counters["packet: not a neighbour"] += 1
            return
        if self._tick is None:
            self._enter(self._tick_at(now_s))
        self.neighbours.on_packet(received.sender, now_s)
        if isinstance(message, Measurements):
            self._on_measurements(received.sender, message)
        elif isinstance(message, Information | WindowStates):
            self._on_information(received.sender, message, now_s)
        elif isinstance(message, FarReports):
            assert self._tick is not None
            self.far_field.hear(message.reports, self._tick)

    def on_gone(self, agent_id: int) -> None:
        """A neighbour has left (liveliness): nothing is expected of it until it is heard again."""
        if agent_id in self.neighbours:
            self.neighbours.on_gone(agent_id)
            self._barrier.forget(agent_id)

    def _plausible(self, sensor: str, t_s: float, now_s: float) -> bool:
        """Whether a sample's time fits the window; others are counted."""
        self.counters[f"{sensor}: samples"] += 1
        if -1.0 <= now_s - t_s <= MAX_BEHIND_TICKS * self._period_s:
            return True
        self.counters[f"{sensor}: wrong time"] += 1
        return False

    def _count_own(self, sensor: str, record: Measurement) -> None:
        """Take in what a sample of a sensor has become, and count whether it is of any use."""
        if not self._on_own_record(record):
            self.counters[f"{sensor}: refused"] += 1
        elif self._tick is not None and record.tick < self._tick - self._config.estimator.window:
            self.counters[f"{sensor}: late"] += 1
        else:
            self.counters[f"{sensor}: used"] += 1

    def _on_own_record(self, record: Measurement) -> bool:
        """Take in a record of an own sensor, if the wire can hold it and it is none that came before."""
        rounded = self.records.add_own(record)
        if rounded is not None:
            self.fleet.note(rounded, rounded.tick if self._tick is None else self._tick)
        return rounded is not None

    def _on_measurements(self, sender: int, message: Measurements) -> None:
        assert self._tick is not None
        self.neighbours.on_measurements(sender, message.tick, message.exchange)
        self.records.neighbourhood.hear(sender, self._tick)
        if message.tick < self._tick or (message.tick == self._tick and self._phase is _Phase.ROUND):
            self.counters["measurements: late"] += 1
        for record in self._heard_records(sender, message):
            self.fleet.note(record, self._tick)

    def _heard_records(self, sender: int, message: Measurements) -> list[Measurement]:
        """The records of a packet that are new."""
        assert self._tick is not None
        return self.records.add_heard(sender, message.records, self._tick, message.proofs, message.acks)

    def _on_information(self, sender: int, message: Information | WindowStates, now_s: float) -> None:
        outcome = self._barrier.put(sender, message.tick, message.round, message)
        self.counters[f"information: {outcome.name.lower()}"] += 1
        self.neighbours.on_information(sender, now_s)

    def _note_fix(self, now_s: float) -> None:
        """Note that a fix came in; a gap of the receiver is no interval between fixes."""
        if self._last_fix_s is not None and now_s - self._last_fix_s <= GPS_LOST_S:
            known = self._fix_interval_s
            found = now_s - self._last_fix_s
            self._fix_interval_s = found if known is None else known + FIX_SHARE * (found - known)
        self._last_fix_s = now_s

    def gps_is_lost(self, now_s: float) -> bool:
        """Whether the drone has to do without GPS."""
        return gps_lost(self.gps_age_s(now_s), self._fix_interval_s)

    def gps_age_s(self, now_s: float) -> float | None:
        """Time since the last own fix came in; ``None`` before the first."""
        return None if self._last_fix_s is None else now_s - self._last_fix_s

    # --- the tick ------------------------------------------------------------------------------------------

    def next_due_s(self) -> float | None:
        """When `advance` has something to do even if nothing comes in; ``None`` before its first call."""
        if self._tick is None:
            return None
        if self._phase is _Phase.END:
            return self._close_s
        return self._packets_due_s() if self._phase is _Phase.PACKETS else self._barrier.deadline_s

    def advance(self, now_s: float, link_state: str) -> list[CoreOutput]:
        """Do what is due; call it when `next_due_s` has come and after anything came in.

        ``link_state`` says how the autopilot's link is, for the health.
        """
        self._link_state, self._clock_s = link_state, now_s
        outputs: list[CoreOutput] = []
        if self._tick is None:
            self._enter(self._tick_at(now_s))
        if now_s > self._end_s + MAX_BEHIND_TICKS * self._period_s:
            self._leave_out_ticks(now_s)
        while self._survived_step(now_s, outputs):
            pass
        return outputs

    def _survived_step(self, now_s: float, outputs: list[CoreOutput]) -> bool:
        """The next step of the tick if it is due. Whatever fails in it costs this tick's estimate, not the flight."""
        tick = self._tick
        try:
            return self._step(now_s, outputs)
        except Exception as fault:  # noqa: BLE001 - counted, and handed out for the log
            try:
                outputs.append(Faulted(fault, isinstance(fault, ESTIMATOR_FAULTS)))
                self._finish(self._after_fault(fault), now_s, outputs)
            finally:
                if self._tick == tick:  # never the same tick again, whatever happens
                    self._end_tick()
            return True

    def _step(self, now_s: float, outputs: list[CoreOutput]) -> bool:
        """The next step of the tick if it is due."""
        assert self._tick is not None
        if self._phase is _Phase.END:
            if now_s < self._close_s:
                return False
            self._close_tick(now_s, outputs)
        elif self._phase is _Phase.PACKETS:
            return self._exchange_or_begin(now_s, outputs)
        else:
            if not self._barrier.done(now_s):
                return False
            self._mix(now_s, outputs)
        return True

    def _tick_at(self, now_s: float) -> int:
        """Which tick to begin with."""
        tick = tick_of(now_s, self._period_s)
        return tick if self._first_tick is None else max(tick, self._first_tick)

    def _enter(self, tick: int) -> None:
        """Begin to wait for the end of a tick."""
        self._tick, self._phase = tick, _Phase.END
        self._end_s = (tick + 1) * self._period_s
        self._close_s = self._end_s + self._config.transport.guard_s
        self._packets_by_s = self._end_s + self._config.transport.exchange_fraction * self._period_s
        self._barrier.advance(tick)

    def _close_tick(self, now_s: float, outputs: list[CoreOutput]) -> None:
        assert self._tick is not None
        self._input = self.timeline.close(self._tick)
        self.gps_latency.on_tick(self._input)
        self._on_own_record(acceleration_measurement(self._agent_id, self._input))
        if has_arms(self._own):
            orientation = self.timeline.orientation_at(self._tick * self._period_s)
            if orientation is not None:
                self._on_own_record(orientation_measurement(self._agent_id, self._tick, orientation))
        self._tell_records(0, now_s, outputs)
        self._phase = _Phase.PACKETS

    def _exchange_or_begin(self, now_s: float, outputs: list[CoreOutput]) -> bool:
        """The next packet of records if it is due, or the estimate if no more is to come; whether either was.

        The second packet takes what the first ones brought a hop further; those after it repair what was lost.
        """
        assert self._tick is not None
        usual = min(USUAL_EXCHANGES, self._config.transport.exchanges)
        wanted = self._exchange + 1 < usual or self._repairs(now_s)
        complete = self.neighbours.all_measured(self._tick, min(self._exchange, usual - 1), now_s)
        if now_s >= self._packets_by_s or (complete and not wanted):
            self._begin(now_s, outputs)
        elif wanted and (now_s >= self._exchange_by_s() or (complete and self._exchange + 1 < usual)):
            self._tell_records(self._exchange + 1, now_s, outputs)
        else:
            return False
        return True

    def _tell_records(self, exchange: int, now_s: float, outputs: list[CoreOutput]) -> None:
        assert self._tick is not None
        self._exchange = exchange
        outputs.append(Tell(self.records.packet(self._tick, exchange, self.neighbours.heard(now_s))))

    def _repairs(self, now_s: float) -> bool:
        """Whether another packet of this tick is to repair what earlier ticks' packets have not brought."""
        if self._exchange + 1 >= self._config.transport.exchanges:
            return False
        assert self._tick is not None
        return self.records.lacked(self._tick, self.neighbours.heard(now_s))

    def _exchange_by_s(self) -> float:
        """When the exchange under way ends at the latest: each may take half of the time that is left."""
        return self._packets_by_s - (self._packets_by_s - self._close_s) * 0.5 ** (self._exchange + 1)

    def _packets_due_s(self) -> float:
        """When there is something to do while packets are waited for."""
        if self._exchange + 1 < self._config.transport.exchanges and self._clock_s < self._exchange_by_s():
            return self._exchange_by_s()
        return self._packets_by_s

    def _begin(self, now_s: float, outputs: list[CoreOutput]) -> None:
        assert self._tick is not None
        if not self.fleet.begin(self._tick, now_s, self.records):
            self._finish(self.fleet.nothing(self._tick), now_s, outputs)
            return
        self._round = 0
        self._open_round_or_solve(now_s, outputs)

    def _open_round_or_solve(self, now_s: float, outputs: list[CoreOutput]) -> None:
        assert self._tick is not None
        rounds = self._rounds
        if self._round >= rounds:
            self._finish(self.fleet.solve(), now_s, outputs)
            return
        outputs.append(Tell(self.fleet.outgoing(self._tick, self._round)))
        share_s = self._config.transport.rounds_fraction * self._period_s / rounds
        deadline_s = self._packets_by_s + (self._round + 1) * share_s
        self._barrier.open(self._tick, self._round, self.neighbours.informing(now_s), deadline_s)
        self._phase = _Phase.ROUND

    def _mix(self, now_s: float, outputs: list[CoreOutput]) -> None:
        self.fleet.mix(self._round, self._barrier.close())
        self._round += 1
        self._open_round_or_solve(now_s, outputs)

    def _finish(self, estimate: Estimate, now_s: float, outputs: list[CoreOutput]) -> None:
        """Hand out an estimate of those who are present, and go on to the next tick."""
        assert self._tick is not None
        on_time = now_s <= self._end_s + self._period_s
        present = self.fleet.present
        own = block(present.index(self._agent_id))
        whole = in_layout(estimate, present, self.layout)
        if self.far_field.is_on:
            whole = self.far_field.added_to(whole, present)
        message = estimate_message(estimate, present, own)
        found = self.watch.observe(self._evidence(estimate, own, now_s))
        stated = self.integrity.state(estimate, present, found)
        ready = EstimateReady(whole, self._tick * self._period_s, now_s, on_time, present, stated)
        changed = self.health.update(found, now_s)
        if self.fleet.started:
            self.far_field.note_own(estimate, own)
            self._climb_mps, self._altitude_m = abs(float(estimate.mean[own][5])), -float(estimate.mean[own][2])
            self._motion = _motion(estimate, own, self._tick * self._period_s)
        reports = self.far_field.packet(self._tick)
        outputs += (ready, Tell(message))  # nothing fails from here on: no tick has two estimates
        if reports is not None:
            outputs.append(Tell(reports))
        if changed is not None:
            outputs.append(HealthChanged(changed))
        self.counters["ticks"] += 1
        self.counters["ticks: late"] += not on_time
        self.counters["ticks: alarm"] += self.health.health.alarm
        self.counters[f"integrity: {stated.state.lower()}"] += 1
        for off in stated.off:
            self.counters[f"integrity: fixes of {off} off"] += 1
        for one, other in stated.ranges_off:
            self.counters[f"integrity: ranges of {one} and {other} off"] += 1
        self.counters[f"status: {estimate.status.name.lower()}"] += 1
        self._end_tick()

    def _end_tick(self) -> None:
        assert self._tick is not None
        self._barrier.abandon()
        self._enter(self._tick + 1)

    # --- faults, gaps --------------------------------------------------------------------------------------

    def _after_fault(self, fault: Exception) -> Estimate:
        """What follows from the last good estimate, flagged; the estimator starts anew from that at the next tick."""
        assert self._tick is not None
        self.counters["estimator faults" if isinstance(fault, ESTIMATOR_FAULTS) else "core faults"] += 1
        return self.fleet.fall_back(self._tick)

    def _leave_out_ticks(self, now_s: float) -> None:
        """Go to the tick of now; an estimator cannot jump, so it starts anew."""
        assert self._tick is not None
        tick = tick_of(now_s, self._period_s)
        self.counters["ticks: left out"] += tick - self._tick
        self._barrier.abandon()
        self.fleet.forget()
        self._enter(tick)

    # --- common --------------------------------------------------------------------------------------------

    def _evidence(self, estimate: Estimate, own: slice, now_s: float) -> TickEvidence:
        """What the monitors look at when an estimate of those who are present is out."""
        assert self._tick is not None
        started, fix_age_s, roll = self.fleet.started, self.gps_age_s(now_s), self.fleet.roll
        alone = started and gps_lost(fix_age_s, self._fix_interval_s)  # nothing but ranges can hold the position
        return TickEvidence(
            Solution(
                status=estimate.status if started else None,
                own_sigma_m=float(np.sqrt(estimate.covariance.diagonal()[own][:3].max())),
                waiting_for="" if started else "waiting for fixes",
            ),
            Ages(
                fix_age_s=fix_age_s,
                imu_coverage=0.0 if self._input is None else self._input.coverage,
                aided=self._input is None or self._input.aided,
                heard_age_s=self.neighbours.expected_ages_s(now_s),
                fix_interval_s=self._fix_interval_s,
            ),
            autopilot=self._link_state,
            geometry=roll.geometry(self._agent_id, self._tick) if alone else None,
            location=roll.own_location if alone else (),
            contradictions=self._contradictions(estimate),
            timing=self.gps_latency.timing,
            integrity=(*self.integrity.observe(estimate, self.fleet.present), *self._of_fleet()),
        )

    def _of_fleet(self) -> tuple[Finding, ...]:
        """What the fleet's estimate had to leave out or give up, about ids, ``None`` for the own drone."""
        assert self._tick is not None
        found = self.fleet.findings(self._tick)
        return tuple(replace(each, about=None) if each.about == self._agent_id else each for each in found)

    def _contradictions(self, estimate: Estimate) -> tuple[Finding, ...]:
        """Whose fixes contradict the rest, by id, ``None`` for the own ones; counted."""
        found = []
        for finding in estimate.findings:
            agent_id = None if finding.about is None else self.fleet.present[finding.about]
            self.counters[f"ticks: fixes of {agent_id} contradict"] += 1
            found.append(replace(finding, about=None if agent_id == self._agent_id else agent_id))
        return tuple(found)


def _motion(estimate: Estimate, own: slice, t_s: float) -> Motion:
    """The own velocity by an estimate."""
    north, east, down = estimate.mean[own][3:].tolist()
    a, b, c = estimate.covariance.diagonal()[own][3:].tolist()
    return Motion(t_s, (north, east, down), (a, b, c))
