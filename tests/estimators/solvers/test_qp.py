"""Quadratic programs: both engines against enumeration of all active sets."""

from __future__ import annotations

from itertools import product
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.solvers.qp import QpSolution, QuadraticProgram, make_engine, polish, solve_exactly

Array = NDArray[np.float64]
EngineName = Literal["osqp", "daqp"]
ENGINES: tuple[EngineName, ...] = ("osqp", "daqp")


def objective(problem: QuadraticProgram, q: Array) -> float:
    """With the penalty on soft rows; inf outside of a hard one."""
    values = problem.rows @ q
    excess = np.maximum(np.maximum(values - problem.upper, problem.lower - values), 0.0)
    hard = np.isinf(problem.penalty)
    if (excess[hard] > 1e-9).any():
        return float("inf")
    return float(0.5 * q @ q + problem.linear @ q + problem.penalty[~hard] @ excess[~hard])


def brute_force(problem: QuadraticProgram) -> Array | None:
    """The best of the stationary points of all active sets: each row free, at a bound, or beyond it at its price."""
    best, lowest = None, float("inf")
    choices = []
    for penalty in problem.penalty:
        choices.append(["free", "lower", "upper"] + ([] if np.isinf(penalty) else ["below", "above"]))
    for states in product(*choices):
        base = -problem.linear.copy()
        for i, state in enumerate(states):
            if state in ("below", "above"):
                base -= (1.0 if state == "above" else -1.0) * problem.penalty[i] * problem.rows[i]
        held = [i for i, state in enumerate(states) if state in ("lower", "upper")]
        q = base
        if held:
            active = problem.rows[held]
            bound = np.array([problem.upper[i] if states[i] == "upper" else problem.lower[i] for i in held])
            if np.linalg.matrix_rank(active) < len(held) or not np.isfinite(bound).all():
                continue
            q = base - active.T @ np.linalg.solve(active @ active.T, active @ base - bound)
        value = objective(problem, q)
        if value < lowest:
            best, lowest = q, value
    return best


def random_program(seed: int, *, independent: bool = False) -> QuadraticProgram:
    """Up to three variables and four rows: soft, hard, one-sided, equal and repeated ones.

    ``independent``: at most as many rows as variables, so that they do not contradict each other.
    """
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 4))
    m = int(rng.integers(0, d + 1 if independent else 5))
    rows = rng.normal(size=(m, d))
    if m > 1 and not independent and rng.random() < 0.3:
        rows[1] = rows[0]
    centre, half = rng.normal(size=m), rng.exponential(1.0, m) + 0.01
    lower, upper = centre - half, centre + half
    lower[rng.random(m) < 0.2] = -np.inf
    penalty = np.where(rng.random(m) < 0.6, np.exp(rng.uniform(-2, 4, m)), np.inf)
    return QuadraticProgram(3.0 * rng.normal(size=d), rows, lower, upper, penalty)


ACCURACY = 1e-7


def nothing(problem: QuadraticProgram) -> Array:
    return np.zeros(len(problem.lower))


def check_conditions(problem: QuadraticProgram, found: QpSolution, accuracy: float = ACCURACY) -> None:
    """Stationarity, signs and limits of the multipliers, complementarity."""
    assert found.q + problem.linear + problem.rows.T @ found.multipliers == pytest.approx(0.0, abs=10 * accuracy)
    values = problem.rows @ found.q
    for value, low, high, price, force in zip(
        values, problem.lower, problem.upper, problem.penalty, found.multipliers, strict=True
    ):
        assert abs(force) <= price * (1 + 1e-6)
        margin = 10 * accuracy
        if low + margin < value < high - margin:
            assert force == pytest.approx(0.0, abs=10 * margin)
        if value > high + margin:
            assert force == pytest.approx(price, rel=1e-4)
        if value < low - margin:
            assert force == pytest.approx(-price, rel=1e-4)


@pytest.mark.parametrize("name", ENGINES)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=150)
def test_engine_and_polish_are_exact(name: EngineName, seed: int) -> None:
    # GIVEN a small program that has a solution, or none; only the dual active set of DAQP is exact where rows
    # contradict each other, which no window's do
    problem = random_program(seed, independent=name == "osqp")
    best = brute_force(problem)
    # WHEN it is solved
    found = solve_exactly(problem, make_engine(name), nothing(problem))
    # THEN it is found to be so, and the solution is the best there is
    assert found.solved == (best is not None)
    if best is not None:
        np.testing.assert_allclose(found.q, best, rtol=0, atol=ACCURACY)
        check_conditions(problem, found)


@pytest.mark.parametrize("name", ENGINES)
def test_both_sides_of_a_box(name: EngineName) -> None:
    # GIVEN min 1/2 q^2 - 5 q, |q| <= 1, and its mirror image
    for sign in (1.0, -1.0):
        problem = QuadraticProgram(
            np.array([-5.0 * sign]), np.eye(1), np.array([-1.0]), np.array([1.0]), np.array([np.inf])
        )
        found = solve_exactly(problem, make_engine(name), nothing(problem))
        assert found.q == pytest.approx([sign])
        assert found.multipliers == pytest.approx([4.0 * sign])


@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize(("penalty", "expected"), [(10.0, 1.0), (4.0, 1.0), (1.5, 3.5), (0.0, 5.0)])
def test_penalty_is_exact_from_the_multiplier_on(name: EngineName, penalty: float, expected: float) -> None:
    # GIVEN the same with a soft bound: its multiplier is 4, so any price from 4 on keeps q at the bound
    problem = QuadraticProgram(
        np.array([-5.0]), np.eye(1), np.array([-1.0]), np.array([1.0]), np.array([penalty])
    )
    assert solve_exactly(problem, make_engine(name), nothing(problem)).q == pytest.approx([expected], abs=1e-7)


@pytest.mark.parametrize("name", ENGINES)
def test_infeasible_is_reported(name: EngineName) -> None:
    # GIVEN q >= 1 and q <= -1, both hard
    problem = QuadraticProgram(
        np.zeros(1), np.ones((2, 1)), np.array([1.0, -np.inf]), np.array([np.inf, -1.0]), np.full(2, np.inf)
    )
    assert not solve_exactly(problem, make_engine(name), nothing(problem)).solved


def test_guess_of_the_active_set_saves_the_engine() -> None:
    # GIVEN a program and its own multipliers
    class NoEngine:
        def solve(self, problem: QuadraticProgram) -> QpSolution:
            raise AssertionError("not needed")

    for seed in range(40):
        problem = random_program(seed)
        if brute_force(problem) is None:
            continue
        found = solve_exactly(problem, make_engine("daqp"), nothing(problem))
        # THEN they lead to the solution without any engine
        again = solve_exactly(problem, NoEngine(), found.multipliers)
        np.testing.assert_allclose(again.q, found.q, rtol=0, atol=1e-7)


def test_polish_from_a_rough_solution() -> None:
    # GIVEN what an engine of limited accuracy would answer
    settled = solvable = 0
    for seed in range(60):
        problem = random_program(seed)
        best = brute_force(problem)
        if best is None:
            continue
        solvable += 1
        rng = np.random.default_rng(seed)
        exact = solve_exactly(problem, make_engine("daqp"), nothing(problem)).multipliers
        rough = exact * (1 + 1e-6 * rng.normal(size=len(exact)))
        polished = polish(problem, np.clip(rough, -problem.penalty, problem.penalty), best + 1e-7 * rng.normal())
        if polished is not None:  # else the active set did not settle, which it says
            settled += 1
            np.testing.assert_allclose(polished.q, best, rtol=0, atol=1e-7)
    assert settled > 0.9 * solvable
