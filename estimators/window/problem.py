"""What goes into the solution of one window, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from estimators.compiled.entries import structure
from estimators.estimator import SolverReport, Status
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.row_kernels import IntArray


class WindowProblem(NamedTuple):
    """A window of N ticks and m rows as its estimator hands it over, and as the kernels take it."""

    rows: RowTable
    """``(m,)``, sorted by tick."""
    start: IntArray
    """``(N+2,)``: first row of each tick, then m."""
    accel: Matrix
    """``(N, 3n)`` accelerations assumed over each tick, m/s2."""
    accel_variance: Matrix
    """``(N, 3n)`` variances of their noise."""
    information: Matrix
    """``(6n, 6n)`` of the fused prior pair at the window's start, (15)-(16)."""
    vector: Vector
    """``(6n,)``."""
    keep: IntArray
    """Slots that stay in the optimisation although no row names them (the agent itself)."""
    period_s: float
    with_gains: bool
    """EKF pre-estimation; otherwise input corrections are variables (DMHE-1)."""


PROBLEM = structure(
    WindowProblem,
    "ROW[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], int64[::1], float64,"
    " boolean",
    ROW=ROW,
)


class StepOptions(NamedTuple):
    """How a window is solved."""

    eps: float
    """Of the smoothed norms, m or m/s."""
    bounds_on: int
    """Which residuals the noise bounds are checked on: `NOTHING`, `CORRECTED` or `PREDICTED`."""
    box_position: float
    """Largest position component, m; inf: no bound."""
    box_speed: float
    """Largest velocity component, m/s; inf: no bound."""
    max_iterations: int
    tolerance: float
    """Largest change of a variable still expected at the end, m or m/s."""


OPTIONS = structure(StepOptions, "float64, int64, float64, float64, int64, float64")

NOTHING = 0
CORRECTED = 1
PREDICTED = 2


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
