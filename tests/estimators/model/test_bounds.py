"""Posterior Cramer-Rao bound: the Kalman filter's covariance where all is linear, the known figures where not."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.model.cramer_rao import (
    Flight,
    mean_row_information,
    posterior_information,
    rms_bound,
    row_information,
)
from estimators.model.layout import position, velocity
from estimators.model.measurements import empty_rows, position_rows
from sim_bridge.studies.lockstep import own_rows
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support import builders
from tests.support.dense_reference import Kalman

EPS = 1e-3


def test_linear_rows_give_the_kalman_covariance() -> None:
    # GIVEN rows whose information does not depend on the state
    rng = np.random.default_rng(1)
    truth, _ = builders.fly(rng, 2, 6, 0.1)
    rows = [
        builders.joined([builders.row_of(kind, rng, k, s, 2, 0.02) for s in (0, 1) for kind in builders.LINEAR_KINDS])
        for k in range(7)
    ]
    variance = np.exp(rng.uniform(-5, 0, (6, 6)))
    filter_ = Kalman(truth[0], builders.random_covariance(rng, 12), 0.1)
    # WHEN the bound is computed
    measured = mean_row_information([(rows, truth)], EPS)
    found = posterior_information(measured, variance, np.linalg.inv(filter_.covariance), 0.1)
    # THEN it is the covariance of the filter that attains it, at every tick
    for k in range(7):
        if k:
            filter_.predict(np.zeros(6), variance[k - 1])
        filter_.update(rows[k])
        np.testing.assert_allclose(np.linalg.inv(found[k]), filter_.covariance, rtol=0, atol=1e-11)


def test_one_fix_by_hand() -> None:
    # GIVEN a prior of 1 m and 1 m/s, a fix of variance 1/3 m2 at each of two ticks of 1 s, no input noise
    rows = [position_rows(k, 0, np.zeros(3), np.full(3, 1 / 3)) for k in (0, 1)]
    measured = mean_row_information([(rows, np.zeros((2, 6)))], EPS)
    found = posterior_information(measured, np.zeros((1, 3)), np.eye(6), 1.0)
    # THEN per axis: first diag(1 + 3, 1); predicted covariance [[1/4 + 1, 1], [1, 1]], updated by 3
    np.testing.assert_allclose(found[0], np.diag([4.0] * 3 + [1.0] * 3), atol=1e-12)
    axis = np.linalg.inv(np.array([[1.25, 1.0], [1.0, 1.0]])) + np.diag([3.0, 0.0])
    np.testing.assert_allclose(found[1][np.ix_([0, 3], [0, 3])], axis, atol=1e-12)
    np.testing.assert_allclose(rms_bound(found, position(0))[0], np.sqrt(3 / 4))
    np.testing.assert_allclose(rms_bound(found, velocity(0))[0], np.sqrt(3))
    np.testing.assert_allclose(rms_bound(found)[0], np.sqrt(3 / 4 + 3))


def test_rows_add_what_they_know() -> None:
    rows = position_rows(0, 1, np.zeros(3), np.array([0.5, 0.25, 0.2]))
    expected = np.zeros((12, 12))
    expected[6:9, 6:9] = np.diag([2.0, 4.0, 5.0])
    np.testing.assert_allclose(row_information(rows, np.zeros(12), EPS), expected, atol=1e-12)


def flight(recording: StudyInput) -> Flight:
    """Rows and true states of a recording, everybody's."""
    assert recording.truth is not None
    ticks, n, _ = recording.truth.shape
    rows = [builders.joined([own_rows(recording, k, s) for s in range(n)]) for k in range(ticks)]
    return rows, recording.truth.reshape(ticks, -1)


def test_the_average_is_over_flights() -> None:
    recordings = [StudyScenario(samples=3).record(1, run) for run in range(2)]
    single = [mean_row_information([flight(each)], EPS) for each in recordings]
    both = mean_row_information([flight(each) for each in recordings], EPS)
    np.testing.assert_allclose(both, 0.5 * (single[0] + single[1]), rtol=1e-14)


def test_steady_bound_of_the_line_of_three() -> None:
    # GIVEN twenty flights of the studies' line of three, good start, all inputs known
    recordings = [StudyScenario(graph="line").record(0, run) for run in range(20)]
    measured = mean_row_information([flight(each) for each in recordings], EPS)
    variance = np.full((70, 9), 0.1**2 / 3)
    # WHEN the bound is computed
    found = posterior_information(measured, variance, np.linalg.inv(recordings[0].P0), 0.1)[41:]
    # THEN the steady rms of the fleet state, of an agent's own position and of its own velocity are the figures of an
    # independent computation over other flights, which has two digits
    assert np.sqrt(np.mean(rms_bound(found) ** 2)) == pytest.approx(0.082, abs=0.001)
    for slot in range(3):
        assert 0.032 < np.mean(rms_bound(found, position(slot))) < 0.037
        assert np.mean(rms_bound(found, velocity(slot))) == pytest.approx(0.031, abs=0.002)


def test_what_cannot_be_bounded_is_refused() -> None:
    two = np.zeros((2, 6, 6))
    with pytest.raises(ValueError, match="expected input variances of 1 ticks, found 2"):
        posterior_information(two, np.ones((2, 3)), np.eye(6), 0.1)
    with pytest.raises(ValueError, match="at least one flight"):
        mean_row_information([], EPS)
    with pytest.raises(ValueError, match=r"flight 1: .* found 3 and 3"):
        mean_row_information([([empty_rows()] * t, np.zeros((t, 6))) for t in (2, 3)], EPS)
    with pytest.raises(np.linalg.LinAlgError):
        posterior_information(two, np.ones((1, 3)), np.zeros((6, 6)), 0.1)
