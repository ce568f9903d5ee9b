"""UWB antennas beside the bodies: how drones lie travels as data, and ranges are turned by it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.config.agreement import shared_settings
from agent.config.tables import FleetConfig
from agent.fleet.lever_arms import LeverArms, orientation_measurement, turned_arm
from agent.fleet.measurement_store import ATTITUDE_TICKS, MeasurementStore
from agent.sensing.frames import from_euler, rotated
from agent.sensing.timeline import Orientation, _turned
from tests.agent.conftest import fleet_config
from transport.messages.measurement_body import (
    OrientationMeasurement,
    RangeMeasurement,
    SightingMeasurement,
    TagRangeMeasurement,
    as_sent,
)

ARMS = {1: ((0.3, 0.0, 0.0), (0.0, 0.5, -0.1)), 2: ((0.0, 0.2, 0.1),), 3: ()}
ANGLE = st.floats(-3.0, 3.0)


def config() -> FleetConfig:
    plain = fleet_config(3)
    return replace(plain, agents=tuple(replace(agent, uwb_tags_m=ARMS[agent.id]) for agent in plain.agents))


def lying(agent: int, tick: int, yaw: float, rate: float = 0.0) -> OrientationMeasurement:
    sent = as_sent(orientation_measurement(agent, tick, Orientation(from_euler(0.1, -0.2, yaw), (0.0, 0.0, rate))))
    assert isinstance(sent, OrientationMeasurement)
    return sent


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE, st.tuples(*[st.floats(-4.0, 4.0)] * 3), st.floats(-0.05, 0.05))
def test_an_arm_is_turned_as_the_body_is_within_a_millimetre(
    roll: float, pitch: float, yaw: float, rate: tuple[float, float, float], offset_s: float
) -> None:
    # GIVEN how a body lies and turns, as the wire rounds it
    lies, arm = from_euler(roll, pitch, yaw), (0.3, -0.2, 0.1)
    record = as_sent(orientation_measurement(1, 100, Orientation(lies, rate)))
    assert isinstance(record, OrientationMeasurement)
    # THEN its arm points where it does at an instant beside the tick
    assert turned_arm(record, arm, offset_s) == pytest.approx(rotated(_turned(lies, rate, offset_s), arm), abs=1.5e-3)


def test_a_range_is_shifted_by_the_arms_of_both_its_antennas() -> None:
    arms, record = LeverArms(config()), TagRangeMeasurement(1, 100, 2, 9.0, 0.01, offset_s=0.02, tag=1)
    arms.note(lying(1, 100, 0.7, 0.5))
    assert not arms.knows(record)
    arms.note(lying(2, 100, -0.4))
    assert arms.knows(record)
    first = rotated(_turned(from_euler(0.1, -0.2, 0.7), (0.0, 0.0, 0.5), 0.02), ARMS[1][1])
    second = rotated(from_euler(0.1, -0.2, -0.4), ARMS[2][0])
    assert arms.shift(record).arm_m == pytest.approx(np.subtract(first, second), abs=2e-3)
    assert arms.shift(record).variance_m2 == 0.0


def test_an_arm_that_points_anywhere_makes_the_range_less_sure() -> None:
    arms, record = LeverArms(config()), RangeMeasurement(2, 100, 1, 9.0, 0.01)
    arms.note(lying(2, 100, 0.0))
    shift = arms.shift(record)
    assert shift.variance_m2 == pytest.approx(0.3**2 / 3)
    assert shift.arm_m == pytest.approx(rotated(from_euler(0.1, -0.2, 0.0), ARMS[2][0]), abs=1e-3)
    arms.note(lying(1, 100, 0.0))
    arms.forget(101)
    assert arms.shift(record).variance_m2 == pytest.approx((0.3**2 + 0.2**2 + 0.1**2) / 3)


def test_a_drone_without_arms_need_not_say_how_it_lies() -> None:
    arms = LeverArms(fleet_config(3))
    assert arms.knows(RangeMeasurement(1, 100, 2, 9.0, 0.01))
    assert arms.shift(RangeMeasurement(1, 100, 2, 9.0, 0.01)).arm_m == (0.0, 0.0, 0.0)


def test_drones_have_to_share_where_the_tags_are() -> None:
    found = shared_settings(config()).differences(shared_settings(fleet_config(3)))
    assert found == ("agents.uwb_tags_m",)


def test_a_range_waits_for_how_the_other_end_lay_and_then_counts_for_less() -> None:
    # GIVEN two ranges of one tick, one to a drone that has said how it lies
    store = MeasurementStore(config(), 1)
    store.add_own(lying(1, 100, 0.0))
    store.add_own(RangeMeasurement(1, 100, 2, 9.0, 0.01))
    store.add_own(RangeMeasurement(1, 100, 3, 7.0, 0.01))
    members = (1, 2, 3)
    rows, _ = store.take(100, members, members)
    assert rows["value"].tolist() == [7.0]
    turned = rotated(from_euler(0.1, -0.2, 0.0), ARMS[1][0])
    assert [rows[0][axis] for axis in "xyz"] == pytest.approx(turned, abs=1e-3)
    # WHEN the other says it a tick later THEN the range is used, turned
    store.neighbourhood.hear(2, 101)
    store.add_heard(2, [lying(2, 100, 0.0)], 101)
    rows, _ = store.take(101, members, members)
    assert rows["value"].tolist() == [9.0]
    assert rows[0]["variance"] == pytest.approx(0.01, rel=1e-2)
    # AND one whose other end never says it is used in the end, for less
    store.add_own(lying(1, 102, 0.0))
    store.add_own(RangeMeasurement(1, 102, 2, 8.0, 0.01))
    wait = min(ATTITUDE_TICKS, config().estimator.window)
    assert [len(store.take(102 + ticks, members, members)[0]) for ticks in range(wait)] == [0] * wait
    rows, _ = store.take(102 + wait, members, members)
    assert rows["value"].tolist() == [8.0]
    assert rows[0]["variance"] == pytest.approx(0.01 + (0.2**2 + 0.1**2) / 3, rel=1e-2)
    assert store.unturned == 1


def test_a_sighting_waits_for_nobodys_attitude_and_does_not_count_as_a_range() -> None:
    # GIVEN drones with arms that have said nothing of how they lie, THEN what one sees of the other is used at once
    store = MeasurementStore(config(), 1)
    store.add_own(SightingMeasurement(1, 100, 2, 9.0, 0.01))
    rows, _ = store.take(100, (1, 2, 3), (1, 2, 3))
    assert rows["value"].tolist() == [9.0, 0.0, 0.0]
    assert store.unturned == 0
    # and one of somebody who was never located is no range that was left out
    store.add_own(SightingMeasurement(1, 101, 3, 7.0, 0.01))
    store.add_own(RangeMeasurement(1, 101, 3, 7.0, 0.01))
    store.forget(200)
    assert store.refused["not located"] == 2
    assert store.unused_ranges == 1
