"""The estimator over everything that the fleet shared."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from estimators.estimator import Payload, Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import empty_inputs, empty_rows, input_rows, position_rows, velocity_rows
from estimators.model.motion import input_matrix, transition_matrix
from estimators.settings import EstimatorSettings
from sim_bridge.studies.lockstep import run_lockstep
from sim_bridge.studies.study_scenario import StudyScenario

SHARED = EstimatorSettings(
    kind="dmhe_shared", window=6, rounds=2, share_inputs="fleet", relay_hops=2, unknown_inputs="hold"
)
DT = 0.1


def kalman_step(mean, covariance, accel, accel_variance, jacobian, noise, measured):  # type: ignore[no-untyped-def]
    """Textbook prediction and update."""
    a, b = transition_matrix(1, DT), input_matrix(1, DT)
    mean, covariance = a @ mean + b @ accel, a @ covariance @ a.T + b @ np.diag(accel_variance) @ b.T
    gain = covariance @ jacobian.T @ np.linalg.inv(jacobian @ covariance @ jacobian.T + np.diag(noise))
    return mean + gain @ (measured - jacobian @ mean), (np.eye(6) - gain @ jacobian) @ covariance


@pytest.mark.parametrize("window", [1, 2, 5])
def test_on_a_linear_system_it_is_the_kalman_filter(window: int) -> None:
    # GIVEN one agent with position and velocity fixes: a linear system
    rng = np.random.default_rng(window)
    settings = msgspec.structs.replace(SHARED, window=window, tolerance=1e-12)
    prior = np.diag([4.0, 4.0, 9.0, 1.0, 1.0, 2.0])
    estimator = make_estimator(settings, Layout((1,)), 0, np.zeros(6), prior, DT)
    noise, accel_variance = np.array([0.04, 0.04, 0.09, 0.01, 0.01, 0.02]), np.full(3, 0.3)
    jacobian = np.eye(6)
    # the filter's first update is that of tick 0: a prediction over no time
    gain = prior @ np.linalg.inv(prior + np.diag(noise))
    for tick in range(15):
        measured, accel = rng.normal(size=6), rng.normal(size=3)
        rows = np.concatenate(
            [position_rows(tick, 0, measured[:3], noise[:3]), velocity_rows(tick, 0, measured[3:], noise[3:])]
        )
        inputs = input_rows(tick - 1, 0, accel, accel_variance) if tick else empty_inputs()
        estimator.begin(tick, rows, inputs)
        estimate = estimator.solve()
        if tick == 0:
            mean, covariance = gain @ measured, (np.eye(6) - gain) @ prior
            continue
        mean, covariance = kalman_step(mean, covariance, accel, accel_variance, jacobian, noise, measured)
        # THEN mean and covariance are the Kalman filter's
        assert estimate.mean == pytest.approx(mean, abs=1e-9)
        assert estimate.covariance == pytest.approx(covariance, abs=1e-9)


def test_rows_that_come_late_are_as_good_as_in_time() -> None:
    # GIVEN two agents' worth of fixes, one estimator with all in time, one with agent 2's two ticks late
    def fly(late: int) -> np.ndarray:
        rng = np.random.default_rng(4)
        estimator = make_estimator(SHARED, Layout((1, 2)), 0, np.zeros(12), np.eye(12), DT)
        waiting = []
        for tick in range(12):
            own = position_rows(tick, 0, rng.normal(size=3), np.full(3, 0.1))
            waiting.append((tick + late, position_rows(tick, 1, rng.normal(size=3), np.full(3, 0.1))))
            due = [rows for when, rows in waiting if when <= tick or tick == 11]
            waiting = [item for item in waiting if not (item[0] <= tick or tick == 11)]
            estimator.begin(tick, np.concatenate([own, *due]), empty_inputs())
            estimate = estimator.solve()
        return estimate.mean

    # THEN once everything is there both know the same
    assert fly(2) == pytest.approx(fly(0), abs=1e-9)


def test_a_lost_agent_grows_uncertain_and_old_and_a_neighbours_pair_brings_it_back() -> None:
    estimator = make_estimator(SHARED, Layout((1, 2)), 0, np.zeros(12), np.eye(12), DT)
    for tick in range(30):
        estimator.begin(tick, position_rows(tick, 0, np.zeros(3), np.full(3, 0.01)), empty_inputs())
        estimate = estimator.solve()
    assert estimate.status is Status.OK
    assert estimate.age_ticks.tolist() == [0, 30]
    lost = np.trace(estimate.covariance[6:9, 6:9])
    assert lost > 3.0
    # WHEN a neighbour's pair that knows agent 2 arrives
    estimator.begin(30, empty_rows(), empty_inputs())
    own = estimator.outgoing(0)
    known = own.information.copy()
    known[6:, 6:] += 100.0 * np.eye(6)
    estimator.mix(0, {1: Payload(own.tick, known, own.vector, 0)})
    found = estimator.solve()
    # THEN it is known here too, and the own block is no worse
    assert np.trace(found.covariance[6:9, 6:9]) < 0.5 * lost
    assert found.age_ticks[1] <= SHARED.window


def test_a_pair_of_another_window_start_is_not_used() -> None:
    estimator = make_estimator(SHARED, Layout((1, 2)), 0, np.zeros(12), np.eye(12), DT)
    for tick in range(2):
        estimator.begin(tick, empty_rows(), empty_inputs())
        own = estimator.outgoing(0)
        estimator.mix(0, {1: Payload(own.tick + 1, 1e6 * np.eye(12), np.zeros(12), 0)})
        assert estimator.outgoing(0).information == pytest.approx(own.information)
        estimator.solve()


@pytest.mark.slow
def test_it_is_consistent_and_near_the_centralised_filter_on_the_papers_fleet() -> None:
    runs = [StudyScenario().record(1, run) for run in range(4)]
    central = EstimatorSettings(kind="centralized_ekf", iterations_ekf=20)

    def steady(settings: EstimatorSettings) -> tuple[float, float]:
        errors, consistency = [], []
        for recording in runs:
            result = run_lockstep(recording, settings)
            assert recording.truth is not None
            assert result.nees_full is not None
            truth = recording.truth.reshape(recording.ticks + 1, 1, -1)
            errors.append(np.linalg.norm(result.mean - truth, axis=-1)[41:].mean())
            consistency.append(result.nees_full[41:].mean())
        return float(np.mean(errors)), float(np.mean(consistency))

    error_m, anees = steady(SHARED)
    assert error_m < 1.1 * steady(central)[0]
    assert 0.7 < anees < 1.6
