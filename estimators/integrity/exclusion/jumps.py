"""A receiver that has jumped far: where the ranges have its drone, in one bin, beyond what is linear in the shift.

A shift as large as the distances turns the directions that `fault_odds` is linear along. So while what is new is too
large for slow errors, the shift is fitted to the ranges themselves, from several places near the others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.exclusion.baselines import BIN_S
from estimators.integrity.exclusion.fault_odds import LikelyFault
from estimators.integrity.exclusion.slow_errors import Fresh
from estimators.model.measurements import Matrix, Vector

JUMPED_SQUARE = 10.0
"""Normalised square of what is new, on average, from which on a jump is looked for."""
JUMP_M = 60.0
"""1-sigma of a jump, per axis."""
STEPS = 12
BESIDE_M = 8.0
"""From the middle of the others, where the search begins; besides in the middle itself."""
BEGINS = BESIDE_M * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], np.float64)


def jump(fresh: Fresh, agent: int) -> LikelyFault | None:
    """The odds of one receiver's fixes of this bin being anywhere, and how far they are off; needs three ranges."""
    sign = -fresh.sign(agent)
    of_agent = np.flatnonzero(sign)
    if len(of_agent) < 3:
        return None
    to_it = sign[of_agent, None] * fresh.directions[of_agent]
    apart = fresh.distances_m[of_agent, None] * to_it  # by the fixes
    found = [_fitted(fresh, of_agent, apart, np.mean(apart, axis=0) + begin) for begin in BEGINS]
    cost, shift_m, information = min(found, key=lambda each: each[0])
    paid = 0.5 * float(np.linalg.slogdet(information * JUMP_M**2)[1])
    nats = 0.5 * (float(fresh.value @ fresh.value) - cost) - paid
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return LikelyFault(nats, shift_m, covariance, np.zeros((fresh.rows.shape[1], 3)), 1.0, BIN_S)


def _fitted(fresh: Fresh, of_agent: NDArray[np.intp], apart: Matrix, shift_m: Vector) -> tuple[float, Vector, Matrix]:
    """Cost, shift and information of the fit that begins at a shift (Levenberg and Marquardt)."""
    cost, residual, slope = _at(fresh, of_agent, apart, shift_m)
    damping = 1e-3
    for _ in range(STEPS):
        information = slope.T @ slope + np.eye(3) / JUMP_M**2
        step = np.linalg.solve(
            information + damping * np.diag(information.diagonal()), slope.T @ residual - shift_m / JUMP_M**2
        )
        tried = _at(fresh, of_agent, apart, shift_m + step)
        if tried[0] < cost:
            shift_m, damping = shift_m + step, 0.1 * damping
            cost, residual, slope = tried
        else:
            damping *= 10.0
    return cost, shift_m, slope.T @ slope + np.eye(3) / JUMP_M**2


def _at(fresh: Fresh, of_agent: NDArray[np.intp], apart: Matrix, shift_m: Vector) -> tuple[float, Vector, Matrix]:
    """Cost, what is left over, whitened, and how that falls with the shift ``(r, 3)``."""
    true = apart - shift_m
    distance = np.maximum(np.linalg.norm(true, axis=1), 1e-3)
    left = fresh.residual_m.copy()
    left[of_agent] += fresh.distances_m[of_agent] - distance
    slope = np.zeros((len(left), 3))
    slope[of_agent] = -true / distance[:, None]
    residual = fresh.whiten @ left
    cost = float(residual @ residual + shift_m @ shift_m / JUMP_M**2)
    return cost, residual, fresh.whiten @ slope
