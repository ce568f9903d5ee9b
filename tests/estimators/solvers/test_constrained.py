"""The constrained step: optimality conditions, both engines, the hard box, the exact penalty.

Conditions are checked with the dense reference: multipliers that make the Lagrangian stationary must exist, with
the right signs, within the price of the soft bounds.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from estimators.estimator import Status
from estimators.model.measurements import Kind
from estimators.settings import EstimatorSettings
from estimators.window.problem import WindowProblem, WindowSolution
from estimators.window.solving import solve_window
from tests.support import builders
from tests.support import dense_reference as dense

Array = NDArray[np.float64]
EPS = 1e-3
BASE = EstimatorSettings(tolerance=1e-9, max_iterations=200)
SOFT = msgspec.structs.replace(BASE, noise_bounds="soft")
VARIANTS = pytest.mark.parametrize(
    ("with_gains", "bounds_on"),
    [(True, "corrected"), (True, "predicted"), (False, "corrected"), (False, "predicted")],
)


def a_window(seed: int, *, with_gains: bool = True, agents: int = 3) -> WindowProblem:
    """A window whose agents are all in the rows, near its prior, so that it has one minimum."""
    rng = np.random.default_rng(seed)
    kinds = builders.ALL_KINDS if agents > 1 else (Kind.POSITION, Kind.ANCHOR_RANGE)
    problem, _ = builders.random_window(
        rng, agents=agents, ticks=2, with_gains=with_gains, prior_scale=0.02, kinds=kinds
    )
    return problem


def bounded(reference: dense.DenseWindow, z: Array, bounds_on: str) -> tuple[Array, Array]:
    """Residuals of the rows after the first tick, corrected or predicted, and their derivatives."""
    states, sens = reference.path(z), reference.sensitivities(z)
    residuals, slopes = [], []
    for k in range(1, reference.ticks + 1):
        x, along = states[k], sens[k]
        if bounds_on == "predicted":
            x, along = reference.before_update(states[k - 1], z, k - 1), reference.a @ sens[k - 1]
            if not reference.problem.with_gains:
                width = len(reference.b.T)
                along[:, reference.n + (k - 1) * width : reference.n + k * width] += reference.b
        rows = reference.rows[k]
        residuals.append(rows["value"] - dense.predicted(rows, x, EPS))
        slopes.append(-dense.jacobian(rows, x, EPS) @ along)
    return np.concatenate(residuals), np.concatenate(slopes)


def variables(reference: dense.DenseWindow, solution: WindowSolution) -> Array:
    """z of a solution: its first state and, without gains, the corrections that its path shows."""
    first = solution.path[0]
    if reference.problem.with_gains:
        return first
    push = np.linalg.pinv(reference.b)
    steps = [
        push @ (solution.path[k + 1] - reference.a @ solution.path[k]) - reference.problem.accel[k]
        for k in range(reference.ticks)
    ]
    return np.concatenate([first, *steps])


def tightened(problem: WindowProblem, bounds_on: str, fraction: float) -> WindowProblem:
    """The same window with bounds at ``fraction`` of the two largest residuals, and far from the others'."""
    reference = dense.DenseWindow(problem, EPS)
    residuals, _ = bounded(reference, variables(reference, solve_window(problem, BASE)), bounds_on)
    half = 3.0 * np.abs(residuals) + 1.0
    largest = np.argsort(-np.abs(residuals))[:2]
    half[largest] = fraction * np.abs(residuals[largest])
    rows = problem.rows.copy()
    rows["half_width"][problem.start[1] :] = half
    return problem._replace(rows=rows)


