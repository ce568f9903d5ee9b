"""Distributed EKF with consensus on information (DEKF-CI), Battistelli et al. 2015, as the paper's rival.

Correct with the regional rows, fuse the information pairs of the neighbourhood with convex weights, predict.
The first measurements are used at the first tick: a start at one point (x0 = 0) has no gradient in the norm
rows there, and one prediction later an arbitrary one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from estimators.compiled.entries import entry
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper, inverse_from_cholesky
from estimators.consensus.fusion import Fusion
from estimators.estimator import Estimate, Payload, Status
from estimators.integrity.observability import observability_rank
from estimators.model.corrections import add_corrections
from estimators.model.gaussian import Prior, symmetrised
from estimators.model.layout import ALL_VEHICLES, Kinds, Layout
from estimators.model.measurements import ROW, InputTable, Matrix, RowTable, Vector, empty_rows
from estimators.model.members import InformationState, MemberChange
from estimators.model.motion import predict_information, predict_mean, predict_state
from estimators.settings import EstimatorSettings
from estimators.window.history import MeasurementWindow


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

    fixed_members = False

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
        self.state = InformationState.from_moments(prior_mean, prior_covariance)
        """Filtered belief about the last tick."""
        self._consensus = Fusion(settings.weights)
        self._healthy = True
        self._motion: tuple[Vector, Vector] | None = None
        """Acceleration and its variance over the tick that ends now; None at the first."""
        self._rows = empty_rows()

    @property
    def dropped(self) -> int:
        """Rows and inputs that came after their tick."""
        return self.window.dropped

    @property
    def refused_pairs(self) -> int:
        """Neighbours' pairs of the right tick that could not be fused."""
        return self._consensus.refused

    @property
    def prior_tick(self) -> int:
        """The last tick."""
        return self.window.last

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Predict to the tick and correct with its regional rows."""
        first = self.window.open(tick)
        self.window.insert_current(measurements, inputs)
        rows, start = self.window.rows()
        rows = rows[start[-2] :]
        accel, variance = self.window.inputs()
        self._motion = None if first else (accel[-1], variance[-1])
        unknown = np.zeros(3 * self.layout.size)
        predicted, information = self.state.mean.copy(), self.state.information.copy()
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
        self._rows = rows
        self._consensus.begin(tick, (information, vector), self._observability_rank(predicted))

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
        return self._consensus.outgoing()

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        """One round of consensus on information. Pairs of another tick are not used."""
        for slot in self._consensus.mix(round_, received):
            self.window.hear(slot, self.window.last)
        return ()

    def solve(self, budget: int | None = None) -> Estimate:
        """Mean and covariance of the fused pair; ``budget`` is not used, nothing iterates."""
        fused = self._consensus.outgoing()
        mean, covariance = np.empty_like(fused.vector), np.empty_like(fused.information)
        healthy = self._healthy and recover(fused.information, fused.vector, mean, covariance)
        if not healthy or not np.isfinite(mean).all() or not np.isfinite(covariance).all():
            return self._keep_last()
        self.state = InformationState(mean.copy(), fused.information)
        status = Status.OK if len(self._rows) else Status.NO_DATA
        return Estimate(self.window.last, mean, symmetrised(covariance), status, self.window.ages())

    def _keep_last(self) -> Estimate:
        """The last good estimate carried to this tick, flagged, where the new one cannot be formed."""
        if self._motion is not None:
            mean, information = self.state.mean.copy(), self.state.information.copy()
            vector, eps = np.empty_like(mean), self.settings.norm_smoothing_m
            if predict_and_correct(
                empty_rows(), *self._motion, self.period_s, eps, True, mean, information, vector
            ):
                self.state = InformationState(mean, information)
        return Estimate(
            self.window.last,
            self.state.mean.copy(),
            self.state.covariance(),
            Status.FELL_BACK,
            self.window.ages(),
        )

    def change_members(
        self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior], kinds: Kinds = ALL_VEHICLES
    ) -> None:
        """Let agents join and leave, see `estimators.estimator.Estimator`."""
        change = MemberChange.between(self.layout, agents, own, fresh, kinds)
        self.state = self.state.reindexed(change)
        self.layout, self.slot = change.after, change.own
        self.window.change_members(change)
        self._consensus.change_members()
