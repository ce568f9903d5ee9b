"""The arrival cost: what a window's start is believed to be from all that left the window, in two ways.

The *smoothed* one is the paper's: where the window's second state lies given everything in the window, with the
information predicted to it. The *filtered* one marginalises the dropped tick, so that nothing is used twice
(`estimators.window.marginalization`). Both are beliefs before consensus about the window that the next tick opens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import plain
from estimators.estimator import Estimate, Status
from estimators.model.gaussian import symmetrised
from estimators.model.measurements import ROW, Matrix, RowTable
from estimators.model.members import InformationState
from estimators.window.history import MeasurementWindow
from estimators.window.marginalization import Filtering, filter_reweighted
from estimators.window.problem import WindowProblem, WindowSolution


def smoothed_arrival(problem: WindowProblem, solution: WindowSolution, *, slide: bool) -> InformationState:
    """Lines 18-23 of Algorithm 1 of Borelle et al. 2023; with ``slide`` false (t < N) the window's start stays."""
    if slide:
        return InformationState(solution.path[1], solution.next_information)
    return InformationState(solution.path[0], problem.information)


class Filtered(NamedTuple):
    """What the information filter along a window's smoothed path found."""

    arrival: InformationState
    covariance: Matrix
    """``(6n, 6n)`` of the newest state."""
    rows: RowTable
    """The window's, with variances that hold what their linearisation misses."""


def filtered_arrival(problem: WindowProblem, path: Matrix, norm_smoothing: float, *, slide: bool) -> Filtered:
    """Filter a solved window along its states ``path`` ``(N+1, 6n)``; with ``slide`` false its start stays.

    Raises ``ArithmeticError`` where a belief on the way is not positive definite.
    """
    n = len(problem.vector)
    found = Filtering(np.empty(len(problem.rows), ROW), np.empty((n, n)), np.empty(n), np.empty((n, n)))
    if not filter_reweighted(plain(problem), np.ascontiguousarray(path), norm_smoothing, plain(found)):
        raise ArithmeticError("the window's information is not positive definite")
    if slide:
        arrival = InformationState(found.mean, found.information)
    else:
        information = np.ascontiguousarray(problem.information)
        mean = np.asarray(np.linalg.solve(information, problem.vector), np.float64)
        arrival = InformationState(mean, information)
    return Filtered(arrival, symmetrised(found.covariance), found.rows)


def first_estimate(window: MeasurementWindow, prior: InformationState) -> Estimate:
    """The estimate at the first tick, where there is nothing but the prior."""
    status = Status.OK if len(window.rows()[0]) else Status.NO_DATA
    return Estimate(window.last, prior.mean.copy(), prior.covariance(), status, window.ages())
