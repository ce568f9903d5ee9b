"""A fleet larger than a joint state: everybody is shown, what is far with its age, and nothing goes too far."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.estimator import Estimate
from estimators.factory import make_estimator
from fleetloc.bench.scale_flights import ScaleFlight, configured
from sim_bridge.virtual.fleet_events import FleetEvents
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, Surroundings
from sim_bridge.world.scenario import Interval
from transport.messages.far_body import FarReports
from transport.messages.header import MAX_DATAGRAM_BYTES
from transport.messages.measurement_body import Measurements
from transport.security.sealing import Message

SIZE, JOINT, SEED = 9, 4, 3
FLIGHT_S, SETTLED_S = 10.0, 4.0
AWAY, AWAY_S, ABSENT_AFTER_S = 9, 6.0, 1.5


@dataclass
class Flown:
    """What the agents of the flight said: of each tick, and on the air."""

    config: FleetConfig
    estimates: list[tuple[float, int, Estimate, tuple[int, ...], np.ndarray[Any, Any]]] = field(default_factory=list)
    """Seconds since the start, agent, estimate, its members, the truth ``(n, 6)``."""
    sent: list[tuple[int, Message, int]] = field(default_factory=list)

    def on_sent(self, sender: int, message: Message, size_bytes: int) -> None:
        self.sent.append((sender, message, size_bytes))

    def on_heard(self, receiver: int, sent: Any) -> None:
        pass

    def between(self, from_s: float, to_s: float) -> list[tuple[int, Estimate, tuple[int, ...], Any]]:
        return [rest for t_s, *rest in self.estimates if from_s <= t_s < to_s]  # type: ignore[misc]


@pytest.fixture(scope="module")
def flown() -> Flown:
    config = configured(ScaleFlight(SIZE, SEED, JOINT, FLIGHT_S, 0.0, 3.0, 1))
    fleet = msgspec.structs.replace(config.fleet, absent_after_s=ABSENT_AFTER_S)
    config = msgspec.structs.replace(config, fleet=fleet)
    run, said = Flown(config), []

    def on_estimate(agent: OnboardAgent, ready: EstimateReady) -> None:
        said.append((ready, agent.agent_id, agent.core.fleet.present))

    events = FleetEvents(away=(Interval(AWAY, AWAY_S, 2 * FLIGHT_S),))
    lockstep = FleetLockstep(config, make_estimator, on_estimate, surroundings=Surroundings(events=events, tap=run))
    report = lockstep.run(FLIGHT_S)
    for ready, agent_id, present in said:
        unix_s = ready.t_s + config.fleet.epoch_unix_s
        if unix_s <= report.truth.time_unix_s[-1]:
            truth = report.truth.at(np.array([unix_s]))[0]
            run.estimates.append((unix_s - report.start_unix_s, agent_id, ready.estimate, present, truth))
    return run


def test_a_joint_state_holds_its_drone_and_who_is_near_and_no_more(flown: Flown) -> None:
    config = flown.config
    for agent_id, _, present, _ in flown.between(SETTLED_S, AWAY_S):
        hops = {agent_id} | set(config.neighbours(agent_id))
        hops |= {other for near in config.neighbours(agent_id) for other in config.neighbours(near)}
        assert agent_id in present
        assert 2 <= len(present) <= JOINT
        assert set(present) <= hops


def test_an_estimate_speaks_of_everybody_and_says_how_old_it_is(flown: Flown) -> None:
    far_ages = []
    for _, estimate, present, _ in flown.between(SETTLED_S, AWAY_S):
        assert not is_absent(estimate.age_ticks).any()
        beyond = [slot for slot, agent in enumerate(flown.config.ids) if agent not in present]
        assert len(beyond) == SIZE - len(present)
        far_ages += estimate.age_ticks[beyond].tolist()
    # reports are a second apart and take a tick or two a hop
    assert 0 < np.mean(far_ages) < 10
    assert max(far_ages) < 20


def test_what_is_said_of_far_drones_is_as_sure_as_it_is_right(flown: Flown) -> None:
    squares, spreads = [], {True: [], False: []}
    for _, estimate, present, truth in flown.between(SETTLED_S, AWAY_S):
        variances = estimate.covariance.diagonal().reshape(-1, 6)
        error = estimate.mean.reshape(-1, 6) - truth
        for slot, agent in enumerate(flown.config.ids):
            spreads[agent in present].append(float(np.sqrt(variances[slot, :3].sum())))
            if agent not in present:
                squares.append((error[slot] ** 2 / variances[slot]).mean())
    assert 0.02 < np.mean(squares) < 2.0
    assert np.mean(spreads[False]) > 1.5 * np.mean(spreads[True])


def test_a_drone_that_left_is_absent_everywhere_near_and_far(flown: Flown) -> None:
    slot = flown.config.ids.index(AWAY)
    last = flown.between(AWAY_S + 2 * ABSENT_AFTER_S, FLIGHT_S)
    assert {agent_id for agent_id, *_ in last} == set(flown.config.ids) - {AWAY}
    for _, estimate, _, _ in last:
        assert is_absent(estimate.age_ticks)[slot]
        assert not np.delete(is_absent(estimate.age_ticks), slot).any()


def test_no_measurement_goes_farther_than_two_hops_and_no_packet_is_larger_than_a_datagram(flown: Flown) -> None:
    config, reports = flown.config, 0
    for sender, message, size_bytes in flown.sent:
        if isinstance(message, Measurements):
            assert {record.observer for record in message.records} <= {sender, *config.neighbours(sender)}
        reports += len(message.reports) if isinstance(message, FarReports) else 0
        assert size_bytes <= MAX_DATAGRAM_BYTES
    # everybody passes everybody's report on once a second
    assert 0.7 * SIZE**2 * FLIGHT_S < reports < SIZE**2 * FLIGHT_S
