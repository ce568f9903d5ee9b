"""The far field of a drone: what it reports, passes on and keeps, and how what is told of the others ages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.config.tables import FleetConfig
from agent.fleet.far_field import FarField
from agent.fleet.membership import is_absent
from agent.fleet.tracking import ABSENT_VARIANCE, in_layout
from estimators.estimator import Estimate, SolverReport, Status
from estimators.model.layout import Layout, block
from transport.messages.far_body import MAX_REPORTS, FarReport

MakeConfig = Callable[..., FleetConfig]
PERIOD_S = 0.1
EVERY = 10
"""Ticks between reports of one drone."""


def report(agent: int, tick: int, north_m: float = 100.0) -> FarReport:
    return FarReport(agent, tick, 0, (north_m, 0.0, -20.0), (2.0, 0.0, 0.0), (0.3, 0.3, 0.5), (0.1, 0.1, 0.1))


def field(make_config: MakeConfig, agents: int = 6, joint: int = 3) -> FarField:
    return FarField(make_config(agents, f"fleet.joint_bodies={joint}"), 1, Counter())


def own_estimate(tick: int) -> Estimate:
    mean = np.arange(1.0, 7.0)
    return Estimate(tick, mean, 0.04 * np.eye(6), Status.OK, np.zeros(1, np.int64), SolverReport())


def whole(make_config: MakeConfig, far: FarField, tick: int, agents: int = 6) -> Estimate:
    """What drone 1, alone in its joint state, says of the fleet."""
    layout = Layout(make_config(agents).ids)
    return far.added_to(in_layout(own_estimate(tick), (1,), layout), (1,))


def test_a_fleet_that_fits_into_a_joint_state_has_no_far_field(make_config: MakeConfig) -> None:
    far = field(make_config, agents=6, joint=6)
    for tick in range(3 * EVERY):
        far.note_own(own_estimate(tick), block(0))
        assert far.packet(tick) is None
    assert not far.is_on


def test_the_own_state_is_reported_once_a_second(make_config: MakeConfig) -> None:
    far = field(make_config)
    told = []
    for tick in range(1000, 1000 + 5 * EVERY):
        far.note_own(own_estimate(tick), block(0))
        packet = far.packet(tick)
        told += [] if packet is None else list(packet.reports)
    assert len(told) == 5
    assert {each.agent for each in told} == {1}
    assert set(np.diff([each.tick for each in told])) == {EVERY}
    assert told[0].position_m == (1.0, 2.0, 3.0)
    assert told[0].velocity_sigma_mps == pytest.approx((0.2, 0.2, 0.2))


def test_a_drone_that_knows_nothing_of_itself_reports_nothing(make_config: MakeConfig) -> None:
    far = field(make_config)
    for tick in range(2 * EVERY):
        far.note_own(replace(own_estimate(tick), covariance=ABSENT_VARIANCE * np.eye(6)), block(0))
        assert far.packet(tick) is None


def test_a_report_is_passed_on_once_with_the_tick_that_it_is_of(make_config: MakeConfig) -> None:
    far = field(make_config)
    far.hear([report(5, 100)], 104)
    far.hear([report(5, 100)], 104)  # by another way
    packet = far.packet(104)
    assert packet is not None
    assert packet.reports == (report(5, 100),)
    far.hear([report(5, 100)], 105)
    assert far.packet(105) is None
    far.hear([report(5, 110)], 112)
    later = far.packet(112)
    assert later is not None
    assert later.reports == (report(5, 110),)


def test_what_a_packet_does_not_hold_is_next_and_a_newer_report_takes_its_place(make_config: MakeConfig) -> None:
    agents = 2 * MAX_REPORTS
    far = field(make_config, agents=agents)
    far.hear([report(agent, 100) for agent in range(2, agents + 1)], 101)
    last = agents
    far.hear([report(last, 110)], 111)  # while the first one waits
    packets = [far.packet(111), far.packet(112), far.packet(113)]
    assert packets[0] is not None
    assert packets[1] is not None
    assert packets[2] is None
    assert [each.agent for each in packets[0].reports] == list(range(2, MAX_REPORTS + 2))
    assert [each.agent for each in packets[1].reports] == list(range(MAX_REPORTS + 2, agents + 1))
    assert packets[1].reports[-1].tick == 110


def test_reports_that_cannot_be_are_counted_and_not_kept(make_config: MakeConfig) -> None:
    counters: Counter[str] = Counter()
    far = FarField(make_config(6, "fleet.joint_bodies=3"), 1, counters)
    far.hear([report(5, 300), report(4, 50), report(1, 190)], 200)
    assert far.packet(200) is None
    assert counters == {"far report: of the future": 1, "far report: too old": 1}
    far.hear([report(6, 200)], 200)
    far.hear([report(6, 203)], 203)  # a relay that makes up more than one a second
    assert counters["far report: too soon"] == 1
    packet = far.packet(203)
    assert packet is not None
    assert packet.reports == (report(6, 200),)
    assert is_absent(whole(make_config, far, 203).age_ticks).tolist() == [False, True, True, True, True, False]


def test_what_is_told_of_a_far_drone_moves_on_and_is_less_sure_the_older_it_is(make_config: MakeConfig) -> None:
    far = field(make_config)
    far.hear([report(5, 100)], 102)
    spreads = []
    for age in (0, 5, 10, 30):
        estimate = whole(make_config, far, 100 + age)
        at = block(4)
        age_s = age * PERIOD_S
        assert estimate.age_ticks[4] == age
        assert estimate.mean[at] == pytest.approx([100.0 + 2.0 * age_s, 0.0, -20.0, 2.0, 0.0, 0.0])
        variance = estimate.covariance.diagonal()[at]
        # an acceleration of 2 m/s2 that lasts is within two sigma of what is claimed
        assert 2.0 * np.sqrt(variance[0]) >= 0.5 * 2.0 * age_s**2
        assert variance[0] >= 0.3**2 + (0.1 * age_s) ** 2
        assert variance[3] >= 0.1**2
        spreads.append(variance[0])
        assert not estimate.covariance[at, :24].any()
    assert spreads == sorted(spreads)
    assert spreads[0] == pytest.approx(0.3**2)
    assert spreads[-1] > 4 * spreads[0]


def test_a_far_drone_that_nobody_reports_of_is_absent_after_a_while(make_config: MakeConfig) -> None:
    far = field(make_config)  # absent_after_s is 10
    far.hear([report(5, 100)], 100)
    assert not is_absent(whole(make_config, far, 200).age_ticks)[4]
    gone = whole(make_config, far, 201)
    assert is_absent(gone.age_ticks)[4]
    assert not gone.mean[block(4)].any()
    assert far.packet(201) is None  # nor is it passed on


def test_a_member_of_the_joint_state_is_not_told_from_its_report(make_config: MakeConfig) -> None:
    far = field(make_config)
    far.hear([report(1, 100, north_m=9.0), report(2, 100)], 100)
    estimate = whole(make_config, far, 100)
    assert estimate.mean[block(0)] == pytest.approx(np.arange(1.0, 7.0))
    layout = Layout(make_config(6).ids)
    joint = Estimate(100, np.zeros(12), np.eye(12), Status.OK, np.zeros(2, np.int64), SolverReport())
    told = far.added_to(in_layout(joint, (1, 2), layout), (1, 2))
    assert not told.mean[:12].any()
