"""Where theory gives the answer: no noise, a linear system, least squares.

Closed loops are run at a tolerance of 1e-10 m; the agreement asked for is a digit above that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.algorithms.centralized import update
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import Kind, RowTable
from estimators.settings import EstimatorSettings
from estimators.settings import Kind as EstimatorKind
from estimators.window.problem import WindowProblem
from estimators.window.solving import solve_window
from sim_bridge.studies.lockstep import run_lockstep
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support import builders
from tests.support import dense_reference as dense

ESTIMATORS: tuple[EstimatorKind, ...] = ("dmhe_pre_ekf", "dmhe", "dmhe_shared", "dekf_ci", "centralized_ekf")
DT, EPS = 0.1, 1e-3
TIGHT = EstimatorSettings(tolerance=1e-10, max_iterations=500)


def settings_of(kind: EstimatorKind, window: int) -> EstimatorSettings:
    return EstimatorSettings(kind=kind, window=window, share_inputs="neighbours", tolerance=1e-10, max_iterations=500)


# --- without noise ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("kind", ESTIMATORS)
@pytest.mark.parametrize("graph", ["triangle", "K4"])
def test_exact_from_an_exact_start(graph: str, kind: EstimatorKind, window: int) -> None:
    # GIVEN a flight measured without noise, all inputs known to all, estimates that start at the truth
    recording = builders.noiseless(StudyScenario(graph=graph, samples=25).record(2, 0))
    assert recording.truth is not None
    # WHEN the fleet runs
    result = run_lockstep(recording, settings_of(kind, window))
    # THEN nobody ever leaves the truth
    error = result.mean - recording.truth.reshape(recording.ticks + 1, 1, -1)
    assert np.abs(error).max() < 1e-8
    assert (result.status == Status.OK).all()


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_a_wrong_start_is_forgotten(kind: EstimatorKind) -> None:
    # GIVEN the same without noise, every agent with a wrong start of its own, and an assumed input noise
    # (5 m/s2) that makes the past fade
    recording = builders.noiseless(StudyScenario(graph="triangle", samples=140).record(4, 0))
    wrong = recording.x0 + np.random.default_rng(1).uniform(-0.5, 0.5, recording.x0.shape)
    recording = replace(recording, x0=wrong, accel_half_width=5.0)
    # WHEN the fleet runs, THEN the estimates come to the truth and stay there
    result = run_lockstep(recording, settings_of(kind, 2))
    assert recording.truth is not None
    error = np.abs(result.mean - recording.truth.reshape(recording.ticks + 1, 1, -1)).max(axis=(1, 2))
    assert error[0] > 0.01
    assert error[-5:].max() < 1e-6


# --- a linear system --------------------------------------------------------------------------------------------


class LinearFlight:
    """A fleet whose rows are positions and velocities along any direction at any instant, with noise."""

    def __init__(self, seed: int, agents: int, ticks: int) -> None:
        rng = np.random.default_rng(seed)
        self.agents, self.ticks = agents, ticks
        truth, self.accel = builders.fly(rng, agents, ticks, DT)
        self.rows: list[RowTable] = []
        for k in range(ticks + 1):
            tables = [
                builders.row_of(kind, rng, k, s, agents, float(rng.uniform(-0.05, 0.05)))
                for s in range(agents)
                for kind in builders.LINEAR_KINDS
                if rng.random() < 0.8
            ]
            self.rows.append(builders.measured(builders.joined(tables), truth, EPS, rng))
        self.covariance = builders.random_covariance(rng, 6 * agents, 2.0)
        self.mean = truth[0] + np.linalg.cholesky(self.covariance) @ rng.normal(size=6 * agents)
        self.variance = 0.03

    def filter(self) -> dense.Kalman:
        return dense.Kalman(self.mean, self.covariance, DT, EPS)

    def advance(self, kalman: dense.Kalman, tick: int) -> None:
        """Predict to a tick; the update with its rows is left to the caller."""
        kalman.predict(self.accel[tick - 1], np.full(3 * self.agents, self.variance))

    def window(self, first: int, last: int, kalman: dense.Kalman, *, with_gains: bool) -> WindowProblem:
        """The window over ticks first..last with the filter's estimate of its first state as prior."""
        rows = self.rows[first : last + 1]
        information = np.linalg.inv(kalman.covariance)
        information = np.ascontiguousarray(0.5 * (information + information.T))
        return WindowProblem(
            rows=np.concatenate(rows),
            start=np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64),
            accel=np.ascontiguousarray(self.accel[first:last]),
            accel_variance=np.full((last - first, 3 * self.agents), self.variance),
            information=information,
            vector=information @ kalman.mean,
            keep=np.arange(self.agents),
            period_s=DT,
            with_gains=with_gains,
        )


