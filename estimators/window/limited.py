"""Solving a window whose states have limits: without them first, within them where the optimum breaks one.

Where ranges leave two places for a vehicle, one of them is often beyond a limit: the mirror image, below the floor,
of a drone above a flat fleet. Held at its limit, the estimate would stay on the wrong side. So where a place is
beyond a limit, the window is solved from its mirror image in the plane of the others, too; the better one is taken.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimators.model.gaussian import symmetrised
from estimators.model.layout import STATES_PER_AGENT, position
from estimators.model.limits import StateLimits
from estimators.model.measurements import Matrix, Vector
from estimators.solvers.bounded_window import solve_bounded, violates
from estimators.solvers.qp import QpEngine
from estimators.systematic.belief import SlowBelief
from estimators.window.slow_window import SlowProblem, SlowSolution, continued, solve_slow

DISAGREEMENT_SQUARE = 9.0
"""Squared Mahalanobis distance of two places that are not the same: three sigma."""
FEWEST_OTHERS = 3
"""A plane needs so many places."""


def solve_limited(
    problem: SlowProblem,
    belief: SlowBelief,
    guess: tuple[Matrix, Vector],
    max_iterations: int,
    tolerance: float,
    limits: tuple[StateLimits, QpEngine] | None,
    *,
    slide: bool,
) -> SlowSolution:
    """`solve_slow` within limits, whose programs the engine solves; None: there are none.

    Where the limits cannot be kept the last iterate is given, as not converged. The covariance is that of the problem
    linearised where it comes to rest, and says nothing of the limits; whom they move too far is told (`strained`).
    """
    free = solve_slow(problem, belief, guess, max_iterations, tolerance, slide=slide)
    if limits is None or not violates(problem.window, limits[0], free.path, free.slow):
        return free
    kept = _within(problem, belief, free, max_iterations, tolerance, limits, slide=slide)
    there = _other_side(free.path, _beyond(free.path, limits[0]))
    if there is None:
        return kept
    start = continued(there[None], problem, free.slow), free.slow
    other = solve_slow(problem, belief, start, max_iterations, tolerance, slide=slide)
    if violates(problem.window, limits[0], other.path, other.slow):
        other = _within(problem, belief, other, max_iterations, tolerance, limits, slide=slide)
    best, left = (other, kept) if other.converged and other.cost < kept.cost else (kept, other)
    iterations, programs = best.iterations + left.iterations, best.programs + left.programs
    return replace(best, iterations=iterations, programs=programs)


def _within(
    problem: SlowProblem,
    belief: SlowBelief,
    free: SlowSolution,
    max_iterations: int,
    tolerance: float,
    limits: tuple[StateLimits, QpEngine],
    *,
    slide: bool,
) -> SlowSolution:
    """The optimum within limits, from the one without."""
    prior = np.linalg.inv(belief.covariance)
    found = solve_bounded(
        problem.window, symmetrised(prior), *limits, (free.path, free.slow), max_iterations, tolerance
    )
    settled = solve_slow(problem, belief, (found.path, found.slow), 0, tolerance, slide=slide)
    return replace(
        settled,
        converged=found.converged,
        iterations=free.iterations + found.iterations,
        cost=found.cost,
        programs=found.programs,
        active=found.active,
        strained=_strained(free, found.path[-1]),
    )


def _strained(free: SlowSolution, kept: Vector) -> tuple[int, ...]:
    """Slots whose newest place limits move by more than `DISAGREEMENT_SQUARE` allows: something is wrong there."""
    strained = []
    for slot in range(len(kept) // STATES_PER_AGENT):
        place = position(slot)
        away = kept[place] - free.path[-1, place]
        if float(away @ np.linalg.solve(free.covariance[place, place], away)) > DISAGREEMENT_SQUARE:
            strained.append(slot)
    return tuple(strained)


def _beyond(path: Matrix, limits: StateLimits) -> NDArray[np.bool_]:
    """``(n,)``: which agents have a place beyond a limit, at some tick."""
    out = ((path < limits.low) | (path > limits.high)).any(axis=0)
    return np.asarray(out.reshape(-1, 2, 3)[:, 0].any(axis=-1))


def _other_side(path: Matrix, beyond: NDArray[np.bool_]) -> Vector | None:
    """First state ``(6n,)`` with the agents ``(n,)`` in question mirrored in the plane that is closest to the others.

    None where nobody is in question, or too few are not.
    """
    vectors = path[0].reshape(-1, 2, 3).copy()
    others = vectors[~beyond]
    if not beyond.any() or len(others) < FEWEST_OTHERS:
        return None
    centre = others.mean(axis=0)
    about = others[:, 0] - centre[0]
    normal = np.linalg.eigh(about.T @ about)[1][:, 0]
    vectors[beyond] -= 2.0 * ((vectors[beyond] - centre) @ normal)[..., None] * normal
    return np.asarray(vectors.reshape(len(beyond) * STATES_PER_AGENT))