def check_conditions(
    problem: WindowProblem, solution: WindowSolution, settings: EstimatorSettings, box: Array | None = None
) -> int:
    """Stationarity with multipliers of the right sign; returns how many bounds are active."""
    reference = dense.DenseWindow(problem, EPS)
    z = variables(reference, solution)
    np.testing.assert_allclose(reference.path(z), solution.path, rtol=0, atol=1e-9)
    slope = 2.0 * reference.normal_equations(z)[1]
    forces, tops = [], []  # directions of the unknown multipliers and their largest values
    if settings.noise_bounds == "soft":
        residuals, slopes = bounded(reference, z, settings.noise_bounds_on)
        half = problem.rows["half_width"][problem.start[1] :]
        price = settings.noise_bounds_penalty / half
        for residual, along, width, top in zip(residuals, slopes, half, price, strict=True):
            if abs(residual) > width * (1 + 1e-6):  # beyond: the whole price
                slope = slope + np.sign(residual) * top * along
            elif abs(residual) > width * (1 - 1e-6):
                forces.append(np.sign(residual) * along)
                tops.append(top)
    if box is not None:
        along = np.concatenate(reference.sensitivities(z))
        for value, limit, direction in zip(
            solution.path.ravel(), np.tile(box, len(solution.path)), along, strict=True
        ):
            assert abs(value) <= limit * (1 + 1e-9)
            if abs(value) > limit - 1e-7:
                forces.append(np.sign(value) * direction)
                tops.append(np.inf)
    curvature = reference.normal_equations(z)[0]
    root = np.linalg.cholesky(curvature)
    if forces:  # the multipliers that come closest to stationarity, measured in Newton steps
        matrix = np.linalg.solve(root, np.array(forces).T)
        fit = lsq_linear(matrix, -np.linalg.solve(root, slope), bounds=(0.0, tops), tol=1e-14)
        slope = slope + np.array(forces).T @ fit.x
    step = np.linalg.solve(curvature, slope)
    assert np.abs(step).max() < 1e-6, "a Newton step of the Lagrangian would still move the solution"
    return len(forces)


@VARIANTS
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("penalty", [100.0, 0.5])
def test_soft_noise_bounds(seed: int, with_gains: bool, bounds_on: str, penalty: float) -> None:
    # GIVEN a window of which two residuals are over their bounds
    problem = tightened(a_window(seed, with_gains=with_gains), bounds_on, 0.5)
    settings = msgspec.structs.replace(SOFT, noise_bounds_on=bounds_on, noise_bounds_penalty=penalty)
    # WHEN it is solved by either engine
    solutions = [solve_window(problem, msgspec.structs.replace(settings, qp=name)) for name in ("osqp", "daqp")]
    # THEN both are at one point, which fulfils the conditions of optimality
    for solution in solutions:
        assert solution.status is Status.OK
        assert solution.report.qp_solves > 0
        check_conditions(problem, solution, settings)
    np.testing.assert_allclose(solutions[0].path, solutions[1].path, rtol=0, atol=1e-7)
    np.testing.assert_allclose(solutions[0].next_information, solutions[1].next_information, rtol=1e-6)
    # and the cost says what it is: (9) and the price of what is left over
    reference = dense.DenseWindow(problem, EPS)
    z = variables(reference, solutions[0])
    half = problem.rows["half_width"][problem.start[1] :]
    excess = np.maximum(np.abs(bounded(reference, z, bounds_on)[0]) / half - 1.0, 0.0)
    assert solutions[0].report.cost == pytest.approx(reference.cost(z) + penalty * excess.sum(), rel=1e-7)


def test_a_dear_excess_is_none_at_all() -> None:
    # GIVEN bounds that can be kept
    problem = tightened(a_window(4), "corrected", 0.8)
    half = problem.rows["half_width"][problem.start[1] :]
    reference = dense.DenseWindow(problem, EPS)

    def excess(penalty: float) -> float:
        settings = msgspec.structs.replace(SOFT, noise_bounds_penalty=penalty)
        z = variables(reference, solve_window(problem, settings))
        return float(np.maximum(np.abs(bounded(reference, z, "corrected")[0]) / half - 1.0, 0.0).max())

    # THEN a high price keeps them exactly (not nearly, as a quadratic penalty would), a low one does not
    assert excess(1e4) < 1e-9
    assert excess(0.01) > 1e-3


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
@pytest.mark.parametrize("seed", range(3))
def test_hard_box(seed: int, with_gains: bool) -> None:
    # GIVEN a box that the unconstrained path leaves by centimetres, in position and in speed
    problem = a_window(seed, with_gains=with_gains)
    free = solve_window(problem, BASE)
    components = np.abs(free.path.reshape(-1, 2, 3))
    position, speed = float(components[:, 0].max()) - 0.03, float(components[:, 1].max()) - 0.03
    settings = msgspec.structs.replace(BASE, state_box_position_m=position, state_box_speed_mps=speed)
    limit = np.tile(np.repeat([position, speed], 3), 3)
    # WHEN it is solved by either engine, THEN the path is in the box and optimal there
    solutions = [solve_window(problem, msgspec.structs.replace(settings, qp=name)) for name in ("osqp", "daqp")]
    for solution in solutions:
        assert solution.status is Status.OK
        assert check_conditions(problem, solution, settings, limit) > 0
    np.testing.assert_allclose(solutions[0].path, solutions[1].path, rtol=0, atol=1e-7)
    assert solutions[0].report.cost > free.report.cost


