"""How far receivers wander, from simulated receivers whose wander and white noise are known."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.model.measurements import Kind, height_row
from estimators.systematic.receiver_wander import ReceiverWanders
from tests.support.wandering_fleet import WanderingFlight, World, fly

Array = NDArray[np.float64]
DT, TICKS, SEEDS = 0.1, 500, 20
BEFORE, AFTER = 299, 399
"""Ticks before and at the end of ten seconds of trouble."""


def flown(seed: int, wander_m: float, white: float = 1.0, agents: int = 1) -> WanderingFlight:
    world = World(agents=agents, period_s=DT, wander_m=wander_m, white=white, accel_mps2=0.2)
    return fly(world, TICKS, np.random.default_rng([seed, 5]))


def watched(flight: WanderingFlight) -> tuple[Array, Array]:
    """Sizes and white factors ``(T, n, 3)`` after each tick."""
    wanders = ReceiverWanders(flight.truth.shape[1] // 6, DT)
    sizes, factors = [], []
    for rows, accel, variance in zip(flight.rows, flight.accel, flight.accel_variance, strict=False):
        wanders.weigh(rows, accel, variance)
        sizes.append(wanders.sizes_m())
        factors.append(wanders.white_factors())
    return np.array(sizes), np.array(factors)


@lru_cache
def known_after_the_flight(wander_m: float, white: float) -> tuple[Array, Array]:
    """Horizontal sizes and factors of all seeds."""
    found = [watched(flown(seed, wander_m, white)) for seed in range(SEEDS)]
    return np.array([size[-1, 0, 0] for size, _ in found]), np.array([factor[-1, 0, 0] for _, factor in found])


@pytest.mark.parametrize(
    ("wander_m", "white", "least", "median", "most"),
    [
        # white noise alone, as claimed or more: next to none, a fifth of the claim (odds of e^2 at most speak for
        # such a receiver, as with e^5 one that does wander was believed); less: the rest of the claim is wander
        (0.0, 0.4, 0.3, (0.35, 0.4), 0.45),
        (0.0, 1.0, 0.0, (0.0, 0.08), 0.13),
        (0.0, 1.5, 0.0, (0.0, 0.08), 0.13),
        # half a metre, the claim's size: told where the white noise is small, in time where it is large
        (0.5, 0.4, 0.35, (0.4, 0.85), 1.0),
        (0.5, 1.0, 0.0, (0.2, 0.8), 1.0),
        (0.5, 1.5, 0.0, (0.02, 0.6), 0.9),
        # one and a half: always seen (one flight of 50 s has more or less of it)
        (1.5, 0.4, 0.7, (1.2, 1.7), 2.5),
        (1.5, 1.0, 0.5, (1.2, 1.7), 2.5),
        (1.5, 1.5, 0.3, (0.8, 1.7), 2.5),
    ],
)
def test_sizes_of_wander(
    wander_m: float, white: float, least: float, median: tuple[float, float], most: float
) -> None:
    sizes, _ = known_after_the_flight(wander_m, white)
    assert sizes.min() >= least
    assert median[0] <= np.median(sizes) <= median[1]
    assert sizes.max() <= most


@pytest.mark.parametrize("wander_m", [0.0, 0.5, 1.5])
@pytest.mark.parametrize(("white", "least", "most"), [(0.4, 0.33, 0.6), (1.0, 0.8, 1.2), (1.5, 1.3, 2.0)])
def test_the_white_noise_of_fixes_is_told_whatever_the_wander(
    wander_m: float, white: float, least: float, most: float
) -> None:
    _, factors = known_after_the_flight(wander_m, white)
    assert least <= np.median(factors) <= most
    assert factors.min() >= 0.34
    assert factors.max() <= 2.0


def spoiled(flight: WanderingFlight, what: str, rng: np.random.Generator) -> WanderingFlight:
    """With 3 % outliers, a jump for good, or fixes frozen for 10 s."""
    for k, rows in enumerate(flight.rows):
        fix = rows["kind"] == Kind.POSITION
        if what == "outliers" and rng.random() < 0.03:
            rows["value"][fix] += rng.choice([-30.0, 30.0])
        elif what == "jump" and k > BEFORE:
            rows["value"][fix] += 50.0
        elif what == "freeze" and BEFORE < k <= AFTER:
            rows["value"][fix] = flight.rows[BEFORE]["value"][fix]
    return flight


@pytest.mark.parametrize("what", ["outliers", "jump"])
@pytest.mark.parametrize(("wander_m", "least", "most"), [(0.0, 0.0, 0.13), (1.5, 0.7, 2.5)])
def test_outliers_and_a_jump_are_no_wander(what: str, wander_m: float, least: float, most: float) -> None:
    for seed in range(6):
        sizes, _ = watched(spoiled(flown(seed, wander_m), what, np.random.default_rng(seed)))
        assert sizes[BEFORE + 20 :, 0, 0].min() >= least
        assert sizes[BEFORE + 20 :, 0, 0].max() <= most


def test_a_frozen_receiver_wanders_far_and_is_trusted_again_in_time() -> None:
    # GIVEN a receiver that repeats one fix for ten seconds of flight
    for seed in range(6):
        sizes, _ = watched(spoiled(flown(seed, 0.0), "freeze", np.random.default_rng(seed)))
        assert sizes[BEFORE, 0, 0] <= 0.13
        # THEN within two seconds its wander is said to be large, and it stays that until the fixes move
        assert sizes[BEFORE + 21 : AFTER, 0, 0].min() > 1.0


def test_before_anything_was_seen_a_receiver_may_wander_by_a_metre() -> None:
    wanders = ReceiverWanders(3, DT)
    sizes, factors = wanders.sizes_m(), wanders.white_factors()
    assert (sizes > 0.5).all()
    assert (sizes < 2.0).all()
    assert ((factors > 0.5) & (factors < 2.0)).all()


@pytest.mark.parametrize("wander_m", [0.0, 1.5])
def test_a_few_fixes_do_not_tell_heights_that_a_barometer_will_hold(wander_m: float) -> None:
    # GIVEN the fixes of a flight, with a barometer and without
    held, alone = flown(1, wander_m), flown(1, wander_m)
    held.rows[0] = np.concatenate((held.rows[0], height_row(0, 0, 0.0, 1.0, drifts=True)))
    expected_m = ReceiverWanders(1, DT).sizes_m()[0, 0]
    with_one, without = watched(held)[0][:, 0], watched(alone)[0][:, 0]
    # THEN its heights are believed to wander less than expected only as far as they have been watched
    least_m = np.sqrt(np.maximum(1.0 - np.arange(1, TICKS + 1) / 40.0, 0.0)) * expected_m
    assert (with_one[:, 2] >= np.minimum(least_m, 2.5 * with_one[:, 0]) * (1.0 - 1e-9)).all()
    # and all else as without
    np.testing.assert_array_equal(with_one[:, :2], without[:, :2])
    late = slice(40, None)
    np.testing.assert_array_equal(with_one[late, 2], np.maximum(without[late, 2], 1.5 * without[late, 0]))
    assert (with_one[:40, 2] > without[:40, 2]).any()


def test_velocities_and_hard_bounds_alone_tell_nothing() -> None:
    flight = flown(1, 1.5)
    for rows in flight.rows:
        rows["half_width"][rows["kind"] == Kind.POSITION] = 1.0
    sizes, _ = watched(flight)
    np.testing.assert_array_equal(sizes[-1], ReceiverWanders(1, DT).sizes_m())


def test_the_vertical_wander_is_at_least_the_horizontal_one() -> None:
    sizes, _ = watched(flown(2, 0.8))
    assert (sizes[:, :, 2] >= sizes[:, :, 0]).all()
    assert (sizes[:, :, 2] <= 2.5 * sizes[:, :, 0] + 1e-12).all()
    np.testing.assert_array_equal(sizes[:, :, 0], sizes[:, :, 1])


def test_the_order_of_agents_and_the_direction_of_north_do_not_matter() -> None:
    # GIVEN a flight of three, seen by another order of agents and from a frame turned by a right angle
    flight, order = flown(3, 0.8, agents=3), np.array([2, 0, 1])
    place = np.argsort(order)
    sizes, factors = watched(flight)
    turned_rows = []
    for rows in flight.rows:
        turned = rows.copy()
        turned["agent"] = place[rows["agent"]]
        axial = np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY))
        turned["x"][axial], turned["y"][axial] = rows["y"][axial], rows["x"][axial]
        turned["value"] = np.where(axial & (rows["x"] == 1.0), -rows["value"], rows["value"])
        turned_rows.append(turned)
    accel = flight.accel.reshape(-1, 3, 3)[:, order][:, :, [1, 0, 2]] * (1.0, -1.0, 1.0)
    there = WanderingFlight(
        flight.truth, turned_rows, flight.inputs, np.ascontiguousarray(accel.reshape(-1, 9)), flight.accel_variance
    )
    again, factors_again = watched(there)
    np.testing.assert_allclose(again, sizes[:, order], rtol=1e-9)
    np.testing.assert_allclose(factors_again, factors[:, order], rtol=1e-9)


def test_who_stays_keeps_what_is_known_of_him() -> None:
    flight = flown(4, 1.5, agents=2)
    wanders = ReceiverWanders(2, DT)
    for rows, accel, variance in zip(flight.rows, flight.accel, flight.accel_variance, strict=False):
        wanders.weigh(rows, accel, variance)
    factors = wanders.white_factors()
    wanders.change_members({1: 0}, 3)
    np.testing.assert_array_equal(wanders.white_factors()[1], factors[0])
    np.testing.assert_array_equal(wanders.white_factors()[0], ReceiverWanders(1, DT).white_factors()[0])
