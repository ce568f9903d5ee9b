"""Minimisation of a window's smooth problem: damped Gauss-Newton that finishes with the exact Hessian."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import kernel
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper
from estimators.model.measurements import Matrix, Vector
from estimators.model.row_kernels import PRECISION
from estimators.window.least_squares import (
    Trajectory,
    Window,
    correction_hessian,
    empty_trajectory,
    gradient,
    hessian,
    roll_out,
)

ROUNDING = 1e-13
"""Relative change of the objective that is rounding, not ascent."""

FAR_STEP = 0.3
"""First step (m or m/s) from which on the start is far: then the steps are damped from the beginning.

Undamped Gauss-Newton steps from far away decrease the objective and still land in the basin of a worse
minimum (speed rows near |v| = 0 have a sphere of almost equal values).
"""

FAR_DAMPING = 1e-2
PATIENCE = 20
"""Linearisations after which Gauss-Newton is taken to creep."""

INDEFINITE_LIMIT = 10.0
"""Relative shift of the diagonal up to which an indefinite Hessian is repaired rather than replaced."""
SLOW_CONTRACTION = 0.2
"""Ratio of successive steps above which a chord step (old Hessian) gives way to a new linearisation."""


@kernel
def set_weights(window: Window, path: Trajectory) -> None:
    """Weights of the plain objective: residual over variance; innovations have no cost of their own."""
    for r in range(window.code.shape[0]):
        path.weights[r] = window.data[r, PRECISION] * path.residuals[r]
        path.predicted_weights[r] = 0.0


@kernel
def _fill_hessian(window: Window, path: Trajectory, exact: bool, h: Matrix) -> None:
    """Upper triangle of h <- Gauss-Newton or exact Hessian, see `estimators.window.least_squares.hessian`."""
    if window.gains.shape[0] == 0 and window.noise_precision.shape[0] > 0:
        correction_hessian(window, path, exact, h)
    else:
        hessian(window, path, exact, h, np.empty((path.states.size, h.shape[0])))


@kernel
def _scale(h: Matrix, i: int) -> float:
    """What variable i is damped in proportion to: the mean of |h_ii| over its position, velocity or input.

    The three components of a vector have one scale (all variables are such triples), so that the iterations,
    and with them the minimum that is found among several, do not depend on which way north is.
    """
    k = i - i % 3
    return float(abs(h[k, k]) + abs(h[k + 1, k + 1]) + abs(h[k + 2, k + 2])) / 3.0


@kernel
def _damped_factor(h: Matrix, damping: float, factor: Matrix) -> bool:
    """factor <- upper Cholesky of h + damping on its diagonal; False where that is not positive definite."""
    n = h.shape[0]
    for i in range(n):
        for j in range(i, n):
            factor[i, j] = h[i, j]
        factor[i, i] += damping * _scale(h, i)
    return factor_upper(factor)


@kernel
def _largest(v: Vector) -> float:
    """The longest of the 3-vectors that ``v`` consists of."""
    largest = 0.0
    for i in range(0, v.shape[0], 3):
        largest = max(largest, v[i] * v[i] + v[i + 1] * v[i + 1] + v[i + 2] * v[i + 2])
    return float(np.sqrt(largest))


@kernel
def minimise(
    window: Window, z: Vector, max_iterations: int, tolerance: float
) -> tuple[Trajectory, float, int, bool]:
    """Minimise the window's objective from ``z``, in place.

    Each iteration linearises once (Gauss-Newton first, the exact Hessian afterwards; Levenberg-Marquardt
    damping on the diagonal while steps are far or the model is poor), then takes chord steps with the same
    factor while they contract. Converged when the change still expected from another iteration, estimated
    from the contraction, is below ``tolerance`` (m, m/s) in every variable.

    Returns the path at the minimum, the objective f, iterations (linearisations and chord steps), converged.
    """
    n = z.shape[0]
    path = empty_trajectory(window)
    g = np.empty(n)
    h = np.empty((n, n))
    factor = np.empty((n, n))
    trial = np.empty(n)
    value = roll_out(window, z, path)
    damping = 0.0
    last_step = np.inf
    iterations = 0
    linearisations = 0
    while iterations < max_iterations:
        set_weights(window, path)
        gradient(window, z, path, g)
        exact = linearisations > 0
        _fill_hessian(window, path, exact, h)
        creeping = linearisations > PATIENCE
        if exact:
            # Gauss-Newton replaces an indefinite Hessian: it keeps to the basin of the start. Where it creeps
            # along a curved valley, the Hessian is damped until definite instead.
            shift = damping
            limit = INDEFINITE_LIMIT if creeping else damping
            while exact and not _damped_factor(h, shift, factor):
                shift = max(1e-3, 4.0 * shift)
                exact = shift <= limit
            if exact:
                damping = shift
            else:
                _fill_hessian(window, path, False, h)
        if not exact:
            while not _damped_factor(h, damping, factor):
                damping = max(1e-6, 10.0 * damping)
                if damping > 1e12:
                    return path, value, iterations, False
        step = -g
        cholesky_solve(factor, step)
        size = _largest(step)
        if linearisations == 0 and size > FAR_STEP:
            damping = FAR_DAMPING
            _damped_factor(h, damping, factor)
            step = -g
            cholesky_solve(factor, step)
            size = _largest(step)
        linearisations += 1
        iterations += 1
        decrease = 0.0  # of the quadratic model: -g's - s'Hs/2, with (H + D) s = -g
        for i in range(n):
            decrease -= 0.5 * step[i] * (g[i] - damping * _scale(h, i) * step[i])
            trial[i] = z[i] + step[i]
        new = roll_out(window, trial, path)
        if not new <= value + ROUNDING * abs(value):
            value = roll_out(window, z, path)
            if size < tolerance:
                return path, value, iterations, True
            damping = max(4.0 * damping, 4e-3)
            if damping > 1e12:
                return path, value, iterations, False
            continue
        quality = (value - new) / decrease if decrease > ROUNDING * abs(value) else 1.0
        value = new
        z[:] = trial
        if quality > 0.75:
            damping = damping / 8.0 if damping > 1e-6 else 0.0
        elif quality < 0.25:
            damping = max(3.0 * damping, 1e-3)
        if damping == 0.0:
            contraction = min(size / last_step, 1.0)
            if exact and size * contraction < tolerance:
                return path, value, iterations, True
            value, size, steps, done = _chord(window, z, path, factor, value, size, tolerance, g, trial)
            iterations += steps
            if done:
                return path, value, iterations, True
        elif size < tolerance and damping < FAR_DAMPING:
            return path, value, iterations, True
        last_step = size
    return path, value, iterations, False


@kernel
def _chord(
    window: Window,
    z: Vector,
    path: Trajectory,
    factor: Matrix,
    value: float,
    size: float,
    tolerance: float,
    g: Vector,
    trial: Vector,
) -> tuple[float, float, int, bool]:
    """Steps with an old factor while each is much smaller than the one before.

    Returns the objective, the size of the last step taken, how many were taken, converged.
    """
    steps = 0
    while True:
        set_weights(window, path)
        gradient(window, z, path, g)
        step = -g
        cholesky_solve(factor, step)
        new_size = _largest(step)
        contraction = new_size / size
        if not contraction < SLOW_CONTRACTION:
            return value, size, steps, new_size < tolerance * 1e-3
        for i in range(z.shape[0]):
            trial[i] = z[i] + step[i]
        new = roll_out(window, trial, path)
        if not new <= value + ROUNDING * abs(value):
            roll_out(window, z, path)
            return value, size, steps, new_size < tolerance
        steps += 1
        value = new
        size = new_size
        z[:] = trial
        if new_size * contraction / (1.0 - contraction) < tolerance:
            return value, size, steps, True
