"""The estimator of an agent through start, change of the fleet, and fault; it never stops, it only says less.

The estimator works on the drones that are present (`agent.fleet.membership.Membership`). What leaves the house is in
the layout of the whole configured fleet: an absent drone's block is at zero with a variance of 1e8 and the age
"never" (`agent.fleet.membership.is_absent`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.fix_tracks import POSITION_SIGMA_M, VELOCITY_SIGMA_MPS
from agent.fleet.joint_choice import JointChoice
from agent.fleet.measurement_store import MeasurementStore
from agent.fleet.membership import Membership
from agent.fleet.sieve import Sieve
from agent.watch.integrity_watch import IntegrityWatch
from estimators.consensus.mapping import mapped_path, mapped_payload
from estimators.estimator import Estimate, Estimator, Payload, SolverReport, Status
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.innovations import Innovations
from estimators.integrity.range_geometry import GeometryMonitor
from estimators.integrity.thresholds import BEGUN_ANEW_TOLD_S, FAULTS_IN_A_ROW
from estimators.model.gaussian import Prior
from estimators.model.layout import STATES_PER_AGENT, Layout, block, states_of
from estimators.model.measurements import InputTable, Matrix, Vector, empty_inputs, input_rows
from estimators.model.unknown_motion import unseen_variance
from estimators.settings import EstimatorSettings
from estimators.systematic.range_biases import RangeBiases
from transport.messages.estimate_body import MAX_AGE_TICKS
from transport.messages.information_body import Information
from transport.messages.measurement_body import Measurement
from transport.messages.window_body import WindowStates

EstimatorFactory = Callable[[EstimatorSettings, Layout, int, Vector, Matrix, float], Estimator]
"""(settings, layout, own slot, prior mean, prior covariance, period in s) -> estimator."""

ESTIMATOR_FAULTS = (ArithmeticError, ValueError)
"""What broken numerics raise (numpy's LinAlgError is a ValueError): the estimator starts anew, nothing stops."""
MAX_MEAN = 1e6
MAX_WAIT_S = 2.0
"""Without own fixes an agent starts among the others after this long, its own place not observable yet."""
RESTART_VARIANCE = 1.0
"""What a start from the last good estimate adds to its covariance, in m2 and (m/s)2."""
ABSENT_VARIANCE = 1e8
"""Of a drone that is no part of the estimate, and of all before the start."""


@dataclass(frozen=True, slots=True)
class _Good:
    """An estimate to go on from, and who was in it."""

    estimate: Estimate
    members: tuple[int, ...]
    own_located: bool


class FleetTracker:
    """Runs one agent's estimator tick by tick; raises `ESTIMATOR_FAULTS` from `begin`, `mix` and `solve`.

    ``counters`` is where it counts starts, joins, leaves, refused pairs, and moves of the estimate; ``integrity``
    sees the rows before the estimator does.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        make_estimator: EstimatorFactory,
        counters: Counter[str],
        integrity: IntegrityWatch,
    ) -> None:
        self._config = config
        self._agent_id = agent_id
        self._make_estimator = make_estimator
        self._counters = counters
        self._integrity = integrity
        self._period_s = config.fleet.period_s
        self._estimator: Estimator | None = None
        self._good: _Good | None = None
        self._since_s: float | None = None
        self._faults = 0
        """In a row."""
        self._sieve = Sieve(agent_id, self._period_s, counters)
        self._anew: tuple[int, str] | None = None
        """When and why the estimate was begun from nothing last."""
        self.roll = Membership(config, agent_id)
        self._choice = JointChoice(config, agent_id)
        self.present: tuple[int, ...] = ()
        """Whom the latest estimate speaks of, in the order of its blocks."""
        self.innovations: Innovations | None = None
        """Of the latest estimate, in the same order."""
        self.range_biases: RangeBiases | None = None
        """Likewise."""

    @property
    def started(self) -> bool:
        """Whether there is an estimate, or was one to go on from."""
        return self._estimator is not None or self._good is not None

    @property
    def dropped(self) -> int:
        """Rows and inputs that came too late for the estimator's window."""
        return 0 if self._estimator is None else self._estimator.dropped

    def findings(self, tick: int) -> tuple[Finding, ...]:
        """Who measured what cannot be, by id; and whether the estimate was begun anew of late."""
        found = tuple(replace(each, detail=_measured_by(each.about, self._agent_id)) for each in self._sieve.findings)
        if self._anew is None or tick - self._anew[0] > BEGUN_ANEW_TOLD_S / self._period_s:
            return found
        return (*found, Finding(What.BEGUN_ANEW, Gravity.ALARM, self._agent_id, detail=self._anew[1]))

    def note(self, record: Measurement, tick: int) -> None:
        """A record, own or heard, at the current tick."""
        self.roll.note(record, tick)

    # --- the tick ------------------------------------------------------------------------------------------

    def begin(self, tick: int, now_s: float, records: MeasurementStore) -> bool:
        """Let the fleet change and open the tick; false while nobody is located."""
        self.roll.wanted = self._choice.choose(tick, records.neighbourhood)
        if self.roll.wanted is not None:
            records.let_go_beyond(self.roll.wanted)
        lost = self._lost(tick)
        if self._agent_id in lost:
            self._begin_anew(tick, "against its own fixes")
        if self._estimator is None:
            if not self._start(tick, now_s):
                records.forget(tick)
                return False
            rows, inputs = records.take(tick, self.roll.members, self.roll.usable(tick))
            rows, inputs = self._sieve.passed(tick, self.roll.members, rows[rows["tick"] == tick], inputs[:0])
        else:
            self._change(tick, lost)
            rows, inputs = records.take(tick, self.roll.members, self.roll.usable(tick))
            rows, inputs = self._sieve.passed(tick, self.roll.members, rows, inputs)
            unseen = self._unseen_manoeuvres(tick)
            if len(unseen):
                inputs = np.concatenate((inputs, unseen))
        assert self._estimator is not None
        self._estimator.begin(tick, self._integrity.take(tick, self.roll.members, rows), inputs)
        return True

    def outgoing(self, tick: int, round_: int) -> Information | WindowStates:
        """What neighbours get in a round."""
        assert self._estimator is not None
        payload = self._estimator.outgoing(round_)
        if payload.path is not None:
            return WindowStates(tick, round_, payload.tick, payload.degree, self.roll.members, payload.path)
        return Information(
            tick, round_, payload.tick, payload.rank, self.roll.members, payload.information, payload.vector
        )

    def mix(self, round_: int, received: Mapping[int, Information | WindowStates]) -> None:
        """One round with what neighbours sent, by sender."""
        assert self._estimator is not None
        own = self._estimator.outgoing(round_)
        centre: Vector | None = None
        pairs: dict[int, Payload] = {}
        for sender, message in received.items():
            if message.agents != self.roll.members:
                self._counters["information: other members"] += 1
                if isinstance(message, WindowStates):
                    self.roll.note_window(message)
                else:
                    self.roll.note_pair(message)
            if message.state_tick != own.tick:  # its window is shorter, as for a few ticks after its start
                self._counters["information: other window"] += 1
            elif sender not in self.roll.members:
                self._counters["information: not located"] += 1
            else:
                slot = self.roll.members.index(sender)
                if isinstance(message, WindowStates):
                    path = mapped_path(message.path, message.agents, self.roll.members, own)
                    pairs[slot] = Payload.of_path(message.state_tick, path, message.degree)
                    continue
                pair = Payload(message.state_tick, message.information, message.vector, message.rank)
                if message.agents != self.roll.members and own.path is None:
                    if centre is None:
                        centre = np.asarray(np.linalg.solve(own.information, own.vector), np.float64)
                    pair = mapped_payload(pair, message.agents, self.roll.members, centre)
                pairs[slot] = pair
        for slot in self._estimator.mix(round_, pairs):
            self._counters[f"information: refused of {self.roll.members[slot]}"] += 1

    def solve(self) -> Estimate:
        """The estimate of the tick, over the members."""
        assert self._estimator is not None
        estimate = self._estimator.solve()
        if not _sound(estimate):
            raise ArithmeticError("the estimate is not finite or its covariance not positive")
        self._counters["estimate moved"] += estimate.report.moves
        self._faults = 0
        self._good = _Good(estimate, self.roll.members, self.roll.own_located)
        self._sieve.note(estimate, self.roll.members)
        self.present, self.innovations = self.roll.members, estimate.innovations
        self.range_biases = estimate.range_biases
        self.roll.note_estimate(estimate)
        if not self.roll.own_located and estimate.status in (Status.OK, Status.NOT_CONVERGED, Status.NO_DATA):
            estimate = replace(estimate, status=Status.NOT_OBSERVABLE)
        return estimate

    def nothing(self, tick: int) -> Estimate:
        """The estimate of the own drone before the start: nothing known, and saying so."""
        covariance = ABSENT_VARIANCE * np.eye(STATES_PER_AGENT)
        age = np.array([MAX_AGE_TICKS])
        self.present, self.innovations, self.range_biases = (self._agent_id,), None, None
        return Estimate(tick, np.zeros(STATES_PER_AGENT), covariance, Status.NO_DATA, age, SolverReport())

    def fall_back(self, tick: int) -> Estimate:
        """After a fault: what follows from the last good estimate, flagged; the next tick starts from there.

        After `FAULTS_IN_A_ROW` it is no use any more: then from nothing but what sensors say.
        """
        self._estimator = None
        self._faults += 1
        if self._good is not None and self._faults >= FAULTS_IN_A_ROW:
            self._begin_anew(tick, f"after {self._faults} faults in a row")
        if self._good is None:
            self.forget()
            return self.nothing(tick)
        good = self._good
        self.present, self.innovations, self.range_biases = good.members, None, None
        self.roll.return_to(good.members, own_located=good.own_located)
        mean, covariance = self._carried(good.estimate, tick)
        return Estimate(tick, mean, covariance, Status.FELL_BACK, good.estimate.age_ticks, SolverReport())

    def forget(self) -> None:
        """Begin from nothing."""
        self._estimator, self._good, self._since_s, self._faults = None, None, None, 0
        self._sieve.forget()
        self.roll = Membership(self._config, self._agent_id)

    def _begin_anew(self, tick: int, why: str) -> None:
        """Give the estimate up, and say so."""
        self._counters["begun anew"] += 1
        self._anew = tick, why
        self.forget()

    def _lost(self, tick: int) -> tuple[int, ...]:
        """Members whose every fix is out of reach of the estimate, and whom no ranges hold where it has them."""
        held = GeometryMonitor()
        return tuple(a for a in self._sieve.shut_out() if held.observe(self.roll.geometry(a, tick)))

    # --- start and change ----------------------------------------------------------------------------------

    def _start(self, tick: int, now_s: float) -> bool:
        """Make an estimator, of those who are located or were there before a fault."""
        fresh = self._first_priors(tick, now_s) if self._good is None else self.roll.newcomers(tick, tick)
        if self._good is None and not fresh:
            return False
        blocks: dict[int, Prior] = {}
        if self._good is not None:  # after a fault: where they were going, less sure of it
            mean, covariance = self._carried(self._good.estimate, tick)
            for slot, agent in enumerate(self.roll.members):
                blocks[agent] = mean[block(slot)], covariance[block(slot), block(slot)]
        self.roll.enter(fresh, (), tick)
        blocks |= fresh
        layout = Layout.of(self.roll.members, self._config.kinds)
        mean, covariance = np.zeros(layout.dimension), np.zeros((layout.dimension, layout.dimension))
        for slot, agent in enumerate(layout.agents):
            own = block(slot)
            mean[own], covariance[own, own] = blocks[agent] if agent in blocks else self._unlocated(fresh)
        self._estimator = self._make_estimator(
            self._config.estimator, layout, layout.slot(self._agent_id), mean, covariance, self._period_s
        )
        self._counters["starts"] += 1
        return True

    def _first_priors(self, tick: int, now_s: float) -> dict[int, Prior]:
        """Priors to begin with, empty while there is a reason to wait."""
        initial = self._config.initial
        if self._since_s is None:
            self._since_s = now_s
        if initial.position_m is not None and self._anew is None:  # anew from what sensors say alone
            sigma = [POSITION_SIGMA_M] * 3 + [VELOCITY_SIGMA_MPS] * 3
            mean = np.array([*initial.position_m, 0.0, 0.0, 0.0])
            chosen = filter(self.roll.may_be_member, self._config.ids)
            return {agent: (mean, np.diag(np.square(sigma))) for agent in chosen}
        found = self.roll.newcomers(tick, tick)
        waited = now_s - self._since_s >= MAX_WAIT_S
        return found if self._agent_id in found or waited else {}

    def _unlocated(self, others: Mapping[int, Prior]) -> Prior:
        """The own block while nothing says where it is: amid the others, as wide as can be."""
        mean = np.mean([prior[0] for prior in others.values()], axis=0)
        mean[3:] = 0.0
        variance = [(2.0 * POSITION_SIGMA_M) ** 2] * 3 + [VELOCITY_SIGMA_MPS**2] * 3
        return mean, np.diag(variance)

    def _change(self, tick: int, lost: tuple[int, ...]) -> None:
        """Take in who has been located since the last tick, let go who is gone or ``lost``."""
        assert self._estimator is not None
        if self._estimator.fixed_members:
            return
        fresh = self.roll.newcomers(tick, self._estimator.prior_tick)
        gone = tuple(dict.fromkeys((*self.roll.gone(tick), *(a for a in lost if a in self.roll.members))))
        if not fresh and not gone:
            return
        self._counters["drones joined"] += len(fresh)
        self._counters["drones gone"] += len(gone)
        self.roll.enter(fresh, gone, tick)
        self._estimator.change_members(self.roll.members, self._agent_id, fresh, self._config.kinds)

    def _unseen_manoeuvres(self, tick: int) -> InputTable:
        """Accelerations, unknown, of drones silent for so long that none will come any more.

        They go to every other tick, for two, lest the estimator learn from them how steady an acceleration is.
        """
        tables = []
        settings = self._config.estimator
        for slot, agent in enumerate(self.roll.members if tick % 2 == 0 else ()):
            silent = self.roll.silent_ticks(agent, tick)
            if silent > settings.window and agent not in self._config.kinds:
                variance = unseen_variance(silent, settings.other_accel_variance, self._period_s)
                tables.append(input_rows(tick - 1, slot, np.zeros(3), 2.0 * variance))
        return np.concatenate(tables) if tables else empty_inputs()

    def _carried(self, good: Estimate, tick: int) -> Prior:
        """An earlier estimate of the members, moved on to this tick at its velocities, less sure of it."""
        states = good.mean.reshape(-1, STATES_PER_AGENT).copy()
        states[:, :3] += (tick - good.tick) * self._period_s * states[:, 3:]
        return states.ravel(), good.covariance + RESTART_VARIANCE * np.eye(len(good.mean))


def in_layout(estimate: Estimate, members: tuple[int, ...], layout: Layout) -> Estimate:
    """An estimate of some drones in the layout of the whole fleet, the absent ones as the module's text says."""
    told = np.minimum(estimate.age_ticks, MAX_AGE_TICKS - 1)
    if members == layout.agents:
        return replace(estimate, age_ticks=told)
    at = states_of([layout.slot(agent) for agent in members])
    mean = np.zeros(layout.dimension)
    covariance = np.zeros((layout.dimension, layout.dimension))
    np.fill_diagonal(covariance, ABSENT_VARIANCE)
    ages = np.full(layout.size, MAX_AGE_TICKS)
    mean[at] = estimate.mean
    covariance[np.ix_(at, at)] = estimate.covariance
    ages[[layout.slot(agent) for agent in members]] = told
    return replace(estimate, mean=mean, covariance=covariance, age_ticks=ages)


def _measured_by(agent_id: int | None, own_id: int) -> str:
    return "own measurements" if agent_id == own_id else f"measurements of {agent_id}"


def _sound(estimate: Estimate) -> bool:
    """Whether an estimate is fit to leave the house, whatever its estimator promised."""
    diagonal = estimate.covariance.diagonal()
    return bool(
        np.isfinite(estimate.covariance).all() and (np.abs(estimate.mean) <= MAX_MEAN).all() and (diagonal > 0).all()
    )