@pytest.mark.parametrize(
    ("kind", "agents", "iterations"),
    [("dekf_ci", 1, 1), ("centralized_ekf", 1, 1), ("centralized_ekf", 3, 1), ("centralized_ekf", 3, 10)],
)
def test_filters_are_the_kalman_filter(kind: EstimatorKind, agents: int, iterations: int) -> None:
    # GIVEN a linear system and an estimator that hears everything there is
    flight = LinearFlight(agents, agents, 20)
    settings = EstimatorSettings(kind=kind, iterations_ekf=iterations)
    layout = Layout(tuple(range(1, agents + 1)))
    estimator = make_estimator(settings, layout, 0, flight.mean, flight.covariance, DT)
    # WHEN it runs
    estimates = builders.run_alone(
        estimator,
        lambda tick: flight.rows[tick],
        lambda tick: builders.all_inputs(tick, flight.accel, flight.variance),
        flight.ticks,
    )
    # THEN it is the Kalman filter
    kalman = flight.filter()
    for tick, estimate in enumerate(estimates):
        if tick:
            flight.advance(kalman, tick)
        kalman.update(flight.rows[tick])
        np.testing.assert_allclose(estimate.mean, kalman.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance, kalman.covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("window", [1, 2, 5])
def test_moving_horizon_with_the_filter_as_prior_is_the_kalman_filter(window: int) -> None:
    # GIVEN a linear system, and windows whose prior is the filter's prediction of their first state: what the
    # rows before the window say, and nothing of those in it
    flight = LinearFlight(10 + window, 2, 12)
    for last in range(window, flight.ticks + 1):
        kalman = flight.filter()
        for tick in range(last - window + 1):
            if tick:
                kalman.update(flight.rows[tick - 1])
                flight.advance(kalman, tick)
        # WHEN input corrections are variables (the full information of the window is used once)
        problem = flight.window(last - window, last, kalman, with_gains=False)
        solution = solve_window(problem, TIGHT)
        # THEN the window's last state is the filter's
        for tick in range(last - window, last + 1):
            if tick > last - window:
                flight.advance(kalman, tick)
            kalman.update(flight.rows[tick])
        np.testing.assert_allclose(solution.path[-1], kalman.mean, rtol=0, atol=1e-9)
        assert solution.status is Status.OK


def test_first_window_is_full_information() -> None:
    # GIVEN a linear system and one agent: at the first step nothing has been approximated yet
    flight = LinearFlight(21, 1, 8)
    settings = EstimatorSettings(kind="dmhe", window=8, tolerance=1e-10)
    estimator = make_estimator(settings, Layout((1,)), 0, flight.mean, flight.covariance, DT)
    estimates = builders.run_alone(
        estimator,
        lambda tick: flight.rows[tick],
        lambda tick: builders.all_inputs(tick, flight.accel, flight.variance),
        flight.ticks,
    )
    # THEN the estimate is the filter's with both ticks' rows
    kalman = flight.filter()
    kalman.update(flight.rows[0])
    flight.advance(kalman, 1)
    kalman.update(flight.rows[1])
    np.testing.assert_allclose(estimates[1].mean, kalman.mean, rtol=0, atol=1e-9)


# --- least squares ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
@pytest.mark.parametrize("seed", range(6))
def test_linear_window_is_the_normal_equations(seed: int, with_gains: bool) -> None:
    # GIVEN a window with linear rows only
    rng = np.random.default_rng(seed)
    problem, _ = builders.random_window(
        rng, agents=1 + seed % 4, ticks=1 + seed % 5, kinds=builders.LINEAR_KINDS, with_gains=with_gains
    )
    reference = dense.DenseWindow(problem, EPS)
    # THEN one solution of the normal equations is the optimum
    start = reference.start()
    hessian, slope = reference.normal_equations(start)
    z = start - np.linalg.solve(hessian, slope)
    solution = solve_window(problem, TIGHT)
    np.testing.assert_allclose(solution.path, reference.path(z), rtol=0, atol=1e-9)
    assert solution.report.cost == pytest.approx(reference.cost(z), rel=1e-9)
    np.testing.assert_allclose(
        solution.next_information, reference.next_information(solution.path), rtol=1e-9, atol=1e-6
    )


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
@pytest.mark.parametrize("seed", range(8))
def test_nonlinear_window_is_dense_least_squares(seed: int, with_gains: bool) -> None:
    # GIVEN a window with rows of all kinds, each at its own instant
    rng = np.random.default_rng(100 + seed)
    agents, ticks = 2 + seed % 3, 1 + seed % 4
    problem, _ = builders.random_window(rng, agents=agents, ticks=ticks, with_gains=with_gains, prior_scale=0.05)
    # WHEN the reference has converged
    reference = dense.DenseWindow(problem, EPS)
    optimum = reference.minimise()
    assert optimum.slope < 1e-9
    # THEN both are at one point
    solution = solve_window(problem, TIGHT)
    assert solution.status is Status.OK
    assert solution.report.cost == pytest.approx(optimum.cost, rel=1e-9)
    np.testing.assert_allclose(solution.path, optimum.path, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        solution.next_information, reference.next_information(optimum.path), rtol=1e-7, atol=1e-4
    )


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dmhe"])
def test_closed_loop_without_neighbours_is_the_dense_recursion(kind: EstimatorKind) -> None:
    # GIVEN a linear fleet of two and one estimator that hears all rows and inputs
    flight = LinearFlight(31, 2, 10)
    horizon = 3
    settings = EstimatorSettings(kind=kind, window=horizon, tolerance=1e-10)
    estimator = make_estimator(settings, Layout((1, 2)), 0, flight.mean, flight.covariance, DT)
    estimates = builders.run_alone(
        estimator,
        lambda tick: flight.rows[tick],
        lambda tick: builders.all_inputs(tick, flight.accel, flight.variance),
        flight.ticks,
    )
    # WHEN Algorithm 1 is run with dense matrices: the prior stays while the window grows, then (17)-(18)
    prior = flight.filter()
    for tick in range(1, flight.ticks + 1):
        first = max(0, tick - horizon)
        problem = flight.window(first, tick, prior, with_gains=kind == "dmhe_pre_ekf")
        reference = dense.DenseWindow(problem, EPS)
        optimum = reference.minimise()
        # THEN every estimate and its covariance (22) agree
        np.testing.assert_allclose(estimates[tick].mean, optimum.path[-1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimates[tick].covariance, reference.pre_covariance, rtol=0, atol=1e-9)
        if tick < horizon:
            prior.mean = optimum.path[0]
        else:
            prior.mean = optimum.path[1]
            prior.covariance = np.linalg.inv(reference.next_information(optimum.path))


def test_iterated_update_is_gauss_newton_to_convergence() -> None:
    # GIVEN a far prior and norm rows, where one linearisation is not enough
    rng = np.random.default_rng(5)
    mean = np.array([3.0, -2.0, 5.0, 1.0, 0.5, -1.0])
    rows = builders.joined([builders.row_of(Kind.ANCHOR_RANGE, rng, 0, 0, 1) for _ in range(5)])
    truth = mean + np.array([2.0, -1.0, 1.5, 0.0, 0.0, 0.0])
    rows = builders.measured(rows, truth[None], EPS, rng)
    covariance = builders.random_covariance(rng, 6, 4.0)
    plain, _ = update(mean, covariance, rows, EPS, 1)
    iterated, posterior = update(mean, covariance, rows, EPS, 50)

    # THEN the iterated one has no slope left, and the plain one has
    def newton_step(x: np.ndarray) -> np.ndarray:
        c = dense.jacobian(rows, x, EPS)
        weighted = c.T / rows["variance"]
        slope = np.linalg.solve(covariance, x - mean) - weighted @ (rows["value"] - dense.predicted(rows, x, EPS))
        return np.linalg.solve(np.linalg.inv(covariance) + weighted @ c, slope)

    assert np.abs(newton_step(iterated)).max() < 1e-8
    assert np.abs(newton_step(plain)).max() > 1e-3
    # and its covariance is linearised where it ended
    c = dense.jacobian(rows, iterated, EPS)
    expected = np.linalg.inv(np.linalg.inv(covariance) + (c.T / rows["variance"]) @ c)
    np.testing.assert_allclose(posterior, expected, rtol=0, atol=1e-7)
