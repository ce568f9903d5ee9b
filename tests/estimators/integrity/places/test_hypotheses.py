"""The Gaussian mixture over one drone's state."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.integrity.places.hypotheses import (
    MERGED_SQUARE,
    MOST,
    Drift,
    Mixture,
    correct_linear,
    correct_range,
    is_sound,
    on_sphere,
    predict,
    reduce,
    split,
)
from estimators.model.motion import input_matrix, transition_matrix
from tests.support.builders import random_covariance

NOWHERE = np.zeros((6, 6))


def moments(mixture: Mixture) -> tuple[np.ndarray, np.ndarray]:
    mean = mixture.weights @ mixture.means
    return mean, mixture.second_moment(mean)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_splitting_and_merging_keep_the_moments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 6))
    mixture = Mixture(
        rng.normal(size=count),
        rng.normal(size=(count, 6)) * 3.0,
        np.array([random_covariance(rng, 6, 2.0) for _ in range(count)]),
    )
    before = moments(mixture)
    split(mixture, rng.normal(size=3) * 10.0, 0.8, rng.normal(size=3))
    assert count <= len(mixture.log_weights) <= MOST
    assert is_sound(mixture)
    assert (np.linalg.eigvalsh(mixture.covariances) > 0).all()
    for now, then in zip(moments(mixture), before, strict=True):
        assert now == pytest.approx(then, abs=1e-9)
    pruned = mixture.weights.min() < 1e-6
    reduce(mixture)
    assert mixture.weights.sum() == pytest.approx(1.0)
    if not pruned:
        for now, then in zip(moments(mixture), before, strict=True):
            assert now == pytest.approx(then, abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([6, 9]))
def test_the_likeliest_takes_in_who_is_near_it_then_the_next_one_that_is_left(seed: int, states: int) -> None:
    # GIVEN components about a few places; the definition says which of them belong together
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 20))
    spots = rng.normal(size=(4, states)) * 2.0
    means = spots[rng.integers(0, 4, count)] + rng.normal(size=(count, states)) * 0.3
    covariances = np.array([random_covariance(rng, states, 1.0) for _ in range(count)])
    mixture = Mixture(rng.normal(size=count), means, covariances)
    left, wanted = np.argsort(-mixture.log_weights).tolist(), []
    while left:
        inverse = np.linalg.inv(covariances[left[0]])
        square = [float((means[j] - means[left[0]]) @ inverse @ (means[j] - means[left[0]])) for j in left]
        group = [j for j, each in zip(left, square, strict=True) if each < MERGED_SQUARE]
        alone = Mixture(mixture.log_weights[group], means[group], covariances[group])
        wanted.append((mixture.weights[group].sum(), *moments(alone)))
        left = [j for j in left if j not in group]
    # WHEN they are merged
    reduce(mixture)
    # THEN so they are
    assert len(mixture.log_weights) == len(wanted)
    for k, (weight, mean, spread) in enumerate(wanted):
        assert mixture.weights[k] == pytest.approx(weight)
        np.testing.assert_allclose(mixture.means[k], mean, atol=1e-9)
        np.testing.assert_allclose(mixture.covariances[k], spread, atol=1e-9)


def test_one_component_is_a_kalman_filter() -> None:
    rng = np.random.default_rng(2)
    mean, covariance = rng.normal(size=6), random_covariance(rng, 6)
    accel, noise = rng.normal(size=3), np.array([0.1, 0.2, 0.3])
    slope, value, variance = rng.normal(size=6), 1.7, 0.3
    mixture = Mixture.single(mean, covariance)
    predict(mixture, accel, noise, 0.1)
    a, b = transition_matrix(1, 0.1), input_matrix(1, 0.1)
    mean, covariance = a @ mean + b @ accel, a @ covariance @ a.T + b @ np.diag(noise) @ b.T
    correct_linear(mixture, slope, value, variance)
    total = slope @ covariance @ slope + variance
    gain = covariance @ slope / total
    innovation = value - slope @ mean
    assert mixture.means[0] == pytest.approx(mean + gain * innovation)
    assert mixture.covariances[0] == pytest.approx(covariance - np.outer(gain, slope) @ covariance)
    # THEN the weight is the density of the datum, up to a constant
    assert mixture.log_weights[0] == pytest.approx(-0.5 * (innovation**2 / total + np.log(total)))


def test_the_error_of_an_acceleration_lasts_and_moves_the_drone_by_what_it_is_told_too_much() -> None:
    rng = np.random.default_rng(5)
    mean, covariance = rng.normal(size=9), random_covariance(rng, 9)
    accel, noise, drift = rng.normal(size=3), np.array([0.1, 0.2, 0.3]), Drift(0.97, np.array([0.3, 0.4, 0.5]))

    def moved(state: np.ndarray) -> np.ndarray:
        net = accel - state[6:]
        place = state[:3] + 0.1 * state[3:6] + 0.5 * 0.1**2 * net
        return np.concatenate([place, state[3:6] + 0.1 * net, 0.97 * state[6:]])

    mixture = Mixture.single(mean, covariance)
    predict(mixture, accel, noise, 0.1, drift)
    slope = np.array([moved(step) - moved(np.zeros(9)) for step in np.eye(9)]).T
    expected = slope @ covariance @ slope.T
    expected[:6, :6] += input_matrix(1, 0.1) @ np.diag(noise) @ input_matrix(1, 0.1).T
    expected[6:, 6:] += (1.0 - 0.97**2) * np.diag(drift.size_mps2**2)
    assert mixture.means[0] == pytest.approx(moved(mean))
    assert mixture.covariances[0] == pytest.approx(expected)
    # THEN an error of stationary size keeps it
    alone = Mixture.single(np.zeros(9), np.diag([1.0] * 6 + [0.3**2, 0.4**2, 0.5**2]))
    predict(alone, accel, noise, 0.1, drift)
    assert alone.covariances[0, 6:, 6:] == pytest.approx(np.diag(drift.size_mps2**2))


def test_rows_correct_the_error_of_an_acceleration_through_what_it_has_done() -> None:
    rng = np.random.default_rng(6)
    covariance, drift = np.diag([1e-4] * 6 + [0.16] * 3), Drift(1.0, np.full(3, 0.4))
    error, truth = np.array([0.3, -0.2, 0.1]), np.zeros(6)
    mixture = Mixture.single(np.concatenate([[5.0, 6.0, 7.0], np.zeros(6)]), covariance)
    truth[:3] = [5.0, 6.0, 7.0]
    places = 20.0 * np.vstack([np.eye(3), -np.eye(3)])
    for _ in range(60):
        truth[:3] += 0.1 * truth[3:]
        predict(mixture, error, np.full(3, 1e-4), 0.1, drift)  # at rest, told of an acceleration
        for place in places:
            value = float(np.linalg.norm(truth[:3] - place)) + 0.02 * float(rng.normal())
            correct_range(mixture, np.concatenate([place, np.zeros(3)]), NOWHERE, value, 0.02**2)
        correct_linear(mixture, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), 0.0, 0.1)
    off = mixture.means[0, 6:] - error
    assert np.abs(off).max() < 0.05
    assert 0.01 < off @ np.linalg.solve(mixture.covariances[0, 6:, 6:], off) < 14.0


def test_a_range_from_far_is_a_linear_row() -> None:
    # GIVEN a body so far away that its range is linear in the own state, at an instant off the tick
    rng = np.random.default_rng(4)
    mean, covariance = rng.normal(size=6), random_covariance(rng, 6)
    unit = np.array([2.0, -1.0, 2.0]) / 3.0
    place = np.concatenate([-1e7 * unit, [0.5, 0.2, -0.1]])
    spread = random_covariance(rng, 6, 0.2)
    lever = np.concatenate([unit, 0.05 * unit])
    one, other = Mixture.single(mean, covariance), Mixture.single(mean, covariance)
    correct_range(one, place, spread, 1e7 + 0.4, 0.1, 0.05)
    correct_linear(other, lever, lever @ place + 1e7 + 0.4, 0.1 + lever @ spread @ lever)
    assert one.means == pytest.approx(other.means, abs=1e-5)
    assert one.covariances == pytest.approx(other.covariances, abs=1e-5)


def test_the_slope_of_a_range_is_its_numeric_derivative() -> None:
    rng = np.random.default_rng(7)
    state, place, offset = rng.normal(size=6) * 3.0, rng.normal(size=6) * 3.0, -0.07

    def distance(x: np.ndarray) -> float:
        return float(np.linalg.norm(x[:3] + offset * x[3:] - place[:3] - offset * place[3:]))

    steps = 1e-5 * np.eye(6)
    numeric = np.array([(distance(state + step) - distance(state - step)) / 2e-5 for step in steps])
    # GIVEN a state known so well that a correction moves it along the slope alone, by covariance times innovation
    small = 1e-8
    mixture = Mixture.single(state, small * np.eye(6))
    correct_range(mixture, place, NOWHERE, distance(state) + 1.0, 1.0, offset)
    assert (mixture.means[0] - state) / small == pytest.approx(numeric, abs=1e-6)


def test_three_ranges_leave_two_places_and_the_prior_weighs_them() -> None:
    # GIVEN a wide belief and three bodies in a plane; the truth above it
    truth = np.array([1.0, 2.0, -6.0, 0.0, 0.0, 0.0])
    places = np.array([[8.0, 0.0, 0.0], [-6.0, 7.0, 0.0], [-5.0, -8.0, 0.0]])
    ranges = np.linalg.norm(truth[:3] - places, axis=-1)
    start, wide = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]), np.diag([400.0, 400.0, 400.0, 1.0, 1.0, 1.0])
    order = np.argsort(ranges)
    first = order[0]
    mixture = on_sphere(start, wide, places[first], ranges[first], 0.01, places[order[1]] - places[first])
    # WHEN ten ticks of the same ranges are used
    for _ in range(10):
        predict(mixture, np.zeros(3), np.full(3, 1e-4), 0.1)
        split(mixture, places[first], 1.0, places[order[1]] - places[first])
        for at in order:
            correct_range(mixture, np.concatenate([places[at], np.zeros(3)]), NOWHERE, ranges[at], 0.01)
        reduce(mixture)
    # THEN the truth and its mirror image are left, about as likely as each other
    sides = [np.abs(mixture.means[:, :3] - [1.0, 2.0, z]).max(axis=-1) < 0.5 for z in (-6.0, 6.0)]
    held = [float(mixture.weights[side].sum()) for side in sides]
    assert sum(held) > 0.98
    assert min(held) > 0.1


def test_it_does_not_depend_on_north() -> None:
    rng = np.random.default_rng(6)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    centre, other = np.array([5.0, 1.0, -3.0]), np.array([-4.0, 6.0, 2.0])
    mean, covariance = rng.normal(size=6), 9.0 * np.eye(6)

    def run(rotation: np.ndarray) -> Mixture:
        full = np.kron(np.eye(2), rotation)
        mixture = on_sphere(
            full @ mean, full @ covariance @ full.T, rotation @ centre, 7.0, 0.01, rotation @ (other - centre)
        )
        split(mixture, rotation @ centre, 1.0, rotation @ (other - centre))
        correct_range(mixture, full @ np.r_[other, 0, 0, 0], NOWHERE, 8.0, 0.01)
        reduce(mixture)
        return mixture

    straight, turned = run(np.eye(3)), run(turn)
    full = np.kron(np.eye(2), turn)
    assert len(straight.weights) == len(turned.weights)
    assert turned.weights @ turned.means == pytest.approx(full @ (straight.weights @ straight.means), abs=1e-6)
    about = straight.means[0]
    expected = full @ straight.second_moment(about) @ full.T
    assert turned.second_moment(full @ about) == pytest.approx(expected, abs=1e-5)
