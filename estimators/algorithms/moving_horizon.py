"""Distributed moving horizon estimators with arrival-cost consensus: DMHE-pre-EKF and DMHE-1.

Algorithm 1 of Borelle et al. 2023, with its line 18 read as t < N (at t = N the arrival cost must already
move, else time 0 would be the prior of the window that starts at 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from estimators.consensus.information import Pairs, fuse_pairs, usable_pairs, weigh
from estimators.estimator import Estimate, Payload, SolverReport, Status, symmetrised
from estimators.integrity.observability import observability_rank
from estimators.model.layout import Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.motion import predict_mean
from estimators.model.row_kernels import IntArray
from estimators.settings import EstimatorSettings, fade_per_tick
from estimators.window.history import MeasurementWindow
from estimators.window.solving import pre_estimation, solve_window
from estimators.window.types import NO_PAIRS, WindowProblem, WindowSolution


class MovingHorizonEstimator:
    """One agent's DMHE, with EKF pre-estimation (``dmhe_pre_ekf``) or with input corrections (``dmhe``).

    Parameters
    ----------
    settings
        ``kind`` chooses between the two.
    layout, slot
        The fleet and this agent's place in it.
    prior_mean, prior_covariance : ``(6n,)``, ``(6n, 6n)``
        Of the fleet state at the first tick, NED m and m/s.
    period_s
        Length of a tick.
    """

    def __init__(
        self,
        settings: EstimatorSettings,
        layout: Layout,
        slot: int,
        prior_mean: Vector,
        prior_covariance: Matrix,
        period_s: float,
    ) -> None:
        self.settings = settings
        self.layout = layout
        self.slot = slot
        self.period_s = period_s
        self.rounds = settings.rounds
        self.window = MeasurementWindow(
            layout,
            settings.window,
            other_accel_variance=settings.other_accel_variance,
            reciprocal_ranges=settings.reciprocal_ranges,
            unknown_inputs=settings.unknown_inputs,
            held_accel_fade=fade_per_tick(settings, period_s),
        )
        self.prior_mean = np.array(prior_mean, float)
        """Mean at the window's start: before consensus until `solve`, which replaces it by (16)."""
        self.prior_information = symmetrised(np.linalg.inv(prior_covariance))
        self._with_gains = settings.kind == "dmhe_pre_ekf"
        self._pair: tuple[Matrix, Vector] = (self.prior_information, self.prior_information @ prior_mean)
        self._pending: Pairs | None = None
        """The last round of consensus, which `solve` fuses in the same call as the rest of its step."""
        self._keep: IntArray = np.array([slot], np.int64)
        self._rank = 0
        self._ranks: dict[int, int] = {}
        self._degree = 0
        self.refused_pairs = 0
        """Neighbours' pairs of the right tick that could not be fused."""
        self._path: list[Vector] = [self.prior_mean]
        """Estimates of the states of the previous window, oldest first."""

    @property
    def dropped(self) -> int:
        """Rows and inputs that came too late for the window."""
        return self.window.dropped

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Open a tick: slide the window, insert what arrived, compute the observability rank (24)-(25)."""
        self.window.open(tick)
        self.window.insert(measurements, inputs)
        self._pair = (self.prior_information, self.prior_information @ self.prior_mean)
        self._pending = None
        self._ranks = {}
        self._rank = self._observability_rank() if self.window.last > self.window.first else 0

    def _observability_rank(self) -> int:
        """Rank over the window, at the previous window's estimates and their prediction to this tick."""
        if self.settings.weights != "observability_rank" or self.rounds == 0:
            return 0
        rows, start = self.window.rows()
        accel, _ = self.window.inputs()
        newest = predict_mean(self._path[-1], accel[-1], self.period_s)
        states = [*self._path, newest][-(len(start) - 1) :]
        by_tick = [rows[a:b] for a, b in pairwise(start)]
        return observability_rank(by_tick, states, self.period_s, self.settings.norm_smoothing_m)

    def outgoing(self, round_: int) -> Payload:
        """The information pair (11)-(12) after ``round_`` rounds."""
        if self._pending is not None:
            self._pair, self._pending = fuse_pairs(self._pending), None
        information, vector = self._pair
        return Payload(self.window.first, information, vector, self._rank, self._degree)

    def mix(self, round_: int, received: Mapping[int, Payload]) -> None:
        """One round of (13)-(14). Pairs of another window start are not used."""
        usable, refused = usable_pairs(received, self.window.first, self.layout.dimension)
        self.refused_pairs += refused
        if round_ == 0:
            self._ranks = {slot: pair.rank for slot, pair in usable.items()}
            self._degree = len(usable)
        for slot in usable:
            self.window.hear(slot, self.window.first)
        if self.window.last > self.window.first:  # at the very first tick there is no window to solve
            self._pending = weigh(self.outgoing(round_), usable, self.settings.weights, self._ranks)

    def solve(self, budget: int | None = None) -> Estimate:
        """Solve the window (5)-(10) and move the arrival cost (17)-(18)."""
        if self.window.last == self.window.first:
            return self._first_estimate()
        problem = self._problem()
        solution = solve_window(problem, self.settings, budget)
        self._slide(problem, solution)
        return self._estimate(problem, solution.path[-1], solution.status, solution.report)

    def _problem(self) -> WindowProblem:
        rows, start = self.window.rows()
        accel, variance = self.window.inputs()
        n = self.layout.dimension
        information, vector = self._pair if self._pending is None else (np.empty((n, n)), np.empty(n))
        return WindowProblem(
            rows=rows,
            start=start,
            accel=accel,
            accel_variance=variance,
            information=information,
            vector=vector,
            keep=self._keep,
            period_s=self.period_s,
            with_gains=self._with_gains,
            pairs=NO_PAIRS if self._pending is None else self._pending,
        )

    def _slide(self, problem: WindowProblem, solution: WindowSolution) -> None:
        """Lines 18-23 of Algorithm 1: the prior of the next window."""
        self._path = list(solution.path)
        if self.window.last - self.window.first < self.settings.window:  # t < N: the start stays
            self.prior_information = problem.information
            self.prior_mean = solution.path[0]
        else:
            self.prior_information = solution.next_information
            self.prior_mean = solution.path[1]

    def _first_estimate(self) -> Estimate:
        """At the first tick there is nothing but the prior."""
        covariance = np.linalg.inv(self.prior_information)
        status = Status.OK if len(self.window.rows()[0]) else Status.NO_DATA
        return Estimate(
            self.window.last, self.prior_mean.copy(), symmetrised(covariance), status, self.window.ages()
        )

    def _estimate(
        self, problem: WindowProblem, mean: Vector, status: Status, report: SolverReport
    ) -> Estimate:
        """The estimate at the window's end, with the covariance (22) of the pre-estimation."""
        _, covariance = pre_estimation(problem, self.settings.norm_smoothing_m)
        if status is Status.OK and not len(problem.rows):
            status = Status.NO_DATA
        return Estimate(self.window.last, mean, covariance, status, self.window.ages(), report)
