"""Full-information estimation of a flight: iterated Kalman smoothing over all ticks since the start.

Gauss-Newton on the prior, the accelerations' noise and all rows: one iteration is a Kalman filter forwards with
every tick's rows linearised at the last path, and a Rauch-Tung-Striebel pass backwards (Bell 1994: the iterated
Kalman smoother as a Gauss-Newton method). From tick to tick only what changed is done again: the filter goes on
from the first tick with new records, other accelerations or a path that moved.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Estimate, SolverReport, Status
from estimators.integrity.observability import row_jacobian
from estimators.model.gaussian import symmetrised
from estimators.model.layout import Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.motion import input_matrix, predict_mean, transition_matrix
from estimators.settings import EstimatorSettings, fade_per_tick
from estimators.window.history import MeasurementWindow
from sim_bridge.studies.study_input import StudyInput

RELINEARISE = 1e-4
"""Movement of a tick's state, m or m/s, from which on its rows are linearised anew: an error of its square."""
MOST_ITERATIONS = 30
FULL_STEPS = 8
"""Iterations with the whole Gauss-Newton step; then half of it, which ends a swing between two paths."""

Floats = NDArray[np.float64]


class FullInformationSmoother:
    """One agent's smoother; it starts from the agent's own first estimate in the recording."""

    def __init__(self, recording: StudyInput, settings: EstimatorSettings, slot: int) -> None:
        layout = Layout(tuple(int(a) for a in recording.agents))
        ticks, n = recording.ticks + 1, layout.dimension
        self._window = MeasurementWindow(
            layout,
            ticks,
            other_accel_variance=settings.other_accel_variance,
            reciprocal_ranges=settings.reciprocal_ranges,
            unknown_inputs=settings.unknown_inputs,
            held_accel_fade=fade_per_tick(settings, recording.period_s),
        )
        self._eps = settings.norm_smoothing_m
        self._period_s = recording.period_s
        self._transition = transition_matrix(layout.size, recording.period_s)
        self._push = input_matrix(layout.size, recording.period_s)
        self._accel, self._variance = np.full((2, ticks - 1, n // 2), np.nan)
        self._row_counts = np.full(ticks, -1)
        self._predicted_mean, self._mean, self._path = np.empty((3, ticks, n))
        self._linearised_at = np.full((ticks, n), np.nan)
        self._predicted_cov, self._cov = np.empty((2, ticks, n, n))
        self._predicted_mean[0] = recording.x0[slot]
        self._predicted_cov[0] = recording.P0

    def step(self, tick: int, rows: RowTable, inputs: InputTable) -> Estimate:
        """Take in what arrived, rows and inputs of any tick so far, and solve; ticks grow by one from 0."""
        self._window.open(tick)
        self._window.insert(rows, inputs)
        all_rows, start = self._window.rows()
        by_tick = [all_rows[a:b] for a, b in pairwise(start)]
        first = self._first_changed(tick, by_tick)
        if tick:
            self._path[tick] = predict_mean(self._path[tick - 1], self._accel[tick - 1], self._period_s)
        else:
            self._path[0] = self._predicted_mean[0]
        for iteration in range(1, MOST_ITERATIONS + 1):
            self._filter(first, tick, by_tick)
            self._smooth(tick)
            if iteration > FULL_STEPS:
                self._path[: tick + 1] = 0.5 * (self._path[: tick + 1] + self._linearised_at[: tick + 1])
            moved = np.abs(self._path[: tick + 1] - self._linearised_at[: tick + 1]).max(axis=1)
            if (moved <= RELINEARISE).all():
                break
            first = int(np.argmax(moved > RELINEARISE))
        converged = bool((moved <= RELINEARISE).all())
        return Estimate(
            tick,
            self._path[tick].copy(),
            self._cov[tick].copy(),
            Status.OK if converged else Status.NOT_CONVERGED,
            self._window.ages(),
            SolverReport(iterations=iteration),
        )

    def _first_changed(self, tick: int, by_tick: list[RowTable]) -> int:
        """The first tick whose rows, or whose acceleration before it, are not what they were a tick ago."""
        counts = np.array([len(rows) for rows in by_tick])
        changed = counts != self._row_counts[: tick + 1]  # rows are only ever added
        self._row_counts[: tick + 1] = counts
        if tick:
            accel, variance = self._window.inputs()
            same = (accel == self._accel[:tick]) & (variance == self._variance[:tick])
            changed[1:] |= ~same.all(axis=1)
            self._accel[:tick], self._variance[:tick] = accel, variance
        return int(np.argmax(changed)) if changed.any() else tick

    def _filter(self, first: int, last: int, by_tick: list[RowTable]) -> None:
        """Kalman filter over ticks first..last, the rows linearised along the path."""
        for k in range(first, last + 1):
            if k:
                noise = (self._push * self._variance[k - 1]) @ self._push.T
                mean = predict_mean(self._mean[k - 1], self._accel[k - 1], self._period_s)
                self._predicted_mean[k] = mean
                self._predicted_cov[k] = symmetrised(self._transition @ self._cov[k - 1] @ self._transition.T + noise)
            self._linearised_at[k] = self._path[k]
            self._mean[k], self._cov[k] = self._corrected(k, by_tick[k])

    def _corrected(self, k: int, rows: RowTable) -> tuple[Vector, Matrix]:
        """Mean and covariance of tick k after its rows, in information form: rows may outnumber states."""
        mean, covariance = self._predicted_mean[k], self._predicted_cov[k]
        if not len(rows):
            return mean, covariance
        at = self._linearised_at[k]
        predicted, jacobian = row_jacobian(rows, at, self._eps)
        weighted = jacobian.T / rows["variance"]
        corrected = symmetrised(np.linalg.inv(np.linalg.inv(covariance) + weighted @ jacobian))
        innovation = rows["value"] - predicted - jacobian @ (mean - at)
        return mean + corrected @ (weighted @ innovation), corrected

    def _smooth(self, last: int) -> None:
        """Backward pass over all ticks; replaces the path."""
        self._path[last] = self._mean[last]
        for k in range(last - 1, -1, -1):
            correction = self._path[k + 1] - self._predicted_mean[k + 1]
            back = np.linalg.solve(self._predicted_cov[k + 1], correction)
            self._path[k] = self._mean[k] + self._cov[k] @ (self._transition.T @ back)
