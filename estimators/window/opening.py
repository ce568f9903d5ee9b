"""Windows of a drone whose velocity is not known yet: a second place to begin from.

A speed without a direction leaves a sphere of velocities, a range one of places. From a first estimate that is not
good the iteration may end on the wrong side of it, and what the arrival cost then holds is sure of that. So until the
velocities are known, the window is also solved from where its linear rows alone have the fleet: fixes, velocities and
accelerations, none of them weighted down. The better one of the two is taken.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimators.model.measurements import Kind, Matrix, Vector
from estimators.model.row_kernels import PRECISION
from estimators.systematic.belief import SlowBelief
from estimators.window.slow_window import IGNORED_FACTOR, SlowProblem, solve_slow

STEPS = 2
"""Linear rows need one; the second one sees that it was enough."""
LINEAR = (Kind.POSITION, Kind.VELOCITY, Kind.HEIGHT, Kind.ODOMETRY, Kind.RELATIVE)
"""Kinds of rows without a norm."""
KNOWN_SIGMA_MPS = 0.5
"""A velocity that is known better is on the right side of the sphere of a flying drone's speed."""


def is_open(problem: SlowProblem, belief: SlowBelief) -> bool:
    """Whether the velocity of a drone with fixes in the window is not known at its start."""
    variance = belief.covariance.diagonal()[: belief.states].reshape(-1, 6)[:, 3:].max(axis=1)
    fixed = problem.rows["agent"][problem.rows["kind"] == Kind.POSITION]
    return bool((variance[fixed] > KNOWN_SIGMA_MPS**2).any())


def guess_of_linear_rows(
    problem: SlowProblem, belief: SlowBelief, guess: tuple[Matrix, Vector], tolerance: float
) -> tuple[Matrix, Vector] | None:
    """The path ``(N+1, 6n)`` and slow errors ``(q,)`` that the rows without a norm alone have.

    None where all rows are linear, and where there are none. Raises ``ArithmeticError`` as `solve_slow` does.
    """
    linear = np.isin(problem.rows["kind"], LINEAR)
    if linear.all() or not linear.any():
        return None
    data = problem.window.data.copy()
    data[~linear, PRECISION] *= IGNORED_FACTOR
    alone = replace(problem, window=problem.window._replace(data=data, robust=False))
    found = solve_slow(alone, belief, guess, STEPS, tolerance, slide=False)
    return found.path, found.slow