def test_box_and_noise_bounds_together() -> None:
    active = []
    for seed in range(8, 12):
        problem = tightened(a_window(seed), "corrected", 0.6)
        free = solve_window(problem, BASE)
        position = float(np.abs(free.path.reshape(-1, 2, 3))[:, 0].max()) - 0.02
        settings = msgspec.structs.replace(SOFT, state_box_position_m=position)
        limit = np.tile(np.repeat([position, np.inf], 3), 3)
        solution = solve_window(problem, settings)
        assert solution.status is Status.OK
        active.append(check_conditions(problem, solution, settings, limit))
    assert min(active) > 0
    assert max(active) > 1


def test_agent_outside_the_rows_is_kept_in_the_box() -> None:
    # GIVEN a fleet of four of which two are in the rows; the box is left by one of the others only
    rng = np.random.default_rng(31)
    problem, _ = builders.random_window(rng, agents=4, ticks=2, region=(0, 1), prior_scale=0.05)
    free = solve_window(problem, msgspec.structs.replace(BASE, state_box_position_m=1e6))
    largest = np.abs(free.path.reshape(3, 4, 2, 3))[:, :, 0].max(axis=(0, 2))
    worst = int(np.argmax(largest))
    assert worst in (2, 3), "the seed must give such a window"
    position = float(largest[worst]) - 0.02
    settings = msgspec.structs.replace(BASE, state_box_position_m=position)
    # THEN its states are held too, and the solution is optimal for the whole fleet
    solution = solve_window(problem, settings)
    limit = np.tile(np.repeat([position, np.inf], 3), 4)
    assert check_conditions(problem, solution, settings, limit) > 0


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
def test_bounds_that_hold_change_nothing(with_gains: bool) -> None:
    # GIVEN bounds wider than anything in the window
    problem = a_window(6, with_gains=with_gains)
    problem.rows["half_width"] = 50.0
    free = solve_window(problem, BASE)
    settings = msgspec.structs.replace(SOFT, state_box_position_m=100.0, state_box_speed_mps=50.0)
    solution = solve_window(problem, settings)
    # THEN the solution is the same bit by bit, and no program was solved
    np.testing.assert_array_equal(solution.path, free.path)
    np.testing.assert_array_equal(solution.next_information, free.next_information)
    assert solution.report == free.report
    assert solution.report.qp_solves == 0


@pytest.mark.parametrize("name", ["osqp", "daqp"])
def test_box_that_cannot_be_kept(name: str) -> None:
    # GIVEN one agent that accelerates by 2 m/s2: with pre-estimation and no rows its path is given by its start, and
    # no start keeps the speed within 1 cm/s for three ticks
    rng = np.random.default_rng(1)
    problem, _ = builders.random_window(rng, agents=1, ticks=2, kinds=builders.LINEAR_KINDS, rows_per_agent=0)
    problem = problem._replace(accel=np.full((2, 3), 2.0))
    settings = msgspec.structs.replace(BASE, state_box_speed_mps=0.01, qp=name)
    # WHEN it is solved, THEN it says that it fell back, and gives the prior's prediction
    solution = solve_window(problem, settings)
    assert solution.status is Status.FELL_BACK
    reference = dense.DenseWindow(problem, EPS)
    np.testing.assert_allclose(solution.path, reference.path(reference.start()), rtol=0, atol=1e-9)
    assert np.isfinite(solution.next_information).all()


def test_first_tick_has_no_bounds() -> None:
    # GIVEN bounds that only the rows of the first tick break: (8) holds from the second on
    problem = a_window(7)
    rows = problem.rows.copy()
    rows["half_width"][: problem.start[1]] = 1e-6
    rows["half_width"][problem.start[1] :] = 50.0
    problem = problem._replace(rows=rows)
    solution = solve_window(problem, SOFT)
    assert solution.report.qp_solves == 0
    np.testing.assert_array_equal(solution.path, solve_window(problem, BASE).path)
