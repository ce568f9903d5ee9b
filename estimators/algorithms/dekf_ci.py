"""Distributed EKF with consensus on information (DEKF-CI), Battistelli et al. 2015, as the paper's rival.

Correct with the regional rows, fuse the information pairs of the neighbourhood with convex weights, predict.
The first measurements are used at the first tick: a start at one point (x0 = 0) has no gradient in the norm
rows there, and one prediction later an arbitrary one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper, inverse_from_cholesky
from estimators.consensus.information import fuse, usable_pairs
from estimators.estimator import Estimate, Payload, Status, symmetrised
from estimators.integrity.observability import observability_rank
from estimators.model.layout import STATES_PER_AGENT, Layout
from estimators.model.measurements import ROW, InputTable, Matrix, RowTable, Vector, empty_rows
from estimators.model.motion import predict_information, predict_mean, predict_state
from estimators.model.row_kernels import (
    PRECISION,
    VALUE,
    add_curvature,
    add_gradient,
    dot_gradient,
    encode_rows,
    predict_row,
)
from estimators.settings import EstimatorSettings
from estimators.window.history import MeasurementWindow


@kernel
def add_corrections(
    rows: RowTable, predicted: Vector, eps: float, information: Matrix, vector: Vector
) -> None:
    """Add rows to an information pair, linearised at ``predicted``: C'R^-1 C and C'R^-1 (y - h + C x)."""
    m = rows.shape[0]
    code = np.empty((m, 3), np.int64)
    data = np.empty((m, 7))
    unit = np.empty(4)
    encode_rows(rows, np.arange(predicted.shape[0] // STATES_PER_AGENT), code, data)
    for r in range(m):
        innovation = data[r, VALUE] - predict_row(code, data, r, predicted, eps, unit)
        pseudo = innovation + dot_gradient(code, data, r, unit, predicted)
        add_gradient(code, data, r, unit, data[r, PRECISION] * pseudo, vector)
        add_curvature(code, data, r, unit, data[r, PRECISION], 0.0, information)


@entry(
    "boolean(ROW[::1], float64[::1], float64[::1], float64, float64, boolean, float64[::1], float64[:, ::1],"
    " float64[::1])",
    ROW=ROW,
)
def predict_and_correct(
    rows: RowTable,
    accel: Vector,
    accel_variance: Vector,
    dt: float,
    eps: float,
    predict: bool,
    mean: Vector,
    information: Matrix,
    vector: Vector,
) -> bool:
    """Filtered pair of the last tick to corrected pair of this one.

    ``mean`` becomes the predicted mean, ``information`` is replaced, ``vector`` is written. False where the
    prediction cannot be formed.
    """
    if predict:
        predict_state(mean, accel, dt, mean)
        if not predict_information(information, accel_variance, dt):
            return False
    for i in range(mean.shape[0]):
        vector[i] = 0.0
        for j in range(mean.shape[0]):
            vector[i] += information[i, j] * mean[j]
    add_corrections(rows, mean, eps, information, vector)
    return True


@entry("boolean(float64[:, ::1], float64[::1], float64[::1], float64[:, ::1])")
def recover(information: Matrix, vector: Vector, mean: Vector, covariance: Matrix) -> bool:
    """Mean and covariance of an information pair; False where it is not positive definite."""
    root = information.copy()
    if not factor_upper(root):
        return False
    mean[:] = vector
    cholesky_solve(root, mean)
    inverse_from_cholesky(root, covariance)
    return True


class DistributedEkf:
    """One agent's DEKF-CI; arguments as in `estimators.factory.make_estimator`.

    Late rows are counted and dropped: a filter has no window to put them into. The settings' ``window`` only
    sets the horizon of the observability rank, evaluated at the prediction, as in the frozen cases.
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
        # The window keeps one tick: the input over (k-1, k) is only known at k.
        self.window = MeasurementWindow(
            layout,
            1,
            other_accel_variance=settings.other_accel_variance,
            reciprocal_ranges=settings.reciprocal_ranges,
        )
        self._mean = np.array(prior_mean, float)
        self._information = symmetrised(np.linalg.inv(prior_covariance))
        self._pair: tuple[Matrix, Vector] = (self._information, self._information @ self._mean)
        self._healthy = True
        self._motion: tuple[Vector, Vector] | None = None
        """Acceleration and its variance over the tick that ends now; None at the first."""
        self._rows = empty_rows()
        self._rank = 0
        self._ranks: dict[int, int] = {}
        self._degree = 0
        self.refused_pairs = 0
        """Neighbours' pairs of the right tick that could not be fused."""

    @property
    def dropped(self) -> int:
        """Rows and inputs that came after their tick."""
        return self.window.dropped

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Predict to the tick and correct with its regional rows."""
        first = self.window.open(tick)
        self.window.insert_current(measurements, inputs)
        rows, start = self.window.rows()
        rows = rows[start[-2] :]
        accel, variance = self.window.inputs()
        self._motion = None if first else (accel[-1], variance[-1])
        unknown = np.zeros(3 * self.layout.size)
        predicted, information = self._mean.copy(), self._information.copy()
        vector = np.empty_like(predicted)
        self._healthy = predict_and_correct(
            rows,
            unknown if first else accel[-1],
            unknown if first else variance[-1],
            self.period_s,
            self.settings.norm_smoothing_m,
            not first,
            predicted,
            information,
            vector,
        )
        self._pair = (information, vector)
        self._rows = rows
        self._rank = self._observability_rank(predicted)
        self._ranks = {}

    def _observability_rank(self, predicted: Vector) -> int:
        """Rank over the coming ticks if nothing but the clock moved: x, A x, A^2 x, ... with today's rows."""
        if self.settings.weights != "observability_rank" or self.rounds == 0:
            return 0
        states = [predicted]
        for _ in range(self.settings.window):
            states.append(predict_mean(states[-1], np.zeros(3 * self.layout.size), self.period_s))
        eps = self.settings.norm_smoothing_m
        return observability_rank([self._rows] * len(states), states, self.period_s, eps)

    def outgoing(self, round_: int) -> Payload:
        """The corrected pair after ``round_`` rounds."""
        return Payload(self.window.last, *self._pair, self._rank, self._degree)

    def mix(self, round_: int, received: Mapping[int, Payload]) -> None:
        """One round of consensus on information. Pairs of another tick are not used."""
        usable, refused = usable_pairs(received, self.window.last, self.layout.dimension)
        self.refused_pairs += refused
        if round_ == 0:
            self._ranks = {slot: pair.rank for slot, pair in usable.items()}
            self._degree = len(usable)
        for slot in usable:
            self.window.hear(slot, self.window.last)
        self._pair = fuse(self.outgoing(round_), usable, self.settings.weights, self._ranks)

    def solve(self, budget: int | None = None) -> Estimate:
        """Mean and covariance of the fused pair; ``budget`` is not used, nothing iterates."""
        mean, covariance = np.empty_like(self._mean), np.empty_like(self._information)
        healthy = self._healthy and recover(*self._pair, mean, covariance)
        if not healthy or not np.isfinite(mean).all() or not np.isfinite(covariance).all():
            return self._keep_last()
        self._mean, self._information = mean.copy(), self._pair[0]
        status = Status.OK if len(self._rows) else Status.NO_DATA
        return Estimate(self.window.last, mean, symmetrised(covariance), status, self.window.ages())

    def _keep_last(self) -> Estimate:
        """The last good estimate carried to this tick, flagged, where the new one cannot be formed."""
        if self._motion is not None:
            mean, information, vector = self._mean.copy(), self._information.copy(), np.empty_like(self._mean)
            eps = self.settings.norm_smoothing_m
            if predict_and_correct(
                empty_rows(), *self._motion, self.period_s, eps, True, mean, information, vector
            ):
                self._mean, self._information = mean, information
        covariance = symmetrised(np.linalg.inv(self._information))
        return Estimate(
            self.window.last, self._mean.copy(), covariance, Status.FELL_BACK, self.window.ages()
        )
