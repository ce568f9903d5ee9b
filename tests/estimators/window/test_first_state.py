"""The window over its first state is the window over everything, and on a linear system the Kalman filter.

What it is compared with has other variables (all accelerations' errors too) and shares no code with it:
`tests.support.joint_reference`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.model.measurements import Kind, empty_inputs, position_rows, range_row
from estimators.systematic import slow_errors
from estimators.systematic.belief import SlowBelief
from estimators.window.slow_window import slow_problem, weights
from tests.support import builders
from tests.support import dense_reference as dense
from tests.support.joint_reference import coupling_matrix, push_matrix
from tests.support.slow_windows import DT, EPS, DrawnWindow, draw_window

Array = NDArray[np.float64]
FIX_SIGMA_M = 0.1


def nth_window(seed: int, **options: object) -> DrawnWindow:
    """One of many, of one to four agents and one to five ticks, every other with slow errors."""
    rng = np.random.default_rng([11, seed])
    return draw_window(rng, agents=1 + seed % 4, ticks=1 + seed % 5, slow=bool(seed % 2), **options)  # type: ignore[arg-type]


# --- the joint optimum ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "hundred", [0, *(pytest.param(each, marks=pytest.mark.slow) for each in range(1, 10))]
)
def test_it_is_the_optimum_over_the_first_state_and_everything_else(hundred: int) -> None:
    # GIVEN windows with rows of all kinds at instants of their own
    for seed in range(100 * hundred, 100 * hundred + 100):
        drawn = nth_window(seed)
        joint = drawn.joint()
        # WHEN both go from the prior's mean to an optimum
        optimum = joint.minimise(joint.start_at_prior())
        assert optimum.step < 1e-9
        solution = drawn.solved()
        # THEN it is the same
        assert solution.converged
        np.testing.assert_allclose(solution.path, optimum.path, rtol=0, atol=1e-7, err_msg=f"seed {seed}")
        np.testing.assert_allclose(solution.slow, optimum.slow, rtol=0, atol=1e-7, err_msg=f"seed {seed}")
        assert solution.cost == pytest.approx(optimum.cost, abs=1e-9, rel=1e-9)


@pytest.mark.parametrize("seed", range(24))
def test_on_linear_rows_its_covariance_is_that_of_the_joint_problem(seed: int) -> None:
    drawn = nth_window(seed, kinds=builders.LINEAR_KINDS)
    joint = drawn.joint()
    optimum, solution = joint.minimise(joint.start_at_prior()), drawn.solved()
    np.testing.assert_allclose(solution.path, optimum.path, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.covariance, joint.newest_covariance(optimum.z), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(solution.variances, solution.measured)


@pytest.mark.parametrize("kinds", [builders.LINEAR_KINDS, (Kind.VELOCITY, Kind.RANGE), (Kind.VELOCITY,)])
@pytest.mark.parametrize("seed", [1, 3, 5, 7])
def test_errors_that_no_row_holds_stay_what_they_were(seed: int, kinds: tuple[Kind, ...]) -> None:
    # GIVEN a belief in which slow errors are independent, and rows that hold only some of them, or none
    drawn = nth_window(seed, kinds=kinds, correlated=False, rows_per_agent=1)
    rows, start = drawn.window.rows()
    joint = drawn.joint()
    assert not joint.coupling.any(axis=0).all()
    optimum, solution = joint.minimise(joint.start_at_prior()), drawn.solved()
    # THEN the solution is that over all of them
    np.testing.assert_allclose(solution.path, optimum.path, rtol=0, atol=1e-7)
    np.testing.assert_allclose(solution.slow, optimum.slow, rtol=0, atol=1e-7)
    if np.isin(rows["kind"], builders.LINEAR_KINDS).all():
        np.testing.assert_allclose(solution.covariance, joint.newest_covariance(optimum.z), rtol=0, atol=1e-9)
        # and so is the next window's prior
        kalman = AugmentedKalman(drawn.belief)
        accel, accel_variance = drawn.window.inputs()
        kalman.update(rows[: start[1]], joint.variance[: start[1]])
        kalman.predict(accel[0], accel_variance[0])
        np.testing.assert_allclose(solution.arrival.mean, kalman.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(solution.arrival.covariance, kalman.covariance, rtol=0, atol=1e-9)


def test_one_iteration_solves_linear_rows() -> None:
    drawn = nth_window(7, kinds=builders.LINEAR_KINDS)
    once, long = drawn.solved(iterations=1), drawn.solved()
    np.testing.assert_allclose(once.path, long.path, rtol=0, atol=1e-10)


def test_without_rows_it_is_the_prediction() -> None:
    drawn = draw_window(np.random.default_rng(1), agents=2, ticks=4, slow=True, rows_per_agent=0)
    accel, _ = drawn.window.inputs()
    mean = drawn.belief.mean[:12]
    error = drawn.belief.mean[12:][6:12]
    for push in accel:
        mean = dense.transition(2, DT) @ mean + dense.inputs(2, DT) @ (push - error)
    solution = drawn.solved()
    np.testing.assert_allclose(solution.path[-1], mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.slow, drawn.belief.mean[12:], rtol=0, atol=1e-12)
    assert solution.cost < 1e-20


# --- the Kalman filter ------------------------------------------------------------------------------------------


class AugmentedKalman:
    """A Kalman filter over the fleet's states and the slow errors, by the blackboard's formulas."""

    def __init__(self, belief: SlowBelief) -> None:
        self.mean, self.covariance, self.sizes = belief.mean.copy(), belief.covariance.copy(), belief.sizes
        self.d = belief.states
        self.agents = self.d // 6

    def update(self, rows: np.ndarray, variance: Array) -> None:
        c = np.zeros((len(rows), len(self.mean)))
        c[:, : self.d] = dense.jacobian(rows, self.mean[: self.d], EPS)
        if len(self.sizes):
            c[:, self.d :] = coupling_matrix(rows, self.agents)
        gain = self.covariance @ c.T @ np.linalg.inv(c @ self.covariance @ c.T + np.diag(variance))
        self.mean = self.mean + gain @ (rows["value"] - c @ self.mean)
        self.covariance = self.covariance - gain @ c @ self.covariance

    def predict(self, accel: Array, variance: Array) -> None:
        a, b = np.eye(len(self.mean)), np.zeros((len(self.mean), 3 * self.agents))
        a[: self.d, : self.d] = dense.transition(self.agents, DT)
        b[: self.d] = dense.inputs(self.agents, DT)
        noise = b @ np.diag(variance) @ b.T
        if len(self.sizes):
            keep = slow_errors.kept_per_tick(self.agents, DT)
            a[: self.d, self.d :] = -b[: self.d] @ push_matrix(self.agents)
            a[range(self.d, len(a)), range(self.d, len(a))] = keep
            noise[range(self.d, len(a)), range(self.d, len(a))] += (1.0 - keep**2) * self.sizes**2
        self.mean = a @ self.mean + b @ accel
        self.covariance = a @ self.covariance @ a.T + noise


@pytest.mark.parametrize("seed", range(16))
def test_the_next_windows_prior_is_the_kalman_filters(seed: int) -> None:
    # GIVEN linear rows
    drawn = nth_window(seed, kinds=builders.LINEAR_KINDS)
    rows, start = drawn.window.rows()
    accel, accel_variance = drawn.window.inputs()
    kalman = AugmentedKalman(drawn.belief)
    # WHEN the window is solved, and a filter takes its first tick
    arrival = drawn.solved().arrival
    kalman.update(rows[: start[1]], drawn.joint().variance[: start[1]])
    kalman.predict(accel[0], accel_variance[0])
    # THEN both believe the same of the second
    np.testing.assert_allclose(arrival.mean, kalman.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(arrival.covariance, kalman.covariance, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(arrival.sizes, drawn.belief.sizes)


@pytest.mark.parametrize("seed", [2, 6])
def test_without_slow_errors_its_newest_state_is_the_kalman_filters(seed: int) -> None:
    # (with them they are constants in a window, Gauss-Markov from one to the next)
    drawn = nth_window(seed, kinds=builders.LINEAR_KINDS)
    rows, start = drawn.window.rows()
    accel, accel_variance = drawn.window.inputs()
    kalman = AugmentedKalman(drawn.belief)
    for tick in range(len(accel) + 1):
        if tick:
            kalman.predict(accel[tick - 1], accel_variance[tick - 1])
        here = slice(start[tick], start[tick + 1])
        kalman.update(rows[here], rows["variance"][here])
    solution = drawn.solved()
    np.testing.assert_allclose(solution.path[-1], kalman.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.covariance, kalman.covariance, rtol=0, atol=1e-9)


def test_a_window_that_still_grows_keeps_its_prior() -> None:
    drawn = nth_window(3)
    assert drawn.solved(slide=False).arrival is drawn.belief


# --- derivatives ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("seed", [3, 5, 10])
def test_the_optimal_cost_changes_with_the_data_as_its_residuals_say(seed: int, robust: bool) -> None:
    # GIVEN a window, two of its rows outliers, and its optimum
    drawn = nth_window(seed)
    table = drawn.window._rows
    table["value"][[1, -2]] += 3.0
    solution, joint = drawn.solved(robust=robust), drawn.joint(robust=robust)
    misses = joint.misses(joint.variables(solution.path, solution.slow))
    weight = joint.weights_and_cost(misses)[0]
    assert (weight < 1.0).any() == robust

    def cost() -> float:
        return drawn.solved(robust=robust).cost

    # THEN the cost's derivative by each value is twice the weighted residual over the variance (envelope theorem),
    # of a height less the share that its scale's error has of the change
    expected = 2.0 * weight * misses / np.sqrt(joint.variance)
    if joint.q:
        higher = table.copy()
        higher["value"] += 1.0
        changed = coupling_matrix(higher, joint.d // 6) - coupling_matrix(table, joint.d // 6)
        expected *= 1.0 - changed @ solution.slow
    for row in range(0, len(table), 3):
        value, small = table["value"][row], 1e-4
        table["value"][row] = value + small
        above = cost()
        table["value"][row] = value - small
        slope = (above - cost()) / (2 * small)
        table["value"][row] = value
        assert slope == pytest.approx(expected[row], rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("seed", [3, 5, 10])
def test_the_optimal_cost_changes_with_the_prior_as_the_first_state_says(seed: int, robust: bool) -> None:
    drawn = nth_window(seed)
    belief, solution = drawn.belief, drawn.solved(robust=robust)
    away = np.concatenate([solution.path[0], solution.slow]) - belief.mean
    expected = -2.0 * np.linalg.solve(belief.covariance, away)
    for at in range(0, len(belief.mean), 2):
        small = np.zeros(len(belief.mean))
        small[at] = 1e-4
        above, below = (
            replace(drawn, belief=replace(belief, mean=belief.mean + sign * small)).solved(robust=robust).cost
            for sign in (1, -1)
        )
        assert (above - below) / 2e-4 == pytest.approx(expected[at], rel=1e-4, abs=1e-4)


# --- outliers ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_with_outliers_it_is_a_point_where_reweighting_changes_nothing(seed: int) -> None:
    # GIVEN a window some of whose rows are far off
    drawn = nth_window(seed)
    rng = np.random.default_rng(seed)
    table = drawn.window._rows
    table["value"][rng.integers(0, len(table), 1 + len(table) // 10)] += rng.choice([-1.0, 1.0]) * 10.0
    # WHEN it is solved
    solution, joint = drawn.solved(robust=True, tolerance=1e-9), drawn.joint(robust=True)
    z = joint.variables(solution.path, solution.slow)
    # THEN weighted least squares with the weights at its end ends there too
    assert solution.converged
    assert np.abs(joint.path(z) - solution.path).max() < 1e-8
    _, step = joint.gauss_newton(z)
    assert np.abs(step).max() < 1e-6
    weight, _ = joint.weights_and_cost(joint.misses(z))
    assert weight.min() < 0.5
    problem = slow_problem(drawn.window, drawn.belief, drawn.white, DT, EPS, robust=True)
    np.testing.assert_allclose(weights(problem, solution), weight, rtol=1e-5)
    assert solution.cost == pytest.approx(joint.cost(z), rel=1e-9)


@pytest.mark.parametrize("seed", [2, 6, 10])
def test_where_nothing_is_far_off_robust_is_least_squares(seed: int) -> None:
    # GIVEN a window whose noise is half of what it is said to be. Of speeds, what is missed counts with robust
    kinds = (Kind.POSITION, Kind.VELOCITY, Kind.RANGE, Kind.ANCHOR_RANGE)
    drawn = nth_window(seed, rows_per_agent=4, kinds=kinds)
    joint, table = drawn.joint(), drawn.window._rows
    misses = joint.misses(joint.minimise(joint.start_at_prior()).z)
    table["value"] -= 0.5 * misses * np.sqrt(joint.variance)
    one, other = drawn.solved(robust=True), drawn.solved(robust=False)
    # THEN there is no outlier, and robust changes nothing
    np.testing.assert_allclose(one.path, other.path, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.measured, table["variance"], rtol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=0, atol=1e-9)


def with_fixes(offset_m: float | None, *, slow: bool, tick: int = 4) -> DrawnWindow:
    """Two agents whose fixes of 0.1 m and ranges are exact, but one fix, off to the north; None: it is not there."""
    drawn = draw_window(np.random.default_rng(4), agents=2, ticks=5, slow=slow, rows_per_agent=0, prior_m=0.3)
    for k, state in enumerate(drawn.truth):
        for agent in range(2):
            place = state[6 * agent : 6 * agent + 3].copy()
            if k == tick and agent == 0:
                if offset_m is None:
                    continue
                place[0] += offset_m
            drawn.window.insert(position_rows(k, agent, place, np.full(3, FIX_SIGMA_M**2)), empty_inputs())
        length = float(np.linalg.norm(state[0:3] - state[6:9]))
        drawn.window.insert(range_row(k, 0, 1, length, 0.05**2), empty_inputs())
    return replace(drawn, white=np.ones((2, 3)))


@pytest.mark.parametrize("slow", [False, True])
@pytest.mark.parametrize("offset_m", [3.0, 30.0, 300.0])
def test_a_fix_far_off_moves_little(offset_m: float, slow: bool) -> None:
    # GIVEN six fixes each, one off by 30 to 3000 sigma, and the same without that one
    far, without = with_fixes(offset_m, slow=slow), with_fixes(None, slow=slow)
    # THEN it moves its drone by less than half the sigma of a fix, and the farther it is off the less
    moved = np.abs(far.solved(robust=True).path - without.solved(robust=True).path)[:, :3].max()
    assert moved < 0.5 * FIX_SIGMA_M * 3.0 / offset_m
    # and it would by far more without weights
    believed = np.abs(far.solved(robust=False).path - without.solved(robust=False).path)[:, :3].max()
    assert believed > 0.02 * offset_m


@pytest.mark.parametrize("slow", [False, True])
@pytest.mark.parametrize("offset_m", [3.0, 30.0, 300.0])
def test_an_outlier_that_leaves_the_window_leaves_little_in_the_prior(offset_m: float, slow: bool) -> None:
    # GIVEN the same, the outlier in the window's first tick
    far, without = (with_fixes(each, slow=slow, tick=0).solved(robust=True) for each in (offset_m, None))
    assert np.abs(far.arrival.mean - without.arrival.mean).max() < 1.2 / offset_m
    np.testing.assert_allclose(far.arrival.covariance, without.arrival.covariance, rtol=0, atol=0.08 / offset_m)


# --- what a linearisation misses --------------------------------------------------------------------------------


def test_ranges_between_places_not_known_well_say_less() -> None:
    # GIVEN windows of ranges with a wide prior and a narrow one
    options = {"kinds": (Kind.RANGE, Kind.ANCHOR_RANGE), "rows_per_agent": 1}
    wide, narrow = (nth_window(8 + 4 * 2 + 1, prior_m=size, **options).solved() for size in (3.0, 0.01))
    assert (wide.variances >= wide.measured).all()
    assert (wide.variances > 1.05 * wide.measured).any()
    np.testing.assert_array_equal(narrow.variances, narrow.measured)
    # and so the window with them is less sure than the joint problem, which does not know
    assert np.isfinite(wide.covariance).all()


# --- what cannot be solved --------------------------------------------------------------------------------------


def test_too_few_iterations_are_told() -> None:
    solution = nth_window(2, prior_m=3.0).solved(iterations=1)
    assert not solution.converged
    assert solution.iterations == 1
    assert np.isfinite(solution.covariance).all()


@pytest.mark.parametrize("spoiled", [np.nan, -1.0])
def test_a_belief_that_is_none_is_refused(spoiled: float) -> None:
    drawn = nth_window(2)
    covariance = drawn.belief.covariance.copy()
    covariance[0, 0] = spoiled
    with pytest.raises((ArithmeticError, np.linalg.LinAlgError)):
        replace(drawn, belief=replace(drawn.belief, covariance=covariance)).solved()
