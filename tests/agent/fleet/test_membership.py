"""Who is part of an agent's estimate: located, told of, silent, held, let go; and faults while it changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent.config.tables import FleetConfig
from agent.fleet.measurement_store import MeasurementStore
from agent.fleet.membership import Membership, is_absent
from agent.fleet.tracking import ABSENT_VARIANCE, FleetTracker, in_layout
from agent.watch.integrity_watch import IntegrityWatch
from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.integrity.finding import What, has
from estimators.integrity.range_geometry import GeometryMonitor
from estimators.model.layout import Layout
from transport.messages.information_body import Information
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    Measurement,
    PositionMeasurement,
    RangeMeasurement,
)

MakeConfig = Callable[..., FleetConfig]
AWAY = np.array([[0.0, 0.0, -5.0], [9.0, 0.0, -6.0], [0.0, 8.0, -4.0], [7.0, 7.0, -12.0], [-6.0, 2.0, -9.0]])
"""Where drones 1 to 5 hover."""


def fix(agent: int, tick: int) -> PositionMeasurement:
    north, east, down = AWAY[agent - 1]
    return PositionMeasurement(agent, tick, (north, east, down), (0.01, 0.01, 0.01))


def still(agent: int, tick: int) -> AccelerationMeasurement:
    return AccelerationMeasurement(agent, tick, (0.0, 0.0, 0.0), (0.003, 0.003, 0.003))


def ranged(observer: int, other: int, tick: int) -> RangeMeasurement:
    distance = float(np.linalg.norm(AWAY[observer - 1] - AWAY[other - 1]))
    return RangeMeasurement(observer, tick, other, distance, 0.003)


class Agent:
    """Drone 1's tracker, fed with records by tick, without neighbours' pairs."""

    def __init__(self, config: FleetConfig) -> None:
        self.store = MeasurementStore(config, 1)
        self.counters: Counter[str] = Counter()
        self.tracker = FleetTracker(config, 1, make_estimator, self.counters, IntegrityWatch(config, 1))
        self.config = config
        self.tick = 0

    def feed(self, record: Measurement) -> None:
        self.store.neighbourhood.hear(record.observer, self.tick)
        if record.observer == 1:
            taken: Measurement | None = self.store.add_own(record)
        else:
            taken = record if self.store.add_heard(record.observer, [record], self.tick) else None
        if taken is not None:
            self.tracker.note(taken, self.tick)

    def run(self, ticks: int, heard: tuple[int, ...], ranges: tuple[tuple[int, int], ...] = ()) -> list[Estimate]:
        estimates = []
        for _ in range(ticks):
            self.tick += 1
            for agent in heard:
                self.feed(fix(agent, self.tick))
                self.feed(still(agent, self.tick))
            if 1 not in heard:
                self.feed(still(1, self.tick))
            for observer, other in ranges:
                self.feed(ranged(observer, other, self.tick))
            if self.tracker.begin(self.tick, 0.1 * self.tick, self.store):
                estimates.append(self.tracker.solve())
        return estimates

    @property
    def members(self) -> tuple[int, ...]:
        return self.tracker.roll.members


@pytest.fixture
def agent(make_config: MakeConfig) -> Agent:
    overrides = ("estimator.kind=dmhe_shared", "estimator.window=3", "fleet.absent_after_s=3.0", "estimator.rounds=0")
    return Agent(make_config(5, *overrides))


def test_drones_join_with_their_fixes_and_go_with_their_silence(agent: Agent) -> None:
    agent.run(20, heard=(1, 2))
    assert agent.members == (1, 2)
    agent.run(20, heard=(1, 2, 3))
    assert agent.members == (1, 2, 3)
    agent.run(29, heard=(1, 2))
    assert agent.members == (1, 2, 3)
    agent.run(4, heard=(1, 2))
    assert agent.members == (1, 2)
    assert (agent.counters["drones joined"], agent.counters["drones gone"], agent.counters["starts"]) == (1, 1, 1)


def test_a_range_to_a_drone_that_is_not_located_waits(agent: Agent) -> None:
    last = agent.run(25, heard=(1,), ranges=((1, 4),))[-1]
    assert agent.members == (1,)
    assert last.status is Status.OK
    assert agent.store.refused["not located"] > 10


def test_three_heard_drones_hold_a_silent_one_and_two_do_not(agent: Agent) -> None:
    agent.run(20, heard=(1, 2, 3, 4, 5))
    across = tuple((observer, 5) for observer in (1, 2, 3, 4))
    last = agent.run(60, heard=(1, 2, 3, 4), ranges=across)[-1]
    assert agent.members == (1, 2, 3, 4, 5)
    assert np.linalg.norm(last.mean[24:27] - AWAY[4]) < 0.3
    # (for some seconds the memory of the other ranges still leaves one place)
    agent.run(100, heard=(1, 2, 3, 4), ranges=across[:2])
    assert agent.members == (1, 2, 3, 4)


def test_a_drone_without_fixes_is_found_by_ranges_to_four(agent: Agent) -> None:
    # GIVEN an own drone without GPS amid located ones: not observable, its ranges unused, until they leave one place
    agent.tick = 100
    anchors = (2, 3, 4, 5)
    nothing = agent.run(25, heard=anchors)
    assert {estimate.status for estimate in nothing} == {Status.NOT_OBSERVABLE}
    assert not agent.tracker.roll.own_located
    found = agent.run(25, heard=anchors, ranges=tuple((1, other) for other in anchors))
    assert agent.tracker.roll.own_located
    assert found[-1].status is Status.OK
    assert np.linalg.norm(found[-1].mean[:3] - AWAY[0]) < 0.5
    held = agent.tracker.roll.geometry(1, agent.tick)
    assert len(held.recent) == 4
    assert GeometryMonitor().observe(held) == ()


def test_two_places_are_not_chosen_between(agent: Agent) -> None:
    agent.tick = 100
    anchors = (2, 3, 4)  # three at rest: the own place and its mirror image
    last = agent.run(60, heard=anchors, ranges=tuple((1, other) for other in anchors))[-1]
    assert last.status is Status.NOT_OBSERVABLE
    assert has(agent.tracker.roll.own_location, What.AMBIGUOUS)
    assert last.covariance[0, 0] > 50.0**2


def test_a_joint_state_with_little_room_follows_who_is_near(make_config: MakeConfig) -> None:
    # GIVEN room for three of five, and drones 2 and 3 that range drone 1
    overrides = ("estimator.kind=dmhe_shared", "estimator.rounds=0", "fleet.joint_bodies=3")
    agent = Agent(make_config(5, *overrides))
    agent.run(25, heard=(1, 2, 3), ranges=((1, 2), (1, 3), (2, 3)))
    assert agent.members == (1, 2, 3)
    # WHEN drone 4 comes, which is no nearer: nothing changes, and what it says is let go
    agent.run(25, heard=(1, 2, 3, 4), ranges=((1, 2), (1, 3), (2, 3), (1, 4)))
    assert agent.members == (1, 2, 3)
    assert agent.store.refused["beyond the joint state"] > 20
    # WHEN drone 3 is out of reach for longer than a link is remembered
    moved = agent.run(80, heard=(1, 2, 4), ranges=((1, 2), (1, 4), (2, 4)))
    # THEN drone 4 is in in its place, at its own, without a start anew
    assert agent.members == (1, 2, 4)
    assert agent.counters["starts"] == 1
    for slot, member in enumerate(agent.members):
        error = moved[-1].mean[6 * slot : 6 * slot + 3] - AWAY[member - 1]
        sigma = np.sqrt(moved[-1].covariance.diagonal()[6 * slot : 6 * slot + 3])
        assert (np.abs(error) < 5.0 * sigma).all()
        assert np.linalg.norm(error) < 0.3
    assert {estimate.status for estimate in moved} == {Status.OK}


def pair(agents: tuple[int, ...], sigma_m: float, tick: int = 5) -> Information:
    mean = np.concatenate([[*AWAY[a - 1], 0.0, 0.0, 0.0] for a in agents])
    information = np.eye(len(mean)) / sigma_m**2
    return Information(tick, 0, tick, 6, agents, information, information @ mean)


def test_a_pair_tells_of_drones_out_of_reach_if_it_knows_them_well(make_config: MakeConfig) -> None:
    roll = Membership(make_config(3), 1)
    roll.note_pair(pair((2, 3), 4.0))
    assert roll.newcomers(6, 6) == {}
    roll.note_pair(pair((2, 3), 0.5))
    found = roll.newcomers(6, 6)
    assert sorted(found) == [2, 3]
    assert found[3][0][:3] == pytest.approx(AWAY[2])
    assert found[3][1][0, 0] == pytest.approx(50.0**2)
    # one that was heard in records is located by them, or lost with them
    roll.note(fix(3, 6), 6)
    roll.note_pair(pair((2, 3), 0.5))
    assert sorted(roll.newcomers(7, 7)) == [2]


def test_a_drone_whose_accelerations_alone_come_this_far_is_told_of_by_pairs(make_config: MakeConfig) -> None:
    roll = Membership(make_config(3), 1)
    roll.note(still(3, 6), 6)
    roll.note_pair(pair((2, 3), 0.5))
    assert sorted(roll.newcomers(7, 7)) == [2, 3]


def test_who_is_known_from_pairs_alone_goes_when_they_keep_it_no_surer_than_silence(make_config: MakeConfig) -> None:
    roll = Membership(make_config(3), 1)
    roll.enter((1, 3), (), 0)
    for sigma_m, gone in ((0.5, ()), (6.0, (3,))):
        covariance = np.diag(np.repeat([0.01, sigma_m**2], 6))
        roll.note_estimate(Estimate(120, np.zeros(12), covariance, Status.OK, np.zeros(2, np.int64)))
        assert roll.gone(120) == gone
    assert roll.gone(90) == ()


def test_a_fault_while_the_fleet_changes_leaves_who_was_there(make_config: MakeConfig) -> None:
    # GIVEN an estimator that fails at the tick at which drone 3 joins
    broken: list[int] = []

    agent = Agent(make_config(3, "estimator.kind=dmhe_shared", "estimator.window=3", "estimator.rounds=0"))
    agent.run(20, heard=(1, 2))
    original = agent.store.take

    def failing(tick: int, members: Any, located: Any) -> Any:
        if 3 in members and not broken:
            broken.append(tick)
            raise np.linalg.LinAlgError("singular")
        return original(tick, members, located)

    agent.store.take = failing  # type: ignore[method-assign]
    with pytest.raises(np.linalg.LinAlgError):
        agent.run(30, heard=(1, 2, 3))
    # THEN what is given speaks of who was there, and the next tick goes on with whom is located
    fallen = agent.tracker.fall_back(agent.tick)
    assert (fallen.status, agent.tracker.present, len(fallen.mean)) == (Status.FELL_BACK, (1, 2), 12)
    after = agent.run(10, heard=(1, 2, 3))
    assert agent.tracker.present == (1, 2, 3)
    assert len(after) == 10
    assert np.linalg.norm(after[-1].mean[:3] - AWAY[0]) < 0.1


def test_the_layout_of_the_whole_fleet_says_who_is_absent() -> None:
    estimate = Estimate(7, np.arange(12.0), np.diag(np.arange(1.0, 13.0)), Status.OK, np.array([0, 70_000]))
    full = in_layout(estimate, (2, 4), Layout((1, 2, 3, 4)))
    assert is_absent(full.age_ticks).tolist() == [True, False, True, False]
    assert full.mean[6:12].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert full.covariance.diagonal()[18:].tolist() == [7.0, 8.0, 9.0, 10.0, 11.0, 12.0]
    assert (full.covariance.diagonal()[:6] == ABSENT_VARIANCE).all()
    # AND with all of them there nobody counts as absent, however long nothing was heard
    whole = in_layout(estimate, (2, 4), Layout((2, 4)))
    assert not is_absent(whole.age_ticks).any()
    assert whole.mean.tolist() == estimate.mean.tolist()
    assert whole.covariance.tolist() == estimate.covariance.tolist()
