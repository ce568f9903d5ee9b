"""The agent, sans-I/O: samples and packets in with a time, packets and estimates out.

The daemon drives it in real time, the simulator in lockstep in virtual time, the replay from a log; what
goes in decides what comes out, bit by bit. ``now_s`` is fleet time and never goes back.

Tick k ends at E = (k+1) T and is worked off in this order:

=============================  =================================================================
by E + guard                   close the timeline; own records and input; measurement packet out
by E + exchange                neighbours' packets of the tick in; `Estimator.begin`
by E + exchange + rounds       L consensus rounds, each until complete or its share is over
then                           `Estimator.solve`; estimate out
=============================  =================================================================

The estimate is of the tick's start k T, from all measurements nearer to it than to the next tick's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import Enum, auto

import numpy as np

from agent.config_tables import FleetConfig
from agent.frames import gravity_mps2
from agent.health import Facts, HealthMonitor
from agent.initial import Initialiser
from agent.neighbours import NeighbourTable
from agent.outputs import EstimateReady, HealthChanged, Output, Send, estimate_message
from agent.record_store import RecordStore
from agent.records import acceleration_record, gps_records, range_record
from agent.samples import AttitudeSample, GpsSample, ImuSample, RangeSample
from agent.timeline import TickInput, Timeline, tick_of
from estimators.estimator import Estimate, Estimator, Payload, SolverReport, Status
from estimators.layout import STATES_PER_AGENT, Layout, block
from estimators.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings
from transport.estimate_body import MAX_AGE_TICKS
from transport.information_body import Information
from transport.measurement_body import Measurements, Record
from transport.opening import Received
from transport.rounds import RoundBarrier

EstimatorFactory = Callable[[EstimatorSettings, Layout, int, Vector, Matrix, float], Estimator]
"""(settings, layout, own slot, prior mean, prior covariance, period in s) -> estimator."""

ESTIMATOR_FAULTS = (ArithmeticError, ValueError)
"""What broken numerics raise (numpy's LinAlgError is a ValueError): the estimator starts anew, nothing stops."""
MAX_BEHIND_TICKS = 50
"""Further behind (a suspended computer, a clock set forward), the ticks between are left out."""
MAX_MEAN = 1e6
RESTART_VARIANCE = 1.0
"""What a start from the last good estimate adds to its covariance, in m2 and (m/s)2."""


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

    def __init__(self, config: FleetConfig, agent_id: int, make_estimator: EstimatorFactory) -> None:
        self._config = config
        self._agent_id = agent_id
        self._make_estimator = make_estimator
        self._period_s = config.fleet.period_s
        self.layout = Layout(config.ids)
        self._slot = self.layout.slot(agent_id)
        self.timeline = Timeline(self._period_s, gravity_mps2(config), config.sensors)
        self.records = RecordStore(config, agent_id)
        self.neighbours = NeighbourTable(config, agent_id)
        self.health = HealthMonitor()
        self.counters: Counter[str] = Counter()
        self.last_fault: Exception | None = None
        """What the estimator raised last, for the log."""
        self.autopilot_state = "searching"
        """State of the autopilot's link, for the health; kept by the owner."""
        self._initialiser = Initialiser(config, agent_id)
        self._barrier: RoundBarrier[Payload] = RoundBarrier(max(config.estimator.rounds, 1))
        self._estimator: Estimator | None = None
        self._good: Estimate | None = None
        self._input: TickInput | None = None
        self._last_fix_s: float | None = None
        self._tick: int | None = None
        self._phase = _Phase.END
        self._round = 0

    # --- what comes in -------------------------------------------------------------------------------------

    def on_imu(self, sample: ImuSample, now_s: float) -> None:
        """An IMU sample."""
        if self._plausible("imu", sample.t_s, now_s):
            self.timeline.add_imu(sample)

    def on_attitude(self, sample: AttitudeSample, now_s: float) -> None:
        """An attitude."""
        if self._plausible("attitude", sample.t_s, now_s):
            self.timeline.add_attitude(sample)

    def on_gps(self, sample: GpsSample, now_s: float) -> None:
        """A fix."""
        if not self._plausible("gps", sample.t_s, now_s):
            return
        self._last_fix_s = now_s
        for record in gps_records(self._agent_id, sample, self._period_s, self._config.sensors):
            self._on_own_record(record)

    def on_range(self, sample: RangeSample, now_s: float) -> None:
        """A range that this agent's module measured."""
        if sample.observer != self._agent_id or sample.target not in self.layout.agents:
            self.counters["range: not ours"] += 1
        elif self._plausible("range", sample.t_s, now_s):
            self._on_own_record(range_record(sample, self._period_s, self._config.sensors))

    def on_packet(self, received: Received, now_s: float) -> None:
        """A neighbour's message, opened and checked by the transport."""
        message = received.message
        if received.sender not in self.neighbours:
            self.counters["packet: not a neighbour"] += 1
            return
        if self._tick is None:
            self._enter(tick_of(now_s, self._period_s))
        self.neighbours.on_packet(received.sender, now_s)
        if isinstance(message, Measurements):
            self._on_measurements(received.sender, message)
        elif isinstance(message, Information):
            self._on_information(received.sender, message, now_s)

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

    def _on_own_record(self, record: Record) -> None:
        rounded = self.records.add_own(record)
        if rounded is not None and self._estimator is None:
            self._initialiser.note(rounded)

    def _on_measurements(self, sender: int, message: Measurements) -> None:
        assert self._tick is not None
        self.neighbours.on_measurements(sender, message.tick)
        if message.tick < self._tick or (message.tick == self._tick and self._phase is _Phase.ROUND):
            self.counters["measurements: late"] += 1
        for record in message.records:
            if self.records.add_heard(record, self._tick) and self._estimator is None:
                self._initialiser.note(record)

    def _on_information(self, sender: int, message: Information, now_s: float) -> None:
        if message.agents != self.layout.agents:
            self.counters["information: other agents"] += 1
            return
        payload = Payload(message.state_tick, message.information, message.vector, message.rank)
        outcome = self._barrier.put(sender, message.tick, message.round, payload)
        self.counters[f"information: {outcome.name.lower()}"] += 1
        self.neighbours.on_information(sender, now_s)

    def gps_age_s(self, now_s: float) -> float | None:
        """Time since the last own fix came in; ``None`` before the first."""
        return None if self._last_fix_s is None else now_s - self._last_fix_s

    # --- the tick ------------------------------------------------------------------------------------------

    def next_due_s(self) -> float | None:
        """When `advance` has something to do even if nothing comes in; ``None`` before its first call."""
        if self._tick is None:
            return None
        if self._phase is _Phase.END:
            return self._end_s + self._config.transport.guard_s
        return self._packets_by_s if self._phase is _Phase.PACKETS else self._barrier.deadline_s

    def advance(self, now_s: float) -> list[Output]:
        """Do what is due; call it when `next_due_s` has come and after anything came in."""
        outputs: list[Output] = []
        if self._tick is None:
            self._enter(tick_of(now_s, self._period_s))
        if now_s > self._end_s + MAX_BEHIND_TICKS * self._period_s:
            self._leave_out_ticks(now_s)
        while self._step(now_s, outputs):
            pass
        return outputs

    def _step(self, now_s: float, outputs: list[Output]) -> bool:
        """The next step of the tick if it is due."""
        assert self._tick is not None
        if self._phase is _Phase.END:
            if now_s < self._end_s + self._config.transport.guard_s:
                return False
            self._close_tick(outputs)
        elif self._phase is _Phase.PACKETS:
            if now_s < self._packets_by_s and not self.neighbours.all_measured(self._tick, now_s):
                return False
            self._begin(now_s, outputs)
        else:
            if not self._barrier.done(now_s):
                return False
            self._mix(now_s, outputs)
        return True

    def _enter(self, tick: int) -> None:
        """Begin to wait for the end of a tick."""
        self._tick, self._phase = tick, _Phase.END
        self._barrier.advance(tick)

    def _close_tick(self, outputs: list[Output]) -> None:
        assert self._tick is not None
        self._input = self.timeline.close(self._tick)
        self.records.add_own(acceleration_record(self._agent_id, self._input))
        outputs.append(Send(self.records.packet(self._tick)))
        self._phase = _Phase.PACKETS

    def _begin(self, now_s: float, outputs: list[Output]) -> None:
        assert self._tick is not None
        rows, inputs = self.records.take(self._tick)
        if self._estimator is None:
            if self._good is None and not self._initialiser.ready(self._tick, now_s):
                self._finish(self._nothing(), now_s, outputs)
                return
            self._start()
            rows, inputs = rows[rows["tick"] == self._tick], inputs[:0]
        estimator = self._estimator
        assert estimator is not None
        try:
            estimator.begin(self._tick, rows, inputs)
        except ESTIMATOR_FAULTS as fault:
            self._finish(self._after_fault(fault), now_s, outputs)
            return
        self._round = 0
        self._open_round_or_solve(now_s, outputs)

    def _open_round_or_solve(self, now_s: float, outputs: list[Output]) -> None:
        assert self._estimator is not None
        assert self._tick is not None
        rounds = self._config.estimator.rounds
        if self._round >= rounds:
            self._solve(now_s, outputs)
            return
        payload = self._estimator.outgoing(self._round)
        message = Information(
            self._tick,
            self._round,
            payload.tick,
            payload.rank,
            self.layout.agents,
            payload.information,
            payload.vector,
        )
        outputs.append(Send(message))
        share_s = self._config.transport.rounds_fraction * self._period_s / rounds
        deadline_s = self._packets_by_s + (self._round + 1) * share_s
        self._barrier.open(self._tick, self._round, self.neighbours.informing(now_s), deadline_s)
        self._phase = _Phase.ROUND

    def _mix(self, now_s: float, outputs: list[Output]) -> None:
        assert self._estimator is not None
        own_tick = self._estimator.outgoing(self._round).tick
        received: dict[int, Payload] = {}
        for sender, payload in self._barrier.close().items():
            if payload.tick == own_tick:
                received[self.layout.slot(sender)] = payload
            else:  # its window is shorter, as for a few ticks after its start
                self.counters["information: other window"] += 1
        try:
            self._estimator.mix(self._round, received)
        except ESTIMATOR_FAULTS as fault:
            self._finish(self._after_fault(fault), now_s, outputs)
            return
        self._round += 1
        self._open_round_or_solve(now_s, outputs)

    def _solve(self, now_s: float, outputs: list[Output]) -> None:
        assert self._estimator is not None
        try:
            estimate = self._estimator.solve()
            if not _sound(estimate):
                raise ArithmeticError("the estimate is not finite or its covariance not positive")
            self._good = estimate
        except ESTIMATOR_FAULTS as fault:
            estimate = self._after_fault(fault)
        self._finish(estimate, now_s, outputs)

    def _finish(self, estimate: Estimate, now_s: float, outputs: list[Output]) -> None:
        assert self._tick is not None
        t_s, end_s = self._tick * self._period_s, self._end_s
        on_time = now_s <= end_s + self._period_s
        self.counters["ticks"] += 1
        self.counters["ticks: late"] += not on_time
        self.counters[f"status: {estimate.status.name.lower()}"] += 1
        outputs.append(EstimateReady(estimate, t_s, now_s, on_time))
        outputs.append(Send(estimate_message(estimate, self.layout.agents, block(self._slot))))
        changed = self.health.update(self._facts(estimate, now_s), now_s)
        if changed is not None:
            outputs.append(HealthChanged(changed))
        self._enter(self._tick + 1)

    # --- start, faults, gaps -------------------------------------------------------------------------------

    def _start(self) -> None:
        assert self._tick is not None
        if self._good is None:
            mean, covariance = self._initialiser.prior(self._tick)
        else:  # after a fault: where we were going, less sure of it
            mean = self._carried(self._good)
            covariance = self._good.covariance + RESTART_VARIANCE * np.eye(self.layout.dimension)
        settings = self._config.estimator
        self._estimator = self._make_estimator(settings, self.layout, self._slot, mean, covariance, self._period_s)
        self.counters["starts"] += 1

    def _nothing(self) -> Estimate:
        assert self._tick is not None
        mean, covariance = self._initialiser.no_data()
        ages = np.full(self.layout.size, MAX_AGE_TICKS)
        return Estimate(self._tick, mean, covariance, Status.NO_DATA, ages, SolverReport())

    def _after_fault(self, fault: Exception) -> Estimate:
        """Give what follows from the last good estimate, flagged, and start anew from that at the next tick."""
        assert self._tick is not None
        self.counters["estimator faults"] += 1
        self.last_fault = fault
        self._restart()
        if self._good is None:
            return self._nothing()
        good = self._good
        covariance = good.covariance + RESTART_VARIANCE * np.eye(self.layout.dimension)
        mean = self._carried(good)
        return Estimate(self._tick, mean, covariance, Status.FELL_BACK, good.age_ticks, SolverReport())

    def _carried(self, good: Estimate) -> Vector:
        """The mean ``(6n,)`` of an earlier estimate, moved on to this tick at its velocities."""
        assert self._tick is not None
        states = good.mean.reshape(-1, STATES_PER_AGENT).copy()
        states[:, :3] += (self._tick - good.tick) * self._period_s * states[:, 3:]
        return np.asarray(states.ravel())

    def _restart(self) -> None:
        self._estimator = None
        self._initialiser = Initialiser(self._config, self._agent_id)

    def _leave_out_ticks(self, now_s: float) -> None:
        """Go to the tick of now; an estimator cannot jump, so it starts anew."""
        assert self._tick is not None
        tick = tick_of(now_s, self._period_s)
        self.counters["ticks: left out"] += tick - self._tick
        if self._phase is _Phase.ROUND:
            self._barrier.close()
        self._restart()
        self._good = None
        self._enter(tick)

    # --- common --------------------------------------------------------------------------------------------

    @property
    def _end_s(self) -> float:
        assert self._tick is not None
        return (self._tick + 1) * self._period_s

    @property
    def _packets_by_s(self) -> float:
        return self._end_s + self._config.transport.exchange_fraction * self._period_s

    def _facts(self, estimate: Estimate, now_s: float) -> Facts:
        started = self._estimator is not None
        own = estimate.covariance.diagonal()[block(self._slot)][:3]
        return Facts(
            status=estimate.status if started or self._good is not None else None,
            own_sigma_m=float(np.sqrt(own.max())),
            gps_age_s=self.gps_age_s(now_s),
            imu_coverage=0.0 if self._input is None else self._input.coverage,
            silent_neighbours=self.neighbours.silent(now_s),
            autopilot=self.autopilot_state,
            waiting_for="" if started else "waiting for fixes",
        )


def _sound(estimate: Estimate) -> bool:
    """Whether an estimate is fit to leave the house, whatever its estimator promised."""
    diagonal = estimate.covariance.diagonal()
    return bool(
        np.isfinite(estimate.covariance).all() and (np.abs(estimate.mean) <= MAX_MEAN).all() and (diagonal > 0).all()
    )
