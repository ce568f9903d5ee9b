"""The window over its first state, within limits: against an interior-point solver on the joint problem."""

from __future__ import annotations

import importlib.util

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.compiled.entries import plain
from estimators.model.layout import Layout
from estimators.model.limits import StateLimits, state_limits
from estimators.model.row_kernels import HALF_WIDTH, PRECISION
from estimators.settings import EstimatorSettings, LimitsTable, VehicleLimits
from estimators.solvers.bounded_window import solve_bounded, violates
from estimators.solvers.qp import make_engine
from estimators.window.first_state_bounds import (
    bends,
    newton_responses,
    quantities,
    quantity_changes,
    quantity_gradients,
)
from estimators.window.limited import solve_limited
from estimators.window.slow_window import SlowProblem, SlowSolution, continued, slow_problem
from tests.support.interior_point import interior_point
from tests.support.joint_reference import JointWindow
from tests.support.slow_windows import DT, EPS, DrawnWindow, draw_window

Array = NDArray[np.float64]
needs_casadi = pytest.mark.skipif(
    importlib.util.find_spec("casadi") is None,
    reason="NOT TESTED: casadi is missing (pip install 'fleetloc[studies]'), no peer checks the bounded optimum",
)
KINDS = ("floor", "speed", "box", "noise")


def unlimited(agents: int) -> StateLimits:
    return StateLimits(np.full(6 * agents, -np.inf), np.full(6 * agents, np.inf), np.inf, 0.0)


class Case:
    """A random window, its optimum without limits, and limits that this breaks by centimetres to half a metre."""

    def __init__(self, kind: str, seed: int) -> None:
        rng = np.random.default_rng([KINDS.index(kind), seed])
        agents, ticks = 2 + seed % 2, 1 + seed % 4
        self.drawn: DrawnWindow = draw_window(rng, agents=agents, ticks=ticks, slow=seed % 3 > 0)
        self.problem: SlowProblem = slow_problem(
            self.drawn.window, self.drawn.belief, self.drawn.white, DT, EPS, robust=False
        )
        self.joint: JointWindow = self.drawn.joint()
        self.prior: Array = self.joint.root.T @ self.joint.root
        self.free: SlowSolution = self.drawn.solved()
        blocks = self.free.path.reshape(ticks + 1, agents, 2, 3)
        fastest = float(np.linalg.norm(blocks[:, :, 1], axis=-1).max())
        low, high, speed, price = *unlimited(agents)[:2], np.inf, 0.0
        if kind in ("floor", "noise"):
            high[2::6] = blocks[..., 0, 2].max() - rng.uniform(0.01, 0.5)
        if kind in ("speed", "noise"):
            speed = max(fastest - rng.uniform(0.05, 0.5), 0.5)
        if kind == "box":
            low[0::6] = blocks[..., 0, 0].min() + rng.uniform(0.01, 0.3)
            high[1::6] = blocks[..., 0, 1].max() - rng.uniform(0.01, 0.3)
            high[4::6] = max(blocks[..., 1, 1].max() - 0.1, 0.1)
        if kind == "noise":
            price = float(rng.choice([100.0, 3.0]))
            sigmas = 1.0 / np.sqrt(self.problem.window.data[:, PRECISION])
            self.problem.window.data[:, HALF_WIDTH] = sigmas * rng.uniform(0.5, 3.0, len(sigmas))
        self.limits = StateLimits(low, high, speed, price)

    def reference(self) -> tuple[Array, Array, float]:
        """From where the optimum without limits is."""
        start = self.joint.variables(self.free.path, self.free.slow)
        return interior_point(self.joint, self.limits, self.problem.window.data[:, HALF_WIDTH], start)


