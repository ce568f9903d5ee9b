"""Posterior Cramer-Rao bound of the fleet state: what no filter on the same data can beat on average.

Tichavsky, Muravchik, Nehorai 1998, for additive Gaussian noise and the linear motion (27): the recursion is the
information filter's, with what the rows say averaged over the flights that may happen and taken at the truth
instead of an estimate. Along one flight alone it gives the covariance of an EKF that linearises at the truth;
the average over flights is below that, since rows of changing direction complete each other.

All inputs are known up to their noise; an input that a filter does not know enters with the variance it
assumes for it. The sensors' noises here are uniform and bounded; the bound is that of Gaussian noise with the
same variance, and holds for filters that use no more of the noise than its variance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.observability import row_jacobian
from estimators.model.gaussian import symmetrised
from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.motion import input_matrix, transition_matrix

Flight = tuple[Sequence[RowTable], Matrix]
"""Rows of every tick (their values do not matter) and the true states ``(T+1, 6n)``."""


def row_information(rows: RowTable, state: Vector, eps: float) -> Matrix:
    """C' R^-1 C ``(6n, 6n)`` of rows at a fleet state ``(6n,)``."""
    _, jacobian = row_jacobian(rows, state, eps)
    return np.asarray((jacobian.T / rows["variance"]) @ jacobian, np.float64)


def mean_row_information(flights: Iterable[Flight], eps: float) -> NDArray[np.float64]:
    """What the rows of every tick say, on average over flights of equal length: ``(T+1, 6n, 6n)``.

    ``eps`` smooths the norm rows. Raises ``ValueError`` without flights and for lengths that do not fit.
    """
    total: NDArray[np.float64] | None = None
    count = 0
    for rows_by_tick, truth in flights:
        if len(rows_by_tick) != len(truth) or (total is not None and len(truth) != len(total)):
            raise ValueError(
                f"bound: flight {count}: expected rows and true states of as many ticks as in the others, "
                f"found {len(rows_by_tick)} and {len(truth)}"
            )
        found = np.array([row_information(r, x, eps) for r, x in zip(rows_by_tick, truth, strict=True)])
        total = found if total is None else total + found
        count += 1
    if total is None:
        raise ValueError("bound: expected at least one flight, found none")
    return np.asarray(total / count, np.float64)


def posterior_information(
    measured: NDArray[np.float64], accel_variance: Matrix, prior_information: Matrix, dt: float
) -> NDArray[np.float64]:
    """Information J_k ``(T+1, 6n, 6n)``; its inverse bounds the mean squared error.

    J_0 = prior + M_0 and J_{k+1} = (A J_k^-1 A' + B Q_k B')^-1 + M_{k+1}.

    Parameters
    ----------
    measured : ``(T+1, 6n, 6n)``
        M of every tick, from `mean_row_information`.
    accel_variance : ``(T, 3n)``
        diag Q over each tick, (m/s2)^2.
    prior_information : ``(6n, 6n)``
        Of the state at the first tick, before its rows.
    dt
        Period in s.

    Raises ``ValueError`` for lengths that do not fit, ``numpy.linalg.LinAlgError`` where the prior and the first
    rows leave a direction of the state without information.
    """
    ticks = len(measured)
    if len(accel_variance) != ticks - 1:
        raise ValueError(f"bound: expected input variances of {ticks - 1} ticks, found {len(accel_variance)}")
    agents = len(prior_information) // 6
    transition, push = transition_matrix(agents, dt), input_matrix(agents, dt)
    found = np.empty_like(measured)
    found[0] = prior_information + measured[0]
    for k in range(1, ticks):
        noise = (push * accel_variance[k - 1]) @ push.T
        predicted = transition @ np.linalg.inv(found[k - 1]) @ transition.T + noise
        found[k] = symmetrised(np.linalg.inv(predicted) + measured[k])
    return found


def rms_bound(information: NDArray[np.float64], states: slice = slice(None)) -> Vector:
    """Smallest root mean square norm ``(T+1,)`` of the error of some states, from `posterior_information`.

    The norm mixes m and m/s where ``states`` does; `estimators.layout.position` picks one agent's position.
    """
    covariance = np.linalg.inv(information)
    return np.asarray(np.sqrt(np.trace(covariance[:, states, states], axis1=1, axis2=2)), np.float64)
