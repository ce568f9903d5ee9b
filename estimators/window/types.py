"""What goes into the solution of one window, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass

from estimators.consensus.information import NO_PAIRS, Pairs
from estimators.estimator import SolverReport, Status
from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.row_kernels import IntArray


@dataclass(slots=True)
class WindowProblem:
    """A window as its estimator hands it over; shapes as in `estimators.window.kernels.moving_horizon_step`."""

    rows: RowTable
    start: IntArray
    accel: Matrix
    accel_variance: Matrix
    information: Matrix
    vector: Vector
    """Fused prior pair (15)-(16); where there are ``pairs``, room for it."""
    keep: IntArray
    """Slots that stay in the optimisation although no row names them."""
    period_s: float
    with_gains: bool
    pairs: Pairs = NO_PAIRS
    """Pairs still to be fused into ``information`` and ``vector``: the last round of consensus."""


@dataclass(slots=True)
class WindowSolution:
    """Optimum of a window.

    ``path`` ``(N+1, 6n)``: the states of the window given everything in it; ``next_information``
    ``(6n, 6n)``: the arrival cost of the window that starts one tick later, before consensus.
    """

    path: Matrix
    next_information: Matrix
    status: Status
    report: SolverReport
