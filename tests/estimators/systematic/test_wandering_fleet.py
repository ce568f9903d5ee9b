"""The whole shared estimator, with slow errors and outlier weights on, in a world that has both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.estimator import Estimate
from estimators.factory import make_estimator
from estimators.model.layout import Layout, states_of
from estimators.model.measurements import Kind
from estimators.settings import EstimatorSettings, default_settings
from tests.support import builders
from tests.support.wandering_fleet import WanderingFlight, World, fly

Array = NDArray[np.float64]
WORLD = World(
    agents=3, period_s=0.2, claim_m=0.5, white=1.0, wander_m=0.8, accel_mps2=0.2, pair_m=0.2, range_m=0.1
)
EXACT = msgspec.structs.replace(default_settings(), tolerance=1e-10, max_iterations=200)
ROUNDING_M = 1e-6


def estimated(flight: WanderingFlight, settings: EstimatorSettings, start: Array, world: World) -> list[Estimate]:
    """By one drone that hears everything."""
    covariance = np.diag(np.tile([4.0, 4.0, 4.0, 1.0, 1.0, 1.0], world.agents))
    layout = Layout(tuple(range(1, world.agents + 1)))
    estimator = make_estimator(settings, layout, 0, start, covariance, world.period_s)
    return builders.run_alone(
        estimator, lambda tick: flight.rows[tick], lambda tick: flight.inputs[tick], len(flight.rows) - 1
    )


def with_outliers(flight: WanderingFlight, rng: np.random.Generator, share: float = 0.03) -> WanderingFlight:
    for rows in flight.rows:
        ranges = np.flatnonzero((rows["kind"] == Kind.RANGE) & (rng.random(len(rows)) < share))
        rows["value"][ranges] += rng.uniform(3.0, 10.0, len(ranges))
        if rng.random() < share:
            fix = (rows["kind"] == Kind.POSITION) & (rows["agent"] == rng.integers(0, WORLD.agents))
            rows["value"][fix] += 20.0
    return flight


# --- what must not matter ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight() -> WanderingFlight:
    rng = np.random.default_rng(21)
    return with_outliers(fly(WORLD, 60, rng), rng)


@pytest.fixture(scope="module")
def start(flight: WanderingFlight) -> Array:
    return np.asarray(flight.truth[0] + np.random.default_rng(3).normal(0.0, 0.5, flight.truth.shape[1]))


@pytest.fixture(scope="module")
def expected(flight: WanderingFlight, start: Array) -> list[Estimate]:
    return estimated(flight, EXACT, start, WORLD)


def assert_equal(found: Sequence[Estimate], expected: Sequence[Estimate], moves: Array, offset: Array) -> None:
    """``found`` is ``expected`` seen as ``moves`` x + ``offset``."""
    for there, here in zip(found, expected, strict=True):
        np.testing.assert_allclose(there.mean, moves @ here.mean + offset, rtol=0, atol=ROUNDING_M)
        np.testing.assert_allclose(there.covariance, moves @ here.covariance @ moves.T, rtol=0, atol=ROUNDING_M)
        assert there.status is here.status


def test_moving_the_origin_by_a_kilometre(
    flight: WanderingFlight, start: Array, expected: list[Estimate]
) -> None:
    shift = np.array([1000.0, -700.0, 150.0])
    whole = np.tile(np.concatenate([shift, np.zeros(3)]), WORLD.agents)
    moved = [rows.copy() for rows in flight.rows]
    for rows in moved:
        fixes = rows["kind"] == Kind.POSITION
        rows["value"][fixes] += (np.stack([rows["x"], rows["y"], rows["z"]], axis=1) @ shift)[fixes]
    found = estimated(replace(flight, rows=moved), EXACT, start + whole, WORLD)
    assert_equal(found, expected, np.eye(len(start)), whole)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turning_north_by_right_angles(
    flight: WanderingFlight, start: Array, expected: list[Estimate], quarters: int
) -> None:
    c, s = [(0, 1), (-1, 0), (0, -1)][quarters - 1]
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    fleet = np.kron(np.eye(2 * WORLD.agents), turn)
    turned = []
    for rows in flight.rows:
        out = rows.copy()
        for agent in range(WORLD.agents):
            for kind in (Kind.POSITION, Kind.VELOCITY):
                at = np.flatnonzero((rows["kind"] == kind) & (rows["agent"] == agent))
                assert rows["x"][at[0]] == rows["y"][at[1]] == rows["z"][at[2]] == 1.0
                out["value"][at] = turn @ rows["value"][at]
        turned.append(out)
    inputs = [each.copy() for each in flight.inputs]
    for each in inputs:
        each["accel"] = each["accel"] @ turn.T
    found = estimated(replace(flight, rows=turned, inputs=inputs), EXACT, fleet @ start, WORLD)
    assert_equal(found, expected, fleet, np.zeros(len(start)))


@pytest.mark.parametrize("order", [(0, 2, 1), (1, 0, 2), (2, 0, 1)])
def test_renaming_the_agents(
    flight: WanderingFlight, start: Array, expected: list[Estimate], order: tuple[int, ...]
) -> None:
    # GIVEN the same drone estimating, under another number, in a fleet with another order
    place, states = np.argsort(order), states_of(order)
    renamed, inputs = [rows.copy() for rows in flight.rows], [each.copy() for each in flight.inputs]
    for rows in renamed:
        for name in ("agent", "observer"):
            rows[name] = place[rows[name]]
        rows["other"] = np.where(rows["other"] >= 0, place[rows["other"]], -1)
    for each in inputs:
        each["agent"] = place[each["agent"]]
    layout = Layout(tuple(range(1, WORLD.agents + 1)))
    covariance = np.diag(np.tile([4.0, 4.0, 4.0, 1.0, 1.0, 1.0], WORLD.agents))
    estimator = make_estimator(EXACT, layout, int(place[0]), start[states], covariance, WORLD.period_s)
    found = builders.run_alone(
        estimator, lambda tick: renamed[tick], lambda tick: inputs[tick], len(renamed) - 1
    )
    assert_equal(found, expected, np.eye(len(start))[states], np.zeros(len(start)))


def test_the_same_again_is_the_same_bit_by_bit(
    flight: WanderingFlight, start: Array, expected: list[Estimate]
) -> None:
    for there, here in zip(estimated(flight, EXACT, start, WORLD), expected, strict=True):
        np.testing.assert_array_equal(there.mean, here.mean)
        np.testing.assert_array_equal(there.covariance, here.covariance)


# --- consistency ------------------------------------------------------------------------------------------------


def consistency(
    world: World, settings: EstimatorSettings, seeds: range, ticks: int, from_tick: int
) -> tuple[float, float]:
    """NEES of each drone's position over its three degrees of freedom, and position RMSE m, over the seeds."""
    squares, errors = [], []
    for seed in seeds:
        rng = np.random.default_rng([seed, 77])
        flight = fly(world, ticks, rng)
        start = flight.truth[0] + rng.normal(0.0, np.tile([2.0, 2.0, 2.0, 1.0, 1.0, 1.0], world.agents))
        estimates = estimated(flight, settings, start, world)
        for tick in range(from_tick, ticks + 1, 5):
            for slot in range(world.agents):
                at = slice(6 * slot, 6 * slot + 3)
                away = estimates[tick].mean[at] - flight.truth[tick][at]
                squares.append(away @ np.linalg.solve(estimates[tick].covariance[at, at], away) / 3.0)
                errors.append(away @ away)
    return float(np.mean(squares)), float(np.sqrt(np.mean(errors)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wander_m", "white", "least", "most"),
    [
        # receivers without wander are not quite trusted: 0.47
        (0.0, 1.0, 0.3, 0.8),
        # receivers whose claim covers a wander of its size: 1.2
        (0.8, 0.4, 0.6, 1.6),
        # those that claim their white noise alone and wander by more: 2.1 and 1.6, with odds of e^5 for them 13 and 2
        (0.8, 1.0, 0.8, 2.6),
        (1.5, 1.0, 0.8, 2.1),
    ],
)
def test_it_is_consistent_where_sensors_wander(wander_m: float, white: float, least: float, most: float) -> None:
    # GIVEN flights of 40 s in which receivers, accelerations and ranges have slow errors
    world = replace(WORLD, wander_m=wander_m, white=white)
    anees, rmse_m = consistency(world, default_settings(), range(16), 200, 100)
    # THEN the estimate knows, within these bands, how good it is
    assert least < anees < most
    assert rmse_m < (0.15 + 1.5 * wander_m if wander_m else 0.16)
    # and without slow errors it would not where they are large
    if wander_m > 1.0:
        without = msgspec.structs.replace(default_settings(), systematic_errors=False)
        assert consistency(world, without, range(4), 200, 100)[0] > 10.0


# --- barometers -------------------------------------------------------------------------------------------------

DRIFTING = replace(WORLD, wander_m=0.8, white=0.4, drift_m=3.0, scale=0.04)
"""Barometers as the estimator takes them to be: by its prior and time constant they walk 3 m in an hour."""
BLIND_FROM = 100


def blind_heights(world: World, seeds: range, ticks: int) -> tuple[float, float]:
    """NEES of the height of a drone without fixes from `BLIND_FROM` on, and its RMSE m, over the seeds."""
    squares, errors = [], []
    for seed in seeds:
        rng = np.random.default_rng([seed, 78])
        flight = fly(world, ticks, rng)
        for tick in range(BLIND_FROM, ticks + 1):
            rows = flight.rows[tick]
            fix = (rows["agent"] == 2) & np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY))
            flight.rows[tick] = rows[~fix]
        start = flight.truth[0] + rng.normal(0.0, np.tile([2.0, 2.0, 2.0, 1.0, 1.0, 1.0], world.agents))
        estimates = estimated(flight, default_settings(), start, world)
        for tick in range(BLIND_FROM + 25, ticks + 1, 5):
            away = estimates[tick].mean[14] - flight.truth[tick][14]
            squares.append(away**2 / estimates[tick].covariance[14, 14])
            errors.append(away**2)
    return float(np.mean(squares)), float(np.sqrt(np.mean(errors)))


