"""A target's first place: from ranges that the window holds too, and so wide that they hardly count twice."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.fleet.fix_tracks import FixTracks
from agent.fleet.locating import TARGET_BIAS_M, TARGET_SIGMA_M, RangeLocator
from agent.fleet.motions import Motions
from estimators.integrity.finding import What
from transport.messages.measurement_body import (
    UNSEEN_VARIANCE,
    PositionMeasurement,
    RangeMeasurement,
    SightingMeasurement,
    VelocityMeasurement,
)

TARGET = 101
DRONES_M = np.array([[0, 0, -40], [60, 0, -45], [0, 60, -55], [60, 60, -70], [30, 90, -50]], float)
PERIOD_S = 1.0


def config(motion: str) -> FleetConfig:
    return config_from(
        {
            "fleet": {"name": "t", "period_s": PERIOD_S, "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 0.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24580 + i}"} for i in range(1, 6)],
            "targets": [{"id": TARGET, "motion": motion}],
            "estimator": {"limits": {"target": {"ceiling_m": 5.0}}},
            "security": {"mode": "unsigned"},
        },
        "test",
    )


def located(motion: str, velocity_mps: tuple[float, float, float], ticks: int, begin: int = 0) -> RangeLocator:
    """A locator that knows the drones from tick ``begin`` on, and has the ranges of ``ticks`` ticks."""
    fleet = config(motion)
    locator = RangeLocator(fleet, Motions(fleet))
    for tick in range(ticks):
        if tick >= begin:
            places = {
                i: (np.array((*DRONES_M[i - 1], 0.0, 0.0, 0.0)), 0.01 * np.eye(3)) for i in range(1, 6)
            }
            locator.note_places(tick, places)
        place = np.array((20.0, 30.0, 0.0)) + tick * PERIOD_S * np.array(velocity_mps)
        for i in range(1, 6):
            locator.note(RangeMeasurement(i, tick, TARGET, float(np.linalg.norm(place - DRONES_M[i - 1])), 0.25))
    return locator


@pytest.mark.parametrize(("motion", "velocity_mps"), [("fixed", (0.0, 0.0, 0.0)), ("moving", (2.0, -1.0, 0.0))])
def test_it_is_located_at_the_windows_begin_by_ranges_after_that(
    motion: str, velocity_mps: tuple[float, float, float]
) -> None:
    # GIVEN drones that are known from tick 4 on, where the window begins WHEN four more ticks have passed
    found = located(motion, velocity_mps, ticks=8, begin=4).place_target(TARGET, at_tick=4, until_tick=8)
    # THEN the target has a place at the window's begin, and its covariance holds the error
    assert found is not None
    mean, covariance = found
    error = mean[:3] - (np.array((20.0, 30.0, 0.0)) + 4 * PERIOD_S * np.array(velocity_mps))
    assert np.linalg.norm(error) < 1.0
    assert error @ np.linalg.solve(covariance[:3, :3], error) < 16.0


def test_the_prior_holds_a_ninth_of_what_the_ranges_say() -> None:
    # GIVEN ranges, and the information in them about a target that stands
    found = located("fixed", (0.0, 0.0, 0.0), ticks=6).place_target(TARGET, at_tick=0, until_tick=6)
    assert found is not None
    away = np.array((20.0, 30.0, 0.0)) - DRONES_M
    rows = away / np.linalg.norm(away, axis=1)[:, None]
    information = 6 * rows.T @ rows / 0.25  # at least this much: the variances that it assumes are larger
    prior = np.linalg.inv(found[1][:3, :3])
    assert np.linalg.eigvalsh(information / 9.0 - prior).min() > 0.0
    # and it is no empty one, whatever all ranges are too long by: seen from above that is like the target's height
    with_bias = np.column_stack((rows, np.ones(len(rows))))
    joint = 6 * with_bias.T @ with_bias / 0.25 + np.diag([0.0, 0.0, 0.0, 1.0 / TARGET_BIAS_M**2])
    biased = np.linalg.inv(np.linalg.inv(joint)[:3, :3])
    assert np.linalg.eigvalsh(prior - biased / 45.0).min() > 0.0


@pytest.mark.parametrize("ahead", [0, 1, 2, 3])
def test_a_target_that_two_drones_see_is_located_by_the_latest_sightings(ahead: int) -> None:
    # GIVEN two drones that saw a rover with its distance in every tick, well in direction and poorly in distance
    fleet, rng = config("moving"), np.random.default_rng(4 + ahead)
    locator, rover = RangeLocator(fleet, Motions(fleet)), np.array((20.0, 30.0, 0.0))
    for tick in range(4):
        locator.note_places(tick, {i: (np.array((*DRONES_M[i - 1], 0, 0, 0)), 0.01 * np.eye(3)) for i in (1, 2)})
        for i in (1, 2):
            away = rover + 2.0 * tick * np.array((1.0, 0.0, 0.0)) - DRONES_M[i - 1]
            distance_m = float(np.linalg.norm(away))
            direction = away / distance_m + 0.01 * rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            seen_m = distance_m + 3.0 * float(rng.normal())
            across = (0.01 * distance_m) ** 2
            locator.note(
                SightingMeasurement(i, tick, TARGET, seen_m, 9.0, math.inf, 0.0, tuple(direction.tolist()), across)
            )
    # THEN it has a place, at an earlier tick less sure for its motion, and the error is within the covariance
    found = locator.place_target(TARGET, at_tick=3 - ahead, until_tick=4)
    assert found is not None
    mean, covariance = found
    error = mean[:3] - (rover + 2.0 * (3 - ahead) * np.array((1.0, 0.0, 0.0)))
    assert error @ np.linalg.solve(covariance[:3, :3], error) < 16.0
    assert np.sqrt(covariance[0, 0]) > 3.0 * ahead  # a moving target may have run
    assert np.linalg.norm(error) < 4.0 + 2.0 * ahead


def test_bearings_alone_locate_nothing() -> None:
    fleet = config("fixed")
    locator = RangeLocator(fleet, Motions(fleet))
    locator.note_places(0, {1: (np.array((*DRONES_M[0], 0, 0, 0)), 0.01 * np.eye(3))})
    locator.note(
        SightingMeasurement(1, 0, TARGET, 50.0, UNSEEN_VARIANCE, math.inf, 0.0, (0.0, 0.0, 1.0), 0.25)
    )
    assert locator.place_target(TARGET, at_tick=0, until_tick=1) is None


@pytest.mark.parametrize(("ahead_m", "taken"), [(350.0, True), (600.0, False)])
def test_a_target_far_away_may_be_known_worse_as_long_as_its_ranges_are_straight(ahead_m: float, taken: bool) -> None:
    # GIVEN a fleet that is nearly level, and a few ranges of a metre to a target far ahead: its height is hardly told
    fleet, rng = config("fixed"), np.random.default_rng(1)
    locator, place = RangeLocator(fleet, Motions(fleet)), np.array((ahead_m, 30.0, 0.0))
    places = DRONES_M * [1.0, 1.0, 0.1] - [0.0, 0.0, 36.0]
    for tick in range(4):
        locator.note_places(tick, {i: (np.array((*places[i - 1], 0, 0, 0)), 0.01 * np.eye(3)) for i in range(1, 6)})
        for i in range(1, 6):
            seen_m = float(np.linalg.norm(place - places[i - 1]) + rng.normal())
            locator.note(RangeMeasurement(i, tick, TARGET, seen_m, 1.0))
    # THEN it is taken where a sphere is flat over what is not known, and its ceiling holds
    found = locator.place_target(TARGET, at_tick=0, until_tick=4)
    assert (found is not None) == taken
    assert [each.what for each in locator.findings[TARGET]] == ([] if taken else [What.UNCERTAIN])
    if found is not None:
        mean, covariance = found
        assert mean[2] >= -5.0
        error = mean[:3] - place
        assert error @ np.linalg.solve(covariance[:3, :3], error) < 16.0
        assert covariance[2, 2] > 9.0 * TARGET_SIGMA_M**2  # nine times as wide as what was found


def test_without_enough_ranges_there_is_none() -> None:
    assert located("fixed", (0.0, 0.0, 0.0), ticks=8, begin=8).place_target(TARGET, at_tick=4, until_tick=8) is None



def fixes(tracks: FixTracks, count: int, velocity: bool) -> None:
    for tick in range(count):
        tracks.note(PositionMeasurement(1, tick, (2.0 * tick, 0.0, -30.0), (1.0, 1.0, 1.0)))
        if velocity:
            tracks.note(VelocityMeasurement(1, tick, (2.0, 0.0, 0.0), (0.01, 0.01, math.inf)))


def test_a_drone_whose_velocity_is_measured_starts_with_its_first_fixes() -> None:
    # GIVEN fixes of a metre, a second apart: their slope says little of the velocity for long
    fleet = config("fixed")
    slow, quick = (FixTracks(fleet, Motions(fleet)) for _ in range(2))
    fixes(slow, 6, velocity=False)
    fixes(quick, 6, velocity=True)
    # THEN who measures its velocity need not wait for it
    assert slow.place(1, 6) is None
    found = quick.place(1, 6)
    assert found is not None
    np.testing.assert_allclose(found[0][3:5], (2.0, 0.0))
