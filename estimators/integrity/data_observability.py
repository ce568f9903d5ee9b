"""What the data alone say of the fleet: the information filter without the prior.

An estimate holds what was measured and what was believed at the start; where the data say nothing, the covariance
of the second kind passes for knowledge. Here the same rows, linearised along the same path, are filtered from a
start that knows nothing (an observability Gramian that forgets as the process noise says). A direction whose
variance stays that of the start is not observable from what this agent has.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_upper, factor_upper, inverse_from_cholesky
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import OBSERVABLE_SIGMA_M
from estimators.integrity.window_evidence import WindowEvidence
from estimators.model.corrections import add_row_information
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Matrix, RowTable
from estimators.model.members import MemberChange
from estimators.model.motion import predict_information
from estimators.model.row_kernels import IntArray

START_SIGMA_M = 100.0
START_SIGMA_MPS = 10.0
"""What stands for knowing nothing."""


def no_information(agents: int) -> Matrix:
    """Information ``(6n, 6n)`` of a start that knows nothing."""
    sigmas = np.repeat([START_SIGMA_M, START_SIGMA_MPS], 3)
    return np.diag(np.tile(sigmas**-2.0, agents))


class ObservabilityMonitor:
    """Keeps the information that the data gave at the start of an estimator's window."""

    def __init__(self, agents: int) -> None:
        self._information = no_information(agents)

    def observe(self, evidence: WindowEvidence) -> tuple[Finding, ...]:
        """A finding about each slot whose position the window's data and those before it do not observe."""
        following = np.empty_like(self._information)
        observable = np.zeros(len(following) // STATES_PER_AGENT, np.bool_)
        sound = _filter_information(
            evidence.rows,
            evidence.start,
            evidence.accel_variance,
            np.ascontiguousarray(evidence.path),
            evidence.period_s,
            evidence.norm_smoothing,
            self._information,
            following,
            observable,
        )
        if not sound:
            self._information = no_information(len(observable))
        elif evidence.slide:
            self._information = following
        return tuple(
            Finding(What.NOT_OBSERVABLE, Gravity.ALARM, int(slot), limit=OBSERVABLE_SIGMA_M)
            for slot in np.flatnonzero(~observable)
        )

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet: of a fresh agent the data say what its prior says."""
        self._information = change.information(self._information)


@entry(
    "boolean(ROW[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64, float64, float64[:, ::1],"
    " float64[:, ::1], boolean[::1])",
    ROW=ROW,
)
def _filter_information(
    rows: RowTable,
    start: IntArray,
    accel_variance: Matrix,
    path: Matrix,
    dt: float,
    eps: float,
    information: Matrix,
    following: Matrix,
    observable: NDArray[np.bool_],
) -> bool:
    """`marginalization.filter_along` for the information alone, which depends on no value that was measured.

    ``following`` gets that of the window's second tick before its rows, ``observable`` what its last tick allows.
    False, and ``observable`` as it was, where the information is not positive definite.
    """
    info = information.copy()
    ticks = accel_variance.shape[0]
    for k in range(ticks):
        add_row_information(rows[start[k] : start[k + 1]], path[k], eps, info)
        if not predict_information(info, accel_variance[k], dt):
            return False
        if k == 0:
            following[:, :] = info
    add_row_information(rows[start[ticks] : start[ticks + 1]], path[ticks], eps, info)
    if not factor_upper(info):
        return False
    covariance = np.empty_like(info)
    inverse_from_cholesky(info, covariance)
    mark_observable(covariance, observable)
    return True


@kernel
def mark_observable(covariance: Matrix, observable: NDArray[np.bool_]) -> None:
    """observable ``(n,)`` <- whose position is known along every direction, given a covariance without a prior.

    No variance of a position reaches the limit where the limit's sphere less its covariance is positive definite.
    """
    room = np.empty((3, 3))
    for s in range(observable.shape[0]):
        p = STATES_PER_AGENT * s
        for i in range(3):
            for j in range(3):
                room[i, j] = -covariance[p + i, p + j]
            room[i, i] += OBSERVABLE_SIGMA_M**2
        observable[s] = cholesky_upper(room)