@pytest.mark.parametrize(("offset_m", "pulled_m"), [(0.0, 1e-3), (7.0, 0.05)])
def test_heights_without_noise_are_what_they_are(offset_m: float, pulled_m: float) -> None:
    # GIVEN perfect sensors, and barometers that are off, and that alone
    exact = World(
        agents=2, period_s=0.2, claim_m=0.5, white=0.0, velocity_mps=0.0, range_m=0.0, accel_noise_mps2=0.0,
        drift_m=0.0, baro_m=0.0,
    )  # fmt: skip
    flight = fly(exact, 60, np.random.default_rng(4))
    for table in flight.rows:
        table["variance"] = np.maximum(table["variance"], 1e-4)
        table["value"][table["kind"] == Kind.HEIGHT] += offset_m
    for table in flight.inputs:
        table["variance"] = 1e-4
    estimates = estimated(flight, EXACT, flight.truth[0], exact)
    # THEN they take nothing away from the truth, but for what the prior of the offset pulls, which is less once the
    # receivers have been watched for eight seconds
    for tick in range(40, 61, 10):
        np.testing.assert_allclose(estimates[tick].mean, flight.truth[tick], rtol=0, atol=pulled_m)


@pytest.mark.slow
def test_a_barometer_holds_the_height_of_a_blind_drone_as_well_as_the_estimate_says() -> None:
    # GIVEN receivers that wander, barometers with offset, drift and scale, and a drone without fixes for 30 s
    anees, rmse_m = blind_heights(DRIFTING, range(12), 250)
    # THEN its height is better than without, and the estimate knows how good it is
    assert 0.25 < anees < 1.7  # of twelve flights whose errors last as long as they do
    assert rmse_m < 0.8 * blind_heights(replace(DRIFTING, drift_m=None), range(12), 250)[1]
