"""The motion of the fleet: a double integrator per agent, Borelle et al. 2023, eq. (27).

Position and velocity of every agent over one tick of ``dt`` seconds: p <- p + dt v + dt^2/2 a, v <- v + dt a.
All functions use that structure; the 6n by 6n matrix A is only formed for tests (`transition_matrix`).
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import kernel
from estimators.compiled.linear_algebra import factor_upper, mirror_upper
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, Vector


def transition_matrix(agents: int, dt: float) -> Matrix:
    """A ``(6n, 6n)`` of (27)."""
    return np.asarray(np.kron(np.eye(agents), np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))), np.float64)


def input_matrix(agents: int, dt: float) -> Matrix:
    """B ``(6n, 3n)`` of (27)."""
    return np.asarray(np.kron(np.eye(agents), np.kron(np.array([[dt * dt / 2.0], [dt]]), np.eye(3))), np.float64)


def predict_mean(x: Vector, accel: Vector, dt: float) -> Vector:
    """A x + B accel; x ``(6n,)`` NED m and m/s, accel ``(3n,)`` m/s2, zero where unknown."""
    blocks, pushes = x.reshape(-1, 2, 3), accel.reshape(-1, 3)
    moved = blocks[:, 0] + dt * blocks[:, 1] + 0.5 * dt * dt * pushes
    return np.stack([moved, blocks[:, 1] + dt * pushes], axis=1).ravel()


@kernel
def predict_state(x: Vector, accel: Vector, dt: float, out: Vector) -> None:
    """out <- A x + B accel; x ``(6n,)`` NED m and m/s, accel ``(3n,)`` m/s2; ``out`` may be ``x``."""
    for s in range(x.shape[0] // STATES_PER_AGENT):
        p = STATES_PER_AGENT * s
        for i in range(3):
            v = x[p + 3 + i]
            a = accel[3 * s + i]
            out[p + i] = x[p + i] + dt * v + 0.5 * dt * dt * a
            out[p + 3 + i] = v + dt * a


@kernel
def predict_sensitivity(sens: Matrix, dt: float) -> None:
    """sens <- A sens, in place, for ``(6n, m)``."""
    m = sens.shape[1]
    for s in range(sens.shape[0] // STATES_PER_AGENT):
        p = STATES_PER_AGENT * s
        for i in range(3):
            for j in range(m):
                sens[p + i, j] += dt * sens[p + 3 + i, j]


@kernel
def transpose_predict(adjoint: Vector, dt: float) -> None:
    """adjoint <- A' adjoint, in place."""
    for s in range(adjoint.shape[0] // STATES_PER_AGENT):
        p = STATES_PER_AGENT * s
        for i in range(3):
            adjoint[p + 3 + i] += dt * adjoint[p + i]


@kernel
def transpose_predict_all(adjoints: Matrix, dt: float) -> None:
    """adjoints <- A' adjoints, in place, for ``(6n, m)``."""
    m = adjoints.shape[1]
    for s in range(adjoints.shape[0] // STATES_PER_AGENT):
        p = STATES_PER_AGENT * s
        for i in range(3):
            for j in range(m):
                adjoints[p + 3 + i, j] += dt * adjoints[p + i, j]


@kernel
def predict_covariance(cov: Matrix, accel_variance: Vector, dt: float) -> None:
    """cov <- A cov A' + B Q B', in place; eqs (17) and (20). ``accel_variance`` ``(3n,)`` is diag Q."""
    n = cov.shape[0]
    predict_sensitivity(cov, dt)
    for r in range(n):
        for s in range(n // STATES_PER_AGENT):
            p = STATES_PER_AGENT * s
            for i in range(3):
                cov[r, p + i] += dt * cov[r, p + 3 + i]
    add_input_noise(cov, accel_variance, dt)


@kernel
def add_input_noise(cov: Matrix, accel_variance: Vector, dt: float) -> None:
    """cov <- cov + B Q B'."""
    for s in range(cov.shape[0] // STATES_PER_AGENT):
        for i in range(3):
            q = accel_variance[3 * s + i]
            p = STATES_PER_AGENT * s + i
            v = p + 3
            cov[p, p] += 0.25 * dt**4 * q
            cov[p, v] += 0.5 * dt**3 * q
            cov[v, p] += 0.5 * dt**3 * q
            cov[v, v] += dt * dt * q


@kernel
def predict_information(info: Matrix, accel_variance: Vector, dt: float) -> bool:
    """info <- (A info^-1 A' + B Q B')^-1 without an inverse of order 6n; False where it is not definite.

    With P = A^-T info A^-1 and W = B Q^1/2: P - P W (I + W' P W)^-1 W' P, one factorisation of order 3n.
    Zero variances are allowed.
    """
    n = info.shape[0]
    agents = n // STATES_PER_AGENT
    for s in range(agents):  # P = A^-T info A^-1, rows then columns
        p = STATES_PER_AGENT * s
        for i in range(3):
            for j in range(n):
                info[p + 3 + i, j] -= dt * info[p + i, j]
    for r in range(n):
        for s in range(agents):
            p = STATES_PER_AGENT * s
            for i in range(3):
                info[r, p + 3 + i] -= dt * info[r, p + i]
    m = 3 * agents
    gain = np.empty((m, n))  # W' P
    for s in range(agents):
        p = STATES_PER_AGENT * s
        for i in range(3):
            w = np.sqrt(accel_variance[3 * s + i])
            for j in range(n):
                gain[3 * s + i, j] = w * (0.5 * dt * dt * info[p + i, j] + dt * info[p + 3 + i, j])
    inner = np.empty((m, m))  # I + W' P W
    for r in range(m):
        for s in range(agents):
            p = STATES_PER_AGENT * s
            for i in range(3):
                w = np.sqrt(accel_variance[3 * s + i])
                inner[r, 3 * s + i] = w * (0.5 * dt * dt * gain[r, p + i] + dt * gain[r, p + 3 + i])
        inner[r, r] += 1.0
    if not factor_upper(inner):
        return False
    for k in range(m):  # gain <- U'^-1 gain, all columns at once
        scale = 1.0 / inner[k, k]
        for j in range(n):
            gain[k, j] *= scale
        for i in range(k + 1, m):
            factor = inner[k, i]
            if factor != 0.0:
                for j in range(n):
                    gain[i, j] -= factor * gain[k, j]
    for k in range(m):
        for i in range(n):
            factor = gain[k, i]
            if factor != 0.0:
                for j in range(i, n):
                    info[i, j] -= factor * gain[k, j]
    mirror_upper(info)
    return True
