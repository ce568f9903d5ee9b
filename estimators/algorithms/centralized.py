"""Centralised EKF, plain or iterated, over all rows and all inputs: the yardstick of the distributed ones."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from estimators.estimator import Estimate, Payload, Status
from estimators.integrity.observability import row_jacobian
from estimators.model.gaussian import Prior, symmetrised
from estimators.model.layout import ALL_VEHICLES, Kinds, Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.motion import input_matrix, predict_mean, transition_matrix
from estimators.settings import EstimatorSettings
from estimators.window.history import MeasurementWindow

STEP_TOLERANCE = 1e-9
"""Change of the state, m or m/s, below which the iterated update has converged."""


def update(
    mean: Vector, covariance: Matrix, rows: RowTable, eps: float, iterations: int
) -> tuple[Vector, Matrix]:
    """(Iterated) EKF measurement update; returns mean and covariance.

    The iterated one is Gauss-Newton on the prior and the rows: it relinearises at the last iterate and keeps
    the predicted mean as prior.
    """
    if not len(rows):
        return mean, covariance
    noise = np.diag(rows["variance"])
    x = mean
    for _ in range(iterations):
        predicted, jacobian = row_jacobian(rows, x, eps)
        gain = np.linalg.solve(jacobian @ covariance @ jacobian.T + noise, jacobian @ covariance).T
        last, x = x, mean + gain @ (rows["value"] - predicted - jacobian @ (mean - x))
        if np.abs(x - last).max() < STEP_TOLERANCE:
            break
    joseph = np.eye(len(mean)) - gain @ jacobian
    return x, joseph @ covariance @ joseph.T + gain @ noise @ gain.T


class CentralizedEkf:
    """One filter for the whole fleet; arguments as in `estimators.factory.make_estimator`.

    It exchanges nothing: `begin` gets everybody's rows and inputs. Late rows are counted and dropped.
    """

    rounds = 0
    fixed_members = True

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
        self.window = MeasurementWindow(
            layout,
            1,
            other_accel_variance=settings.other_accel_variance,
            reciprocal_ranges=settings.reciprocal_ranges,
        )
        self._mean = np.array(prior_mean, float)
        self._covariance = symmetrised(np.asarray(prior_covariance, float))
        self._period_s = period_s
        self._transition = transition_matrix(layout.size, period_s)
        self._inputs = input_matrix(layout.size, period_s)
        self._had_rows = False

    @property
    def dropped(self) -> int:
        """Rows and inputs that came after their tick."""
        return self.window.dropped

    @property
    def prior_tick(self) -> int:
        """The last tick."""
        return self.window.last

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Predict to the tick and update with its rows."""
        first = self.window.open(tick)
        self.window.insert_current(measurements, inputs)
        if not first:
            accel, variance = self.window.inputs()
            self._mean = predict_mean(self._mean, accel[-1], self._period_s)
            noise = (self._inputs * variance[-1]) @ self._inputs.T
            self._covariance = self._transition @ self._covariance @ self._transition.T + noise
        rows, start = self.window.rows()
        rows = rows[start[-2] :]
        eps, iterations = self.settings.norm_smoothing_m, self.settings.iterations_ekf
        self._mean, self._covariance = update(
            self._mean, symmetrised(self._covariance), rows, eps, iterations
        )
        self._had_rows = len(rows) > 0

    def outgoing(self, round_: int) -> Payload:
        """A centralised filter has no neighbours."""
        raise RuntimeError("a centralised filter exchanges nothing (rounds is 0)")

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        """A centralised filter has no neighbours."""
        raise RuntimeError("a centralised filter exchanges nothing (rounds is 0)")

    def solve(self, budget: int | None = None) -> Estimate:
        """The filtered estimate; ``budget`` is not used."""
        return Estimate(
            self.window.last,
            self._mean.copy(),
            symmetrised(self._covariance),
            Status.OK if self._had_rows else Status.NO_DATA,
            self.window.ages(),
        )

    def change_members(
        self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior], kinds: Kinds = ALL_VEHICLES
    ) -> None:
        """A yardstick of fixed fleets."""
        raise RuntimeError("the fleet of a centralised filter is fixed")
