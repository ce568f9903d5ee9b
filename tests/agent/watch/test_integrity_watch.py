"""What an agent promises: whose rows it leaves out, what it states of an estimate."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.config.integrity_table import IntegrityTable
from agent.watch.integrity_watch import IntegrityWatch, bounds_of
from estimators.estimator import Estimate, Status
from estimators.integrity.finding import What, has
from estimators.integrity.protection.statement import ALIKE, IntegrityState
from estimators.integrity.protection.targets import TargetState
from estimators.model.measurements import Kind
from tests.support.sitl_fleet import fleet_config
from tests.support.uncalibrated_fleet import jump, rows_of_flight

IDS = (1, 2, 3, 4, 5)
NAMED = 3


def watch(own: int = 1, *, exclude: bool = True) -> tuple[IntegrityWatch, int]:
    """That of a fleet of five after a receiver has jumped by 30 m, and the tick."""
    config = fleet_config(ids=IDS, integrity={"exclude": exclude, "position_bound_m": 5.0, "range_bound_m": 2.0})
    made, tick = IntegrityWatch(config, own), 0
    for tick, rows in rows_of_flight(5, 3, 24.0, jump(NAMED - 1, np.array([30.0, 20.0, 0.0]), 20.0, 99.0)):
        made.take(tick, IDS, rows)
    return made, tick


def estimate(tick: int, sigma_m: float = 0.3) -> Estimate:
    mean = np.zeros(30)
    mean[::6] = 10.0 * np.arange(5)
    return Estimate(tick, mean, sigma_m**2 * np.eye(30), Status.OK, np.zeros(5, np.int64))


def test_what_is_said_of_targets_is_said_of_them_alone() -> None:
    # GIVEN a drone that knows where it is, one target that the data do not tell, and one that nobody has found
    made = IntegrityWatch(fleet_config(targets=[{"id": 101}, {"id": 102}]), 1)
    observable, mean = np.array([True, True, True, False]), np.arange(24.0)
    known = Estimate(7, mean, 0.01 * np.eye(24), Status.OK, np.zeros(4, np.int64), observable=observable)
    # THEN each is stated for itself, and the own position is as good as it is
    stated = made.state(known, (1, 2, 3, 101), ())
    assert stated.targets == {101: TargetState.NOT_OBSERVABLE, 102: TargetState.NOT_FOUND}
    assert str(stated) == "NOMINAL"


@pytest.mark.parametrize("exclude", [True, False])
def test_fixes_that_are_off_do_not_reach_the_estimator(exclude: bool) -> None:
    made, tick = watch(exclude=exclude)
    rows = next(rows_of_flight(5, 3, 0.1))[1]
    rows["tick"] = tick + 1
    left = made.take(tick + 1, IDS, rows)
    off = (rows["kind"] == Kind.POSITION) & (rows["agent"] == NAMED - 1)
    assert off.any()
    np.testing.assert_array_equal(left, rows[~off] if exclude else rows)


@pytest.mark.parametrize(("own", "about"), [(1, NAMED), (NAMED, None)])
def test_everybody_names_the_same_drone_and_it_itself(own: int, about: int | None) -> None:
    made, tick = watch(own)
    (found,) = (each for each in made.observe(estimate(tick), IDS) if each.what is What.RECEIVER_OFF)
    assert found.about == about
    stated = made.state(estimate(tick), IDS, (found,))
    assert stated.state is IntegrityState.DEGRADED
    assert list(stated.off) == [NAMED]
    assert stated.off[NAMED] == pytest.approx(36.0, abs=15.0)  # to the first order in 30 m over 10 m
    assert "as ranges say" in str(stated)
    assert stated.undetectable == (ALIKE,)
    assert set(stated.relative) == set(IDS) - {own}
    assert made.statement is stated


def test_an_uncertain_position_is_an_alert_by_the_configured_limits() -> None:
    made = IntegrityWatch(fleet_config(ids=IDS, integrity={"alert_horizontal_m": 2.0}), 1)
    assert made.state(estimate(0, 0.5), IDS, ()).state is IntegrityState.NOMINAL
    stated = made.state(estimate(0, 0.6), IDS, ())
    assert stated.state is IntegrityState.ALERT
    assert stated.reason == "horizontal protection level 2.2 m above 2 m"


def test_an_estimate_of_another_tick_is_held_against_nothing() -> None:
    made, tick = watch()
    assert not has(made.observe(estimate(tick + 1), IDS), What.RECEIVER_OFF)


def test_bounds_come_from_the_configuration() -> None:
    nothing = bounds_of(IntegrityTable(), None)
    assert all(math.isinf(each) for each in (*nothing.position_m, nothing.range_m, nothing.speed_mps))
    stated = bounds_of(IntegrityTable(position_bound_m=2.0, height_bound_m=3.0, velocity_bound_mps=0.5), 9.0)
    assert stated.position_m == (2.0, 2.0, 3.0)
    assert (stated.velocity_mps, stated.speed_mps) == (0.5, 9.0)
    assert bounds_of(IntegrityTable(position_bound_m=2.0), None).position_m == (2.0, 2.0, 2.0)


def test_ranges_that_are_off_do_not_reach_the_estimator() -> None:
    made = IntegrityWatch(fleet_config(ids=IDS), 1)
    for tick, rows in rows_of_flight(5, 6, 24.0):
        ends = np.isin(rows["agent"], (1, 3)) & np.isin(rows["other"], (1, 3))
        off = (rows["kind"] == Kind.RANGE) & ends
        rows["value"][off] += 8.0 * (tick >= 200)
        left = made.take(tick, IDS, rows)
    np.testing.assert_array_equal(left, rows[~off])
    (found,) = (each for each in made.observe(estimate(tick), IDS) if each.what is What.RANGES_OFF)
    stated = made.state(estimate(tick), IDS, (found,))
    assert stated.ranges_off == ((2, 4),)
    assert str(stated).startswith("DEGRADED: ranges between 2 and 4 off by ")


def test_a_frozen_receiver_is_off_by_how_far_its_drone_has_moved_since() -> None:
    made = IntegrityWatch(fleet_config(ids=IDS), 2)
    made.note_frozen(frozen=True)
    (found,) = made.observe(estimate(1), IDS)
    assert (found.what, found.about) == (What.RECEIVER_FROZEN, None)
    assert made.state(estimate(1), IDS, ()).off == {2: 0.0}
    later = estimate(2)
    later.mean[6:9] += (3.0, 4.0, 0.0)
    assert made.state(later, IDS, ()).off == {2: pytest.approx(5.0)}
    made.note_frozen(frozen=False)
    assert made.observe(estimate(3), IDS) == ()
    assert made.state(estimate(3), IDS, ()).off == {}


@pytest.mark.parametrize("exclude", [True, False])
def test_fixes_that_are_off_break_no_bound_any_more_once_they_are_left_out(exclude: bool) -> None:
    limits = {"limits": {"vehicle": {"speed_mps": 8.0}}}
    integrity = {"exclude": exclude, "position_bound_m": 8.0, "range_bound_m": 8.0}
    made, broken = IntegrityWatch(fleet_config(ids=IDS, integrity=integrity, estimator=limits), 1), list[int]()
    shift = jump(NAMED - 1, np.array([60.0, 20.0, 0.0]), 20.0, 99.0)
    for tick, rows in rows_of_flight(5, 3, 35.0, shift):
        made.take(tick, IDS, rows)
        found = made.observe(estimate(tick), IDS)
        broken += [tick] if any(each.what is What.BOUNDS_BROKEN and each.about == NAMED for each in found) else []
    assert broken[0] <= 202
    assert (broken[-1] < 320) == exclude  # ten seconds after the last one that was not left out