@needs_casadi
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ten", range(3))
def test_it_is_the_optimum_of_the_joint_problem(kind: str, ten: int) -> None:
    for seed in range(10 * ten, 10 * ten + 10):
        # GIVEN a random window, whose optimum breaks limits
        case = Case(kind, seed)
        assert violates(case.problem.window, case.limits, case.free.path, case.free.slow)
        # WHEN it is solved within them, by programs of either engine
        engine = make_engine("osqp" if seed % 2 else "daqp")
        found = solve_bounded(
            case.problem.window, case.prior, case.limits, engine, (case.free.path, case.free.slow), 100, 1e-8
        )
        # THEN path, slow errors and cost are an interior-point solver's over all variables
        path, slow, cost = case.reference()
        assert found.converged
        assert found.active > 0
        assert np.abs(found.path - path).max() < 1e-6
        assert np.abs(found.slow - slow).max(initial=0.0) < 1e-6
        assert found.cost == pytest.approx(cost, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_responses_are_columns_of_the_joint_covariance(seed: int) -> None:
    case = Case("floor", seed)
    joint, window = case.joint, case.problem.window
    start = joint.start_at_prior()
    path = np.ascontiguousarray(joint.path(start))
    hessian, step = joint.gauss_newton(start)
    rng, pulls, cut = np.random.default_rng(seed), 5, joint.d + joint.q
    tick, along = rng.integers(0, len(path), pulls), rng.normal(size=(pulls, cut))
    trial, there = np.empty_like(path), np.empty(joint.q)
    responses, slow_responses = np.empty((pulls, *path.shape)), np.empty((pulls, joint.q))
    slow = start[joint.d : cut].copy()
    assert newton_responses(
        plain(window),
        case.prior,
        path,
        slow,
        1.0 / window.data[:, PRECISION],
        tick,
        along,
        trial,
        there,
        responses,
        slow_responses,
    )
    np.testing.assert_allclose(trial, joint.path(start + step), rtol=0, atol=1e-9)
    for p in range(pulls):
        gradient = joint.moves[tick[p]].T @ along[p, : joint.d]
        gradient[joint.d : cut] += along[p, joint.d :]
        column = np.linalg.solve(hessian, gradient)
        np.testing.assert_allclose(responses[p], joint.moves @ column, rtol=0, atol=1e-10)
        np.testing.assert_allclose(slow_responses[p], column[joint.d : cut], rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_derivatives_of_what_is_bounded_have_a_numeric_twin(seed: int) -> None:
    case = Case("noise", seed)
    window, path, slow = plain(case.problem.window), case.free.path, case.free.slow
    ticks, d = path.shape
    total = ticks * (d + d // 6) + len(case.problem.rows)

    def at(move: Array, slow_move: Array, size: float) -> Array:
        out = np.empty(total)
        quantities(window, path + size * move, slow + size * slow_move, out)
        return out

    rng, h = np.random.default_rng(seed), 1e-5
    move, slow_move = rng.normal(size=path.shape), rng.normal(size=slow.shape)
    numeric = (at(move, slow_move, h) - at(move, slow_move, -h)) / (2 * h)
    changes = np.empty(total)
    quantity_changes(window, path, move, slow_move, changes)
    np.testing.assert_allclose(changes, numeric, rtol=1e-6, atol=1e-7)
    # each by itself
    tick, gradients = np.empty(total, np.int64), np.empty((total, d + len(slow)))
    quantity_gradients(window, path, np.arange(total), tick, gradients)
    one_by_one = np.einsum("pd,pd->p", gradients[:, :d], move[tick]) + gradients[:, d:] @ slow_move
    np.testing.assert_allclose(one_by_one, changes, rtol=1e-9, atol=1e-9)
    # and what bends: the second difference of half the Lagrangian, less Gauss-Newton's part of it
    multipliers = np.where(np.arange(total) >= ticks * d, rng.uniform(0.1, 1.0, total), 0.0)
    variances = 1.0 / case.problem.window.data[:, PRECISION]
    room = 2 * (total - ticks * d)
    tick, along, curvature = np.empty(room, np.int64), np.empty((room, d + len(slow))), np.empty(room)
    count = bends(window, path, slow, variances, multipliers, True, tick, along, curvature)
    moved = np.einsum("pd,pd->p", along[:count, :d], move[tick[:count]])
    first_row = ticks * (d + d // 6)

    def lagrangian(size: float) -> float:
        values = at(move, slow_move, size)
        return float(0.5 * (values[first_row:] ** 2 / variances).sum() + multipliers @ values)

    h = 1e-3
    second = (lagrangian(h) - 2.0 * lagrangian(0.0) + lagrangian(-h)) / h**2
    second -= float((changes[first_row:] ** 2 / variances).sum())
    assert float(curvature[:count] @ moved**2) == pytest.approx(second, rel=1e-3, abs=1e-2)


def limited(case: Case, limits: StateLimits | None, iterations: int = 100) -> SlowSolution:
    belief = case.drawn.belief
    guess = continued(belief.mean[None, : belief.states], case.problem, belief.mean[belief.states :])
    return solve_limited(
        case.problem, belief, (guess, belief.mean[belief.states :]), iterations, 1e-8,
        None if limits is None else (limits, make_engine("osqp")), slide=True,
    )  # fmt: skip


def test_limits_that_hold_change_nothing_and_cost_no_program() -> None:
    case = Case("floor", 1)
    wide = StateLimits(np.full(18, -100.0), np.full(18, 100.0), 50.0, 0.0)
    free, kept = limited(case, None), limited(case, wide)
    np.testing.assert_array_equal(kept.path, free.path)
    np.testing.assert_array_equal(kept.covariance, free.covariance)
    np.testing.assert_array_equal(kept.arrival.mean, free.arrival.mean)
    assert kept.programs == 0
    assert kept.active == 0
    assert kept.iterations == free.iterations


@pytest.mark.parametrize("kind", KINDS)
def test_what_goes_on_from_a_limited_window_is_finite_and_within_its_limits(kind: str) -> None:
    case = Case(kind, 2)
    found = limited(case, case.limits)
    assert found.converged
    assert found.programs > 0
    assert (found.path >= case.limits.low - 1e-6).all()
    assert (found.path <= case.limits.high + 1e-6).all()
    speeds = np.linalg.norm(found.path.reshape(-1, 2, 3)[:, 1], axis=-1)
    assert speeds.max() <= case.limits.speed_mps + 1e-6
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
    assert np.linalg.eigvalsh(found.arrival.covariance)[0] > 0.0


def test_too_few_iterations_are_told() -> None:
    case = Case("speed", 3)
    found = limited(case, case.limits, 1)
    assert not found.converged
    assert np.isfinite(found.path).all()
    assert np.isfinite(found.covariance).all()


def test_a_prior_far_beyond_a_limit_comes_back_to_it() -> None:
    # GIVEN a belief that is sure of a place 30 m below the floor, and of a speed ten times the highest
    case = Case("floor", 0)
    belief = case.drawn.belief
    belief.mean[2 : belief.states : 6] = 30.0
    belief.mean[3 : belief.states : 6] = 40.0
    agents = belief.states // 6
    settings = EstimatorSettings(limits=LimitsTable(vehicle=VehicleLimits(floor_m=0.0, speed_mps=4.0)))
    limits = state_limits(settings, Layout(tuple(range(1, agents + 1))))
    case.problem = slow_problem(case.drawn.window, belief, case.drawn.white, DT, EPS, robust=True)
    # THEN the states keep the limits all the same
    found = limited(case, limits)
    assert found.converged
    assert found.path[:, 2::6].max() <= 1e-6
    assert np.linalg.norm(found.path.reshape(-1, 2, 3)[:, 1], axis=-1).max() <= 4.0 + 1e-6
    assert np.isfinite(found.covariance).all()


def test_limits_are_turned_into_the_states_own_terms() -> None:
    # GIVEN altitudes above the origin and a box, as a configuration writes them
    table = {
        "limits": {"vehicle": {"floor_m": -1, "ceiling_m": 120, "north_m": [-50, 80], "speed_mps": 12}},
        "state_box_position_m": 100.0,
        "state_box_speed_mps": 20.0,
        "noise_bounds": "soft",
    }
    limits = state_limits(msgspec.convert(table, EstimatorSettings), Layout((1, 2)))
    # THEN they are north, east, down, m and m/s, the narrower where two are given
    assert limits is not None
    assert limits.low.tolist() == 2 * [-50.0, -100.0, -100.0, -20.0, -20.0, -20.0]
    assert limits.high.tolist() == 2 * [80.0, 100.0, 1.0, 20.0, 20.0, 20.0]
    assert limits.speed_mps == 12.0
    assert limits.noise_price == EstimatorSettings().noise_bounds_penalty
    assert state_limits(EstimatorSettings(), Layout((1, 2))) is None
