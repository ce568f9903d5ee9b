"""What the linearisation of a range, or of a speed, misses."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.model.measurements import anchor_range_row, position_rows, range_row, speed_row, velocity_rows
from estimators.model.second_order import linearisation_variance
from tests.support.builders import random_covariance

EPS = 1e-3


def test_it_is_the_mean_square_of_the_second_order_term() -> None:
    # GIVEN two agents with a correlated covariance and a range between them at an instant off the tick
    rng = np.random.default_rng(3)
    state = rng.normal(size=12) * 8.0
    covariance = random_covariance(rng, 12, 0.5)
    offset = 0.04
    rows = np.concatenate(
        [
            range_row(0, 0, 1, 0.0, 0.01, offset_s=offset),
            anchor_range_row(0, 1, [1.0, 2.0, 3.0], 0.0, 0.01),
            speed_row(0, 1, 0.0, 0.01),
        ]
    )
    found = [linearisation_variance(row, state, covariance, EPS) for row in rows]

    # WHEN the term 1/2 delta' T delta is drawn, with T the numeric second derivative of the norm
    def second_derivative(place: np.ndarray) -> np.ndarray:
        def norm(x: np.ndarray) -> float:
            return float(np.sqrt(x @ x + EPS**2))

        step, out = 1e-3, np.empty((3, 3))
        for i in range(3):
            for j in range(3):
                a, b = step * np.eye(3)[i], step * np.eye(3)[j]
                out[i, j] = (
                    norm(place + a + b) - norm(place + a - b) - norm(place - a + b) + norm(place - a - b)
                ) / (4 * step * step)
        return out

    drawn = rng.multivariate_normal(np.zeros(12), covariance, 200_000)
    at_instant = np.hstack([np.eye(3), offset * np.eye(3)])
    between = np.hstack([at_instant, -at_instant])
    for found_here, matrix, place in (
        (found[0], between, between @ state),
        (found[1], np.hstack([np.zeros((3, 6)), np.eye(3), np.zeros((3, 3))]), state[6:9] - [1.0, 2.0, 3.0]),
        (found[2], np.hstack([np.zeros((3, 9)), np.eye(3)]), state[9:]),
    ):
        delta = drawn @ matrix.T
        term = 0.5 * np.einsum("ki,ij,kj->k", delta, second_derivative(place), delta)
        # THEN its mean square is what is given
        assert found_here == pytest.approx(float(np.mean(term**2)), rel=0.03)


def test_linear_rows_miss_nothing_and_known_states_next_to_nothing() -> None:
    nothing, one = np.zeros(3), np.ones(3)
    rows = np.concatenate([position_rows(0, 0, nothing, one), velocity_rows(0, 0, nothing, one)])
    state = np.arange(12.0)
    assert not any(linearisation_variance(row, state, 1e4 * np.eye(12), EPS) for row in rows)
    assert 0.0 < linearisation_variance(speed_row(0, 0, 7.0, 0.01)[0], state, 1e-3 * np.eye(12), EPS) < 1e-6
    assert 0.0 < linearisation_variance(range_row(0, 0, 1, 10.0, 0.01)[0], state, 1e-3 * np.eye(12), EPS) < 1e-6


def test_it_does_not_depend_on_names_place_or_north() -> None:
    rng = np.random.default_rng(8)
    state, covariance = rng.normal(size=12) * 5.0, random_covariance(rng, 12, 2.0)
    before = linearisation_variance(range_row(0, 0, 1, 9.0, 0.01)[0], state, covariance, EPS)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    full = np.kron(np.eye(4), turn)
    moved = full @ state + np.tile([3.0, -1.0, 7.0, 0.0, 0.0, 0.0], 2)
    swap = np.r_[6:12, 0:6]
    after = linearisation_variance(
        range_row(0, 1, 0, 9.0, 0.01)[0], moved[swap], (full @ covariance @ full.T)[np.ix_(swap, swap)], EPS
    )
    assert after == pytest.approx(before, rel=1e-9)
