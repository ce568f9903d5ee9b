"""Where else a drone without fixes may be: what the monitor finds about the estimate of the own state."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from estimators.integrity.finding import Finding, Gravity, What, has
from estimators.integrity.places.ambiguity import (
    AmbiguityMonitor,
    Body,
    DroneEvidence,
    Elsewhere,
    FoundAgain,
    Understated,
    determined,
)
from estimators.integrity.places.hypotheses import Drift, Mixture, correct_linear, correct_range, predict
from estimators.integrity.thresholds import BLIND_TICKS
from estimators.model.layout import Layout
from estimators.model.measurements import RowTable, empty_rows, position_rows, range_row, velocity_rows
from estimators.model.members import MemberChange

DT = 0.1
SURE = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
QUIET = np.full(3, 1e-4)
REST = np.zeros(3)
TRIANGLE = {1: [8.0, 0.0, 0.0], 2: [-6.0, 7.0, 0.0], 3: [-5.0, -8.0, 0.0]}
APEX = {**TRIANGLE, 4: [0.0, 0.0, 9.0]}
START = np.array([1.0, 2.0, -6.0, 0.0, 0.0, 0.0])
WIDE = np.diag([36.0] * 3 + [1.0] * 3)


def bodies(places: Mapping[int, list[float]]) -> dict[int, Body]:
    return {slot: (np.array([*place, 0.0, 0.0, 0.0]), 1e-4 * np.eye(6)) for slot, place in places.items()}


def ranges(
    tick: int, truth: np.ndarray, places: Mapping[int, list[float]], rng: np.random.Generator, own: int = 0
) -> RowTable:
    return np.concatenate(
        [
            range_row(tick, own, slot, float(np.linalg.norm(truth[:3] - place) + rng.normal() * 0.05), 0.0025)
            for slot, place in places.items()
        ]
    )


def blind(
    estimate: Body, rows: RowTable, others: Mapping[int, Body] | None = None, accel: np.ndarray = REST
) -> DroneEvidence:
    """A tick without a fix."""
    return DroneEvidence(False, True, estimate, rows, accel, QUIET, {} if others is None else others)


def fixed(estimate: Body) -> DroneEvidence:
    return DroneEvidence(True, True, estimate, position_rows(1, 0, estimate[0][:3], np.ones(3)), REST, QUIET, {})


def place_of(found: tuple[Finding, ...]) -> Body | None:
    return next((finding.place for finding in found if isinstance(finding, Elsewhere)), None)


def watch(
    places: Mapping[int, list[float]],
    accel: np.ndarray,
    ticks: int,
    at_mirror: bool = False,
) -> tuple[list[tuple[Finding, ...]], list[np.ndarray]]:
    """A drone that starts at rest; its estimate is the truth or its mirror image in z = 0.

    Gives what is found in each tick, and the true states.
    """
    rng = np.random.default_rng(1)
    truth = START.copy()
    side = np.array([1.0, 1.0, -1.0 if at_mirror else 1.0] * 2)
    monitor = AmbiguityMonitor(0, (np.zeros(6), WIDE), DT)
    found, flown = [], []
    for tick in range(1, ticks):
        truth[:3] += DT * truth[3:] + 0.5 * DT**2 * accel
        truth[3:] += DT * accel
        rows = ranges(tick, truth, places, rng)
        found.append(monitor.observe(blind((side * truth, SURE), rows, bodies(places), accel)))
        flown.append(truth.copy())
    return found, flown


def test_four_neighbours_around_leave_no_doubt() -> None:
    found, _ = watch(APEX, REST, 20)
    assert not any(has(each, What.AMBIGUOUS) for each in found[5:])


def test_in_front_of_a_plane_of_neighbours_both_sides_are_held_while_nothing_moves() -> None:
    found, flown = watch(TRIANGLE, REST, 30)
    assert all(has(each, What.AMBIGUOUS) for each in found[1:])
    assert place_of(found[-1]) is None
    # THEN what is expected of the error covers the mirror image
    (understated,) = [finding for finding in found[-1] if isinstance(finding, Understated)]
    assert understated.second_moment[2, 2] > 0.05 * (2 * flown[-1][2]) ** 2
    # and the figures say so in metres
    assert understated.value == pytest.approx(float(np.sqrt(np.trace(understated.second_moment[:3, :3]))))
    assert understated.limit == pytest.approx(float(np.sqrt(0.03)))


@pytest.mark.parametrize("at_mirror", [False, True])
def test_motion_decides_between_the_sides(at_mirror: bool) -> None:
    # GIVEN a known acceleration away from the plane: in the mirror image it would go the other way
    found, flown = watch(TRIANGLE, np.array([0.0, 0.0, -1.0]), 40, at_mirror)
    if not at_mirror:
        # THEN an estimate at the true side is confirmed
        assert has(found[2], What.AMBIGUOUS)
        assert found[-1] == ()
        assert all(place_of(each) is None for each in found)
        return
    # and one at the wrong side is told where the drone is, but only when the data have decided
    assert all(has(each, What.AMBIGUOUS) for each in found[2:])
    moves = [(place_of(each), truth) for each, truth in zip(found, flown, strict=True) if has(each, What.ELSEWHERE)]
    assert moves
    for place, truth in moves:
        assert place is not None
        error = place[0][:3] - truth[:3]
        assert error @ np.linalg.solve(place[1][:3, :3], error) < 16.0


@pytest.mark.parametrize("neighbours", [1, 2])
def test_one_or_two_neighbours_that_hover_do_not_tell(neighbours: int) -> None:
    places = {slot: TRIANGLE[slot] for slot in list(TRIANGLE)[:neighbours]}
    found, _ = watch(places, REST, 30)
    assert all(has(each, What.AMBIGUOUS) for each in found)
    assert {(f.gravity, f.about) for each in found for f in each if f.what is What.AMBIGUOUS} == {(Gravity.ALARM, 0)}


@pytest.mark.parametrize(
    ("variance", "accel_variance", "speed_variance"),
    [(1e-4, 1e-4, None), (100.0, 1e-4, None), (1e-4, 100.0, None), (1e-4, 1e-4, 1.0)],
    ids=["good", "poor", "pushed", "unsure"],
)
def test_a_measured_velocity_does_not_tilt_the_scales(
    variance: float, accel_variance: float, speed_variance: float | None
) -> None:
    # GIVEN a drone whose hypothesis is at one side of its neighbours' plane, and an estimate at the other that holds
    # the same, but perhaps knows its own velocity less well
    rng = np.random.default_rng(2)
    side = np.array([1.0, 1.0, -1.0] * 2)
    monitor, twin = AmbiguityMonitor(0, (START, SURE), DT), Mixture.single(side * START, SURE)
    noise = np.full(3, accel_variance)
    for tick in range(1, 200):
        measured = ranges(tick, START, TRIANGLE, rng)
        predict(twin, REST, noise, DT)
        for axis in range(3):
            correct_linear(twin, np.eye(6)[3 + axis], 0.0, variance)
        for row in np.sort(measured, order="value"):
            correct_range(twin, *bodies(TRIANGLE)[int(row["other"])], float(row["value"]), 0.0025, 0.0)
        mean, covariance = twin.means[0].copy(), twin.covariances[0].copy()
        if speed_variance is not None:
            covariance[3:], covariance[:, 3:] = 0.0, 0.0
            covariance[3:, 3:] = speed_variance * np.eye(3)
        rows = np.concatenate((measured, velocity_rows(tick, 0, REST, np.full(3, variance))))
        found = monitor.observe(DroneEvidence(False, True, (mean, covariance), rows, REST, noise, bodies(TRIANGLE)))
        # THEN however many velocities are used, neither side foretells the ranges better: none of the two wins
        assert place_of(found) is None
        assert has(found, What.AMBIGUOUS)


def test_it_sleeps_while_there_are_fixes_and_goes_on_from_the_estimate() -> None:
    # GIVEN a start far away, and an estimate that fixes hold
    monitor = AmbiguityMonitor(0, (np.full(6, 99.0), np.eye(6)), DT)
    here = np.arange(6.0), SURE
    assert monitor.observe(fixed(here)) == ()
    # WHEN the fixes end THEN nothing is said for a while
    for _ in range(BLIND_TICKS - 1):
        assert monitor.observe(blind(here, empty_rows())) == ()
    # and then the drone is not held, and expected as near to the estimate as it moves in a tick
    (ambiguous,) = [f for f in monitor.observe(blind(here, empty_rows())) if f.what is What.AMBIGUOUS]
    assert ambiguous.value is not None
    assert 0.1 < ambiguous.value < 1.0


def test_fixes_end_the_doubt_at_once() -> None:
    monitor = AmbiguityMonitor(0, (np.zeros(6), WIDE), DT)
    here = START, SURE
    assert has(monitor.observe(blind(here, empty_rows())), What.AMBIGUOUS)
    assert not has(monitor.observe(fixed(here)), What.AMBIGUOUS)
    assert monitor.observe(fixed(here)) == ()


def test_the_fix_that_ends_a_doubt_meets_an_estimate_that_is_as_wide_as_the_doubt_was() -> None:
    # GIVEN a drone that two neighbours hold, which may be anywhere on a circle, and an estimate that is sure
    monitor, rng = AmbiguityMonitor(0, (START, WIDE), DT), np.random.default_rng(2)
    two = {slot: TRIANGLE[slot] for slot in (1, 2)}
    for tick in range(1, 30):
        found = monitor.observe(blind((START, SURE), ranges(tick, START, two, rng), bodies(two)))
    (doubt,) = [finding for finding in found if isinstance(finding, Understated)]
    # WHEN fixes come back
    (again,) = monitor.observe(fixed((START, SURE)))
    # THEN this is said once
    assert isinstance(again, FoundAgain)
    np.testing.assert_allclose(again.second_moment, doubt.second_moment, atol=1e-6 * doubt.second_moment.max())
    assert monitor.observe(fixed((START, SURE))) == ()


def test_an_acceleration_that_errs_for_long_leaves_no_drone_sure_of_its_place_on_a_circle() -> None:
    # GIVEN drones that two neighbours hold, flying to and fro, whose accelerations are off by 2 degrees of tilt
    share = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        error, truth = np.array([*0.35 * rng.normal(size=2), 0.0]), START.copy()
        drift = Drift(0.995, np.array([0.35, 0.35, 0.02]))
        about = np.diag([1e-4] * 6 + [0.35**2, 0.35**2, 0.02**2])
        monitor = AmbiguityMonitor(0, (np.concatenate([truth, np.zeros(3)]), about), DT)
        two = {1: [9.0, 1.0, -5.0], 2: [-8.0, -2.0, -7.0]}
        for tick in range(1, 250):
            accel = np.array([np.sin(0.05 * tick), np.cos(0.07 * tick), 0.4 * np.sin(0.03 * tick)])
            truth[:3] += DT * truth[3:] + 0.5 * DT**2 * accel
            truth[3:] += DT * accel
            estimate = np.concatenate([truth, error]), np.diag([0.01] * 9)
            rows, others = ranges(tick, truth, two, rng), bodies(two)
            told = DroneEvidence(False, True, estimate, rows, accel + error, QUIET, others, drift)
            found = monitor.observe(told)
            # WHEN the estimate is the truth THEN what is expected of its error is what the monitor does not know
            moment = [each.second_moment for each in found if isinstance(each, Understated)]
            share.append(bool(moment) and float(np.trace(moment[0][:3, :3])) > 0.5**2)
            assert place_of(found) is None
    assert np.mean(share) > 0.3


def test_drones_without_fixes_that_hold_only_each_other_are_held_by_nobody() -> None:
    rng = np.random.default_rng(4)
    monitor = AmbiguityMonitor(0, (START, SURE), DT)
    for tick in range(1, 10):
        monitor.observe(blind((START, SURE), ranges(tick, START, APEX, rng), bodies(APEX)))
    assert monitor.is_held(np.array([False, True, True, True, True]))
    assert not monitor.is_held(np.array([False, True, True, False, False]))
    assert not monitor.is_held(np.zeros(5, bool))
    # but with a fix it is
    monitor.observe(fixed((START, SURE)))
    assert monitor.is_held(np.zeros(5, bool))


@pytest.mark.parametrize(("variance", "used"), [(9.0, False), (0.01, True)])
def test_a_neighbour_that_is_not_located_is_not_ranged_to(variance: float, used: bool) -> None:
    def expected_m(rows: RowTable) -> float:
        monitor = AmbiguityMonitor(0, (np.zeros(6), np.eye(6)), DT)
        found = monitor.observe(blind((np.zeros(6), SURE), rows, {1: (np.full(6, 3.0), variance * np.eye(6))}))
        return next(finding.value for finding in found if finding.what is What.AMBIGUOUS) or 0.0

    ranged, alone = expected_m(range_row(1, 0, 1, 9.0, 0.01)), expected_m(empty_rows())
    assert (ranged != pytest.approx(alone)) is used


def test_a_position_is_determined_by_three_directions_that_are_not_in_a_plane() -> None:
    here = np.array([0.0, 0.0, -6.0])
    around = [np.array(place) for place in TRIANGLE.values()]
    assert determined(here, around)
    assert not determined(here, around[:2])
    assert not determined(np.zeros(3), around)  # in the neighbours' own plane
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert determined(turn @ here + 5.0, [turn @ place + 5.0 for place in reversed(around)])


def in_turn(
    monitor: AmbiguityMonitor, ticks: range, slots: Mapping[int, int], own: int = 0
) -> list[tuple[Finding, ...]]:
    """One range per tick, to one neighbour after the other, ``slots`` of their places; the estimate is right."""
    rng, found = np.random.default_rng(3), []
    for tick in ticks:
        place = list(slots)[tick % len(slots)]
        rows = ranges(tick, START, {slots[place]: APEX[place]}, rng, own)
        found.append(monitor.observe(blind((START, SURE), rows, {slots[place]: bodies(APEX)[place]})))
    return found


def test_neighbours_that_are_ranged_in_turn_count_together() -> None:
    monitor = AmbiguityMonitor(0, (np.zeros(6), WIDE), DT)
    found = in_turn(monitor, range(1, 30), {slot: slot for slot in APEX})
    assert not has(found[-1], What.AMBIGUOUS)


def test_it_follows_the_drone_through_a_change_of_the_fleet() -> None:
    # GIVEN four neighbours that hold the drone
    monitor = AmbiguityMonitor(0, (np.zeros(6), WIDE), DT)
    in_turn(monitor, range(1, 30), {slot: slot for slot in APEX})
    # WHEN the first of them leaves and two others come, whereby all get other slots
    new = np.zeros(6), np.eye(6)
    monitor.change_members(MemberChange.between(Layout((3, 4, 5, 6, 7)), (1, 2, 3, 5, 6, 7), 3, {1: new, 2: new}))
    # THEN what is known goes on at once: three are left, around the drone
    found = in_turn(monitor, range(30, 40), {2: 3, 3: 4, 4: 5}, own=2)
    assert not any(has(each, What.AMBIGUOUS) for each in found)
    assert {finding.about for each in in_turn(monitor, range(40, 60), {2: 3}, own=2) for finding in each} <= {2}
