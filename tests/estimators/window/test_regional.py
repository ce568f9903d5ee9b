"""Reduction to the agents of the rows: the same optimum as over the whole fleet, for everybody."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.estimator import Status
from estimators.model.measurements import Kind
from estimators.settings import EstimatorSettings
from estimators.window.solving import pre_estimation, solve_window
from tests.support import builders
from tests.support import dense_reference as dense

EPS = 1e-3
SETTINGS = EstimatorSettings(tolerance=1e-10, max_iterations=500)


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
@pytest.mark.parametrize(
    ("agents", "region", "ticks"),
    [(6, (1, 4), 2), (7, (0, 3, 6), 3), (8, (2, 3, 4, 5), 1), (10, (9, 0, 5), 5), (10, (7,), 2)],
    ids=lambda value: str(value),
)
def test_reduced_is_the_dense_optimum_of_the_fleet(
    agents: int, region: tuple[int, ...], ticks: int, with_gains: bool
) -> None:
    # GIVEN a fleet whose prior couples everybody, and rows that touch few
    rng = np.random.default_rng(agents + ticks)
    kinds = builders.ALL_KINDS if len(region) > 1 else (*builders.LINEAR_KINDS, Kind.ANCHOR_RANGE)
    problem, _ = builders.random_window(
        rng, agents=agents, ticks=ticks, region=region, kinds=kinds, rows_per_agent=3, with_gains=with_gains,
        prior_scale=0.05,
    )  # fmt: skip
    # WHEN the reduced window is solved and, dense, the one over all agents
    reference = dense.DenseWindow(problem, EPS)
    optimum = reference.minimise()
    solution = solve_window(problem, SETTINGS)
    # THEN the estimate, the next prior's mean and its information are those of the fleet, outside agents included
    assert solution.status is Status.OK
    assert solution.report.cost == pytest.approx(optimum.cost, rel=1e-9)
    for tick in {1, ticks}:
        np.testing.assert_allclose(solution.path[tick], optimum.path[tick], rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        solution.next_information, reference.next_information(optimum.path), rtol=1e-8, atol=1e-5
    )
    # and an outside agent has learned from the rows of the others
    outside = next(s for s in range(agents) if s not in region)
    unchanged = reference.path(reference.start())[0, 6 * outside : 6 * outside + 6]
    assert np.abs(solution.path[0, 6 * outside : 6 * outside + 6] - unchanged).max() > 1e-4
    # and so has its covariance
    np.testing.assert_allclose(pre_estimation(problem, EPS)[1], reference.pre_covariance, rtol=0, atol=1e-10)


@pytest.mark.parametrize("with_gains", [True, False], ids=["pre-estimation", "input corrections"])
def test_keeping_more_agents_changes_nothing(with_gains: bool) -> None:
    # GIVEN a window that touches two agents of five
    rng = np.random.default_rng(77)
    problem, _ = builders.random_window(rng, agents=5, ticks=3, region=(1, 3), with_gains=with_gains)
    # WHEN others are kept in the optimisation without a row of theirs
    alone = solve_window(problem, SETTINGS)
    kept = solve_window(problem._replace(keep=np.array([0, 1, 4], np.int64)), SETTINGS)
    # THEN the solution is the same, and all of the path is written
    for tick in (0, 1, 3):
        np.testing.assert_allclose(kept.path[tick], alone.path[tick], rtol=0, atol=1e-9)
    np.testing.assert_allclose(kept.next_information, alone.next_information, rtol=1e-9, atol=1e-7)


def test_large_fleet_takes_the_library_path() -> None:
    # GIVEN a region so large that products and factors go through BLAS and LAPACK (16 agents: 96 states)
    rng = np.random.default_rng(16)
    problem, _ = builders.random_window(
        rng, agents=18, ticks=2, region=range(16), rows_per_agent=3, prior_scale=0.05
    )
    reference = dense.DenseWindow(problem, EPS)
    optimum = reference.minimise()
    solution = solve_window(problem, SETTINGS)
    assert solution.report.cost == pytest.approx(optimum.cost, rel=1e-9)
    np.testing.assert_allclose(solution.path[-1], optimum.path[-1], rtol=0, atol=1e-8)


def test_window_without_rows_is_the_prediction() -> None:
    rng = np.random.default_rng(3)
    problem, _ = builders.random_window(rng, agents=4, ticks=2, rows_per_agent=0)
    assert len(problem.rows) == 0
    solution = solve_window(problem, SETTINGS)
    expected = dense.DenseWindow(problem, EPS).path(dense.DenseWindow(problem, EPS).start())
    np.testing.assert_allclose(solution.path[-1], expected[-1], rtol=0, atol=1e-12)
    assert solution.status is Status.OK


@pytest.mark.parametrize("budget", [1, 2, 3])
def test_budget_limits_the_iterations(budget: int) -> None:
    # GIVEN a window that needs several linearisations
    problem, _ = builders.random_window(np.random.default_rng(5), agents=3, prior_scale=2.0)
    full = solve_window(problem, SETTINGS)
    assert full.report.iterations > 3
    # WHEN it may use fewer, THEN it says so, and what it gives is finite and no worse than the start
    short = solve_window(problem, SETTINGS, budget)
    assert short.status is Status.NOT_CONVERGED
    reference = dense.DenseWindow(problem, EPS)
    assert full.report.cost <= short.report.cost <= reference.cost(reference.start())
    assert np.isfinite(short.path).all()
