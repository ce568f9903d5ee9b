"""Numeric twins: every derivative that the kernels compute against finite differences of what it derives.

Values themselves are held to the dense reference, so that a row cannot be wrong in value and gradient alike.
Central differences of smooth functions with step 1e-5 carry a truncation of about 1e-10 relative to the third
derivative and a rounding of about 1e-11 times the function; the tolerances below leave one or two digits more.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.algorithms.dekf_ci import predict_and_correct
from estimators.compiled.entries import plain
from estimators.integrity.observability import observability_matrix, row_jacobian
from estimators.model.measurements import Kind, empty_rows
from estimators.model.motion import input_matrix, predict_mean, transition_matrix
from estimators.solvers.constrained_kernels import BoundPoint, LinearProgram, evaluate, linearise_bounds, prepare
from estimators.solvers.gauss_newton import set_weights
from estimators.window.least_squares import correction_hessian, empty_trajectory, gradient, hessian, roll_out
from estimators.window.problem import CORRECTED, NOTHING, PREDICTED, StepOptions, WindowProblem
from estimators.window.solving import pre_estimation
from tests.support import builders
from tests.support import dense_reference as dense

Array = NDArray[np.float64]
STEP = 1e-5
EPS = 0.1
"""Smoothing of the norms here: with 1e-3 a coincident pair has third derivatives of 1e6, beyond differences."""


def differences(function: Callable[[Array], Array], x: Array) -> Array:
    """Central differences, one column a variable."""
    columns = []
    for j in range(len(x)):
        push = np.zeros(len(x))
        push[j] = STEP
        columns.append((function(x + push) - function(x - push)) / (2 * STEP))
    return np.array(columns).T


class Kernels:
    """The compiled window of a problem, called at one z after the other."""

    def __init__(self, problem: WindowProblem, eps: float) -> None:
        options = StepOptions(eps, NOTHING, np.inf, np.inf, 1, 1e-6)
        prepared = prepare(plain(problem), plain(options), np.zeros_like(problem.vector))
        assert prepared.region.definite, "the prior is definite"
        assert prepared.region.outside == 0, "all agents are in the rows, in their own order"
        self.window = prepared.window
        self.rows, self.states = len(problem.rows), (len(problem.accel) + 1, len(problem.vector))

    def values(self, z: Array, bounds_on: int) -> tuple[float, Array, Array]:
        states, bounded = np.empty(self.states), np.empty(self.rows)
        return evaluate(plain(self.window), z, bounds_on, states, bounded), states, bounded

    def derivatives(
        self, z: Array, bounds_on: int, row_force: Array, state_force: Array, *, exact: bool
    ) -> tuple[Array, Array, Array, Array]:
        """Slope, curvature, sensitivities and bound slopes."""
        n = len(z)
        linear, inverse_root = np.empty(n), np.empty((n, n))
        rows = np.empty((self.rows + self.states[0] * self.states[1], n))
        point = BoundPoint(z, row_force, state_force, bounds_on, True)
        made = LinearProgram(linear, inverse_root, rows)
        assert linearise_bounds(plain(self.window), plain(point), exact, plain(made))
        root = np.linalg.inv(inverse_root)  # the program is in the variables U step: back to z
        scaled = rows @ root
        return root.T @ linear, root.T @ root, scaled[self.rows :], scaled[: self.rows]

    def plain(self, z: Array, *, exact: bool) -> tuple[Array, Array, Array, Array]:
        return self.derivatives(z, CORRECTED, np.zeros(self.rows), np.zeros(self.states), exact=exact)


def window_at_a_point(seed: int, kinds: tuple[Kind, ...], *, with_gains: bool) -> tuple[WindowProblem, Array]:
    """A window of two agents and two ticks, and a z away from its optimum.

    The prior is strong enough that the exact Hessian is definite there: its factor is what the kernels give.
    """
    rng = np.random.default_rng(seed)
    problem, truth = builders.random_window(
        rng, agents=2, kinds=kinds, rows_per_agent=3, with_gains=with_gains, eps=EPS, prior_scale=1e-4
    )
    z = truth[0] + 0.3 * rng.normal(size=12)
    return problem, z if with_gains else np.concatenate([z, 0.5 * rng.normal(size=problem.accel.size)])


SITUATIONS = {
    "apart": np.array([1.0, -2.0, 3.0, 0.5, -1.5, 0.7, -4.0, 6.0, 2.0, -0.4, 0.2, 1.1]),
    "coincident": np.tile([1.0, -2.0, 3.0, 0.5, -1.5, 0.7], 2),
    "at rest": np.array([1.0, -2.0, 3.0, 0.0, 0.0, 0.0, -4.0, 6.0, 2.0, 0.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("offset_s", [0.0, 0.04, -0.05])
@pytest.mark.parametrize("situation", SITUATIONS)
@pytest.mark.parametrize("kind", Kind, ids=lambda kind: kind.name)
def test_value_and_gradient_of_a_row(kind: Kind, situation: str, offset_s: float) -> None:
    # GIVEN a row of any kind at its own instant, also where a norm has no direction
    rng = np.random.default_rng(int(kind))
    row = builders.row_of(kind, rng, 0, 0, 2, offset_s)
    state = SITUATIONS[situation]
    if kind is Kind.ANCHOR_RANGE and situation == "coincident":  # with the anchor
        row["x"], row["y"], row["z"] = state[:3] + offset_s * state[3:6]
    # WHEN it is linearised
    value, gradient = row_jacobian(row, state, EPS)
    # THEN its value is that of the reference, and its gradient that of differences
    np.testing.assert_allclose(value, dense.predicted(row, state, EPS), rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        gradient, differences(lambda x: dense.predicted(row, x, EPS), state), rtol=0, atol=2e-8
    )


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
@pytest.mark.parametrize(
    "kinds", [(kind,) for kind in Kind] + [builders.ALL_KINDS], ids=lambda kinds: "+".join(k.name for k in kinds)
)
def test_window_gradient_and_hessians(kinds: tuple[Kind, ...], with_gains: bool) -> None:
    # GIVEN a window whose rows are of one kind, or of all
    problem, z = window_at_a_point(sum(kinds), kinds, with_gains=with_gains)
    kernels = Kernels(problem, EPS)
    reference = dense.DenseWindow(problem, EPS)
    # THEN its objective is half the cost of the reference
    f, states, _ = kernels.values(z, CORRECTED)
    assert f == pytest.approx(0.5 * reference.cost(z), rel=1e-11)
    np.testing.assert_allclose(states, reference.path(z), rtol=0, atol=1e-11)
    # and its derivatives are those of differences: the gradient of the value, the Hessian of the gradient
    slope, exact, sens, _ = kernels.plain(z, exact=True)
    scale = np.abs(exact).max()
    numeric_slope = differences(lambda at: np.array([kernels.values(at, CORRECTED)[0]]), z)[0]
    np.testing.assert_allclose(slope, numeric_slope, rtol=0, atol=1e-7 * scale)
    numeric = differences(lambda at: kernels.plain(at, exact=False)[0], z)
    np.testing.assert_allclose(exact, numeric, rtol=0, atol=1e-7 * scale)
    # and Gauss-Newton is what the reference calls so, the sensitivities with it
    normal, dense_slope = reference.normal_equations(z)
    np.testing.assert_allclose(slope, dense_slope, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(kernels.plain(z, exact=False)[1], normal, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(sens, np.concatenate(reference.sensitivities(z)), rtol=0, atol=1e-11)


@pytest.mark.parametrize("exact", [False, True], ids=["Gauss-Newton", "exact"])
def test_without_gains_the_adjoint_recursion_gives_the_hessian(exact: bool) -> None:
    # GIVEN a window of input corrections at a point
    problem, z = window_at_a_point(2, builders.ALL_KINDS, with_gains=False)
    window = Kernels(problem, EPS).window
    path, slope = empty_trajectory(window), np.empty(len(z))
    roll_out(window, z, path)
    set_weights(window, path)
    gradient(window, z, path, slope)
    # WHEN its Hessian is computed through sensitivities and by the adjoint recursion
    expected, found = np.empty((len(z), len(z))), np.empty((len(z), len(z)))
    hessian(window, path, exact, expected, np.empty((path.states.size, len(z))))
    correction_hessian(window, path, exact, found)
    # THEN they are the same
    scale = np.abs(np.triu(expected)).max()
    np.testing.assert_allclose(np.triu(found), np.triu(expected), rtol=0, atol=1e-13 * scale)


def test_hessian_of_coincident_agents_at_rest() -> None:
    # GIVEN two agents at one place without speed, all rows norms that have no direction there
    problem, _ = window_at_a_point(5, (Kind.SPEED, Kind.RANGE), with_gains=True)
    problem.rows["value"] = 0.0  # below the norms: their curvature, 1/eps in all directions, counts positive
    z = np.tile([1.0, -2.0, 3.0, 0.0, 0.0, 0.0], 2)
    kernels = Kernels(problem, EPS)
    _, exact, _, _ = kernels.plain(z, exact=True)
    numeric = differences(lambda at: kernels.plain(at, exact=False)[0], z)
    np.testing.assert_allclose(exact, numeric, rtol=0, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("bounds_on", "with_gains"),
    [(CORRECTED, True), (PREDICTED, True), (CORRECTED, False)],
    ids=["corrected", "predicted", "input corrections"],
)
def test_bound_slopes_and_the_lagrangian(bounds_on: int, with_gains: bool) -> None:
    # GIVEN multipliers on all bounded residuals after the first tick, and on all states
    problem, z = window_at_a_point(11, builders.ALL_KINDS, with_gains=with_gains)
    kernels = Kernels(problem, EPS)
    rng = np.random.default_rng(12)
    row_force = np.where(np.arange(kernels.rows) >= problem.start[1], 50 * rng.normal(size=kernels.rows), 0.0)
    state_force = 50 * rng.normal(size=kernels.states)

    def at(point: Array, *, exact: bool) -> tuple[Array, Array, Array, Array]:
        return kernels.derivatives(point, bounds_on, row_force, state_force, exact=exact)

    # WHEN the bounds are linearised
    _, curvature, sens, slopes = at(z, exact=True)
    # THEN their slopes are differences of the bounded residuals (there are none in the first tick)
    numeric = differences(lambda point: kernels.values(point, bounds_on)[2], z)
    numeric[: problem.start[1]] = 0.0
    np.testing.assert_allclose(slopes, numeric, rtol=0, atol=1e-8)
    numeric_sens = differences(lambda point: kernels.values(point, bounds_on)[1].ravel(), z)
    np.testing.assert_allclose(sens, numeric_sens, rtol=0, atol=1e-8)

    # and the curvature is that of the Lagrangian
    def lagrangian_slope(point: Array) -> Array:
        slope, _, along, rows = at(point, exact=False)
        return slope + row_force @ rows + state_force.ravel() @ along

    np.testing.assert_allclose(
        curvature, differences(lagrangian_slope, z), rtol=0, atol=1e-7 * np.abs(curvature).max()
    )


def test_prediction_of_the_mean() -> None:
    rng = np.random.default_rng(1)
    x, accel = rng.normal(size=18), rng.normal(size=9)
    expected = dense.transition(3, 0.2) @ x + dense.inputs(3, 0.2) @ accel
    np.testing.assert_allclose(predict_mean(x, accel, 0.2), expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(transition_matrix(3, 0.2), dense.transition(3, 0.2))
    np.testing.assert_allclose(input_matrix(3, 0.2), dense.inputs(3, 0.2), rtol=1e-15)


@pytest.mark.parametrize("agents", [1, 3, 10, 28])
@pytest.mark.parametrize("variance", ["mixed", "zero", "huge"])
def test_prediction_of_information(agents: int, variance: str) -> None:
    # GIVEN an information matrix and input noise of any size (28 agents: beyond where LAPACK takes over)
    rng = np.random.default_rng(agents)
    covariance = builders.random_covariance(rng, 6 * agents)
    information = np.linalg.inv(covariance)
    information = 0.5 * (information + information.T)
    spread = {"mixed": np.exp(rng.uniform(-6, 1, 3 * agents)), "zero": np.zeros(3 * agents)}.get(
        variance, np.full(3 * agents, 1e6)
    )
    # WHEN it is predicted over a tick without rows
    mean, accel = rng.normal(size=6 * agents), rng.normal(size=3 * agents)
    expected_mean = predict_mean(mean, accel, 0.1)
    vector = np.empty_like(mean)
    assert predict_and_correct(empty_rows(), accel, spread, 0.1, 1e-3, True, mean, information, vector)
    # THEN it is the inverse of A P A' + B Q B', and the pair holds the predicted mean
    a, b = dense.transition(agents, 0.1), dense.inputs(agents, 0.1)
    expected = np.linalg.inv(a @ covariance @ a.T + b @ np.diag(spread) @ b.T)
    np.testing.assert_allclose(information, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(information, information.T)
    np.testing.assert_allclose(mean, expected_mean, rtol=0, atol=1e-14)
    np.testing.assert_allclose(vector, information @ mean, rtol=0, atol=1e-12 * np.abs(vector).max())


def test_information_that_is_not_definite_is_reported() -> None:
    information = -1e4 * np.eye(6)
    arguments = np.zeros(3), np.ones(3), 0.1, 1e-3, True, np.zeros(6), information, np.zeros(6)
    assert not predict_and_correct(empty_rows(), *arguments)


@pytest.mark.parametrize("agents", [1, 4, 9])
def test_pre_estimation_is_the_filter(agents: int) -> None:
    # GIVEN a window with rows of all kinds (a single agent has none to range)
    kinds = builders.ALL_KINDS if agents > 1 else (Kind.POSITION, Kind.SPEED, Kind.ANCHOR_RANGE)
    problem, _ = builders.random_window(np.random.default_rng(agents), agents=agents, ticks=4, kinds=kinds)
    reference = dense.DenseWindow(problem, 1e-3)
    # THEN rows entered one by one give the mean and the covariance of the block formula (20)-(23)
    mean, covariance = pre_estimation(problem, 1e-3)
    np.testing.assert_allclose(mean, reference.filtered, rtol=0, atol=1e-9)
    np.testing.assert_allclose(covariance, reference.pre_covariance, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(covariance, covariance.T)


def test_observability_matrix() -> None:
    rng = np.random.default_rng(3)
    problem, states = builders.random_window(rng, ticks=3)
    rows = dense.rows_by_tick(problem)
    a = dense.transition(3, 0.1)
    expected = np.vstack(
        [
            dense.jacobian(r, x, 1e-3) @ np.linalg.matrix_power(a, k)
            for k, (r, x) in enumerate(zip(rows, states, strict=True))
        ]
    )
    found = observability_matrix(rows, list(states), 0.1, 1e-3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
