"""Whom a drone of a large fleet takes into its joint state, whose records it uses, and how far records go."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import pytest

from agent.config.tables import FleetConfig
from agent.fleet.joint_choice import JointChoice
from agent.fleet.measurement_store import MeasurementStore
from agent.fleet.neighbourhood import Neighbourhood
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    Measurement,
    PositionMeasurement,
    RangeMeasurement,
)

MakeConfig = Callable[..., FleetConfig]
ONES = (1.0, 1.0, 1.0)
FORGOTTEN_TICKS = 100


def ranged(observer: int, other: int, tick: int) -> RangeMeasurement:
    return RangeMeasurement(observer, tick, other, 10.0, 0.01)


def fix(agent: int, tick: int) -> PositionMeasurement:
    return PositionMeasurement(agent, tick, ONES, ONES)


def still(agent: int, tick: int) -> AccelerationMeasurement:
    return AccelerationMeasurement(agent, tick, (0.0, 0.0, 0.0), ONES)


class Drone:
    """Drone 1 of a fleet without configured edges; what it hears and sees, tick by tick."""

    def __init__(self, config: FleetConfig) -> None:
        self.hood = Neighbourhood(config, 1)
        self.choice = JointChoice(config, 1)

    def sees(self, tick: int, heard: Iterable[int], links: Iterable[tuple[int, int]]) -> list[int]:
        for agent in heard:
            self.hood.hear(agent, tick)
        for one, other in links:
            self.hood.note(ranged(one, other, tick))
        chosen = self.choice.choose(tick, self.hood)
        assert chosen is not None
        return sorted(chosen)


def drone(make_config: MakeConfig, agents: int, joint: int) -> Drone:
    return Drone(make_config(agents, f"fleet.joint_bodies={joint}", "estimator.relay_hops=2"))


# --- who is in ----------------------------------------------------------------------------------------------------


def test_a_fleet_that_fits_is_taken_whole(make_config: MakeConfig) -> None:
    config = make_config(5, "fleet.joint_bodies=5")
    assert JointChoice(config, 1).choose(3, Neighbourhood(config, 1)) is None


def test_it_is_itself_then_who_is_one_hop_away_then_two_and_nobody_farther(make_config: MakeConfig) -> None:
    one = drone(make_config, 12, 6)
    assert one.sees(1, (), ()) == [1]
    chain = [(1, 2), (2, 3), (3, 4), (4, 5)]
    assert one.sees(2, (2,), chain) == [1, 2, 3]
    assert one.sees(3, (2, 9), chain) == [1, 2, 3, 9]  # heard, though nobody ranges it


def test_there_are_never_more_than_there_is_room_for_and_the_best_linked_come_first(make_config: MakeConfig) -> None:
    one = drone(make_config, 12, 4)
    links = [(1, 2), (1, 3), (2, 8), (3, 8), (2, 5), (3, 6)]
    assert one.sees(1, (2, 3), links) == [1, 2, 3, 8]
    crowd = [(1, other) for other in range(2, 12)]
    assert len(one.sees(2, range(2, 12), crowd)) == 4


def test_who_is_in_stays_as_long_as_nobody_is_clearly_nearer(make_config: MakeConfig) -> None:
    one = drone(make_config, 12, 4)
    assert one.sees(1, (2,), [(1, 2), (2, 7), (2, 8)]) == [1, 2, 7, 8]
    # one link more is not enough to take a place, nor is a lower id
    assert one.sees(2, (2,), [(1, 2), (2, 7), (2, 8), (2, 4), (2, 5)]) == [1, 2, 7, 8]
    assert one.sees(3, (2, 3), [(1, 2), (1, 3), (2, 7), (2, 8), (2, 4), (3, 4)]) == [1, 2, 3, 7]
    # three links against one are
    more = [(1, 2), (1, 3), (1, 6), (2, 7)]
    assert one.sees(4, (2, 3), more) == [1, 2, 3, 6]


def test_a_packet_that_is_lost_costs_nobody_its_place_and_a_link_that_is_gone_does(make_config: MakeConfig) -> None:
    one = drone(make_config, 12, 4)
    assert one.sees(1, (2,), [(1, 2), (2, 7)]) == [1, 2, 7]
    assert one.sees(20, (), ()) == [1, 2, 7]
    assert one.sees(20 + FORGOTTEN_TICKS, (3,), [(1, 3)]) == [1, 3]


def test_a_choice_that_flickers_between_one_hop_and_two_does_not_change(make_config: MakeConfig) -> None:
    one = drone(make_config, 12, 4)
    near, far = [(1, 2), (1, 3), (2, 3), (2, 5), (2, 6)], [(1, 2), (2, 3), (2, 5), (2, 6)]
    first = one.sees(1, (2, 3), near)
    found = {tuple(one.sees(tick, (2,) if tick % 90 else (2, 3), near if tick % 90 == 0 else far))
             for tick in range(2, 400)}  # fmt: skip
    assert found == {tuple(first)}


# --- how far records go -------------------------------------------------------------------------------------------


def store(make_config: MakeConfig, agents: int, joint: int, own: int, *overrides: str) -> MeasurementStore:
    config = make_config(agents, f"fleet.joint_bodies={joint}", "estimator.relay_hops=2", *overrides)
    return MeasurementStore(config, own)


LINE = "fleet.edges=[[1,2],[2,3],[3,4],[4,5]]"


@pytest.mark.parametrize("record", [fix, still])
def test_records_go_two_hops_along_edges_whatever_relay_hops_says(
    make_config: MakeConfig, record: Callable[[int, int], Measurement]
) -> None:
    hood = store(make_config, 5, 4, 1, LINE, "estimator.share_inputs=fleet").neighbourhood
    assert [agent for agent in range(1, 6) if hood.uses(record(agent, 1))] == [1, 2, 3]
    assert [agent for agent in range(1, 6) if hood.sends(record(agent, 1))] == [1, 2]


def test_without_edges_two_hops_are_who_is_linked_to_those_heard(make_config: MakeConfig) -> None:
    hood = store(make_config, 6, 4, 1).neighbourhood
    hood.hear(2, 5)
    hood.note(ranged(2, 3, 5))
    hood.note(ranged(3, 4, 5))
    assert [hood.hops(agent) for agent in range(1, 7)] == [0, 1, 2, 3, 3, 3]
    assert [agent for agent in range(1, 7) if hood.uses(fix(agent, 5))] == [1, 2, 3]
    assert [agent for agent in range(1, 7) if hood.sends(fix(agent, 5))] == [1, 2]


def test_a_range_is_relayed_only_between_direct_neighbours(make_config: MakeConfig) -> None:
    hood = store(make_config, 6, 4, 2, "fleet.edges=[[1,2],[2,3],[2,4],[3,4],[4,5],[3,6]]").neighbourhood
    assert hood.sends(ranged(3, 4, 1))
    assert hood.sends(ranged(4, 2, 1))
    assert not hood.sends(ranged(4, 5, 1))
    assert hood.sends(ranged(2, 5, 1))  # an own one goes out whatever


def test_a_relayed_record_goes_out_once_and_an_own_one_until_all_have_it(make_config: MakeConfig) -> None:
    middle = store(make_config, 5, 4, 2, LINE)
    for other in (1, 3):
        middle.neighbourhood.hear(other, 10)
    middle.add_own(fix(2, 10))
    middle.add_heard(3, [fix(3, 10)], 10)
    neighbours = frozenset((1, 3))
    sent = [middle.packet(10, 0, neighbours).records, middle.packet(11, 0, neighbours).records]
    assert set(sent[0]) == {fix(2, 10), fix(3, 10)}
    assert set(sent[1]) == {fix(2, 10)}
    for other in (1, 3):
        middle.add_heard(other, [fix(2, 10)], 11)  # they say it back
    assert middle.packet(12, 0, neighbours).records == ()
    assert not middle.lacked(12, neighbours)


def test_what_comes_from_its_owner_is_said_back_as_often_as_it_comes_and_nothing_of_two_hops_is(
    make_config: MakeConfig,
) -> None:
    end = store(make_config, 5, 4, 1, LINE)
    end.neighbourhood.hear(2, 10)
    end.add_heard(2, [fix(2, 10), fix(3, 10)], 10)
    assert set(end.packet(10, 0, frozenset((2,))).records) == {fix(2, 10)}
    end.add_heard(2, [fix(2, 10), fix(3, 10)], 11)
    assert set(end.packet(11, 0, frozenset((2,))).records) == {fix(2, 10)}
    assert end.packet(12, 0, frozenset((2,))).records == ()


def test_a_packet_that_is_full_leaves_the_rest_for_the_next_and_new_ones_go_first(make_config: MakeConfig) -> None:
    hub = store(make_config, 60, 10, 1)
    for agent in range(2, 60):
        hub.neighbourhood.hear(agent, 10)
        hub.add_heard(agent, [fix(agent, 10)], 10)
    neighbours = frozenset(range(2, 60))
    seen: list[int] = []
    while records := hub.packet(10, 0, neighbours).records:
        assert sum(len(record.wire or b"") for record in records) <= 1096
        seen += [record.observer for record in records]
    assert sorted(seen) == list(range(2, 60))


def test_records_of_drones_that_are_not_wanted_are_let_go(make_config: MakeConfig) -> None:
    own = store(make_config, 5, 3, 1, LINE)
    for record in (fix(1, 4), ranged(1, 2, 4), ranged(2, 3, 4), fix(3, 4)):
        if record.observer == 1:
            own.add_own(record)
        else:
            own.neighbourhood.hear(2, 4)
            own.add_heard(2, [record], 4)
    own.let_go_beyond({1, 2})
    rows, _ = own.take(4, (1, 2), (1, 2))
    assert len(rows) == 4  # a fix of three axes, and the range to 2
    assert own.refused["beyond the joint state"] == 2
