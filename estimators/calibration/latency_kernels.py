"""Compiled steps of the filters of `estimators.calibration.latency`: a fix costs less than a library call."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.model.measurements import Matrix, Vector

PSI, STATES = 6, 7
"""Place of the heading error among the states ``[p(2), v(2), b(2), psi]``, and their number."""
SMOOTH_S = 0.5
"""The acceleration is averaged over this."""
HALF_S = SMOOTH_S / 2
GATE = 13.816
"""99.9 % of chi-square with two degrees of freedom."""


@entry("void(float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[:, ::1])")
def fill_integrals(table: Matrix, from_s: Vector, to_s: Vector, gained: Matrix, moved: Matrix) -> None:
    """What smoothed acceleration adds to velocity and position over spans of time, each ``(k, 2)``.

    ``table`` ``(pieces, 5)``: start, end, north, east, variance. The moving average of an integral is a difference
    of the next one.
    """
    pieces = table.shape[0]
    edges = np.append(table[:1, 0], table[:, 1])
    once, twice, thrice = np.zeros((pieces + 1, 2)), np.zeros((pieces + 1, 2)), np.zeros((pieces + 1, 2))
    for k in range(pieces):
        w = table[k, 1] - table[k, 0]
        for axis in range(2):
            accel = table[k, 2 + axis]
            once[k + 1, axis] = once[k, axis] + w * accel
            twice[k + 1, axis] = twice[k, axis] + w * (once[k, axis] + w / 2 * accel)
            inner = twice[k, axis] + w / 2 * (once[k, axis] + w / 3 * accel)
            thrice[k + 1, axis] = thrice[k, axis] + w * inner
    second, third = np.empty(4), np.empty(4)
    for j in range(from_s.shape[0]):
        times = (from_s[j] - HALF_S, from_s[j] + HALF_S, to_s[j] - HALF_S, to_s[j] + HALF_S)
        for axis in range(2):
            for end in range(4):
                k = min(max(np.searchsorted(edges, times[end], side="right") - 1, 0), pieces - 1)
                u, accel = times[end] - edges[k], table[k, 2 + axis]
                second[end] = twice[k, axis] + u * (once[k, axis] + u / 2 * accel)
                third[end] = thrice[k, axis] + u * (twice[k, axis] + u / 2 * (once[k, axis] + u / 3 * accel))
            start_speed, end_speed = (second[1] - second[0]) / SMOOTH_S, (second[3] - second[2]) / SMOOTH_S
            start_place, end_place = (third[1] - third[0]) / SMOOTH_S, (third[3] - third[2]) / SMOOTH_S
            gained[j, axis] = end_speed - start_speed
            moved[j, axis] = end_place - start_place - (to_s[j] - from_s[j]) * start_speed


@entry("UniTuple(float64, 2)(float64[:, ::1], float64)")
def measure_excitation(table: Matrix, about_s: float) -> tuple[float, float]:
    """See `estimators.calibration.latency.AccelerationHistory.excitation`; ``table`` as in `fill_integrals`."""
    pieces, near = table.shape[0], 0
    north, east, near_north, near_east, variance = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(pieces):
        north += table[k, 2]
        east += table[k, 3]
        if abs(0.5 * (table[k, 0] + table[k, 1]) - about_s) <= HALF_S:
            near += 1
            near_north += table[k, 2]
            near_east += table[k, 3]
            variance += table[k, 4]
    if near == 0:
        return 0.0, 1.0
    north, east = near_north / near - north / pieces, near_east / near - east / pieces
    return north * north + east * east, variance / near**2


@entry("float64(float64[:, ::1])")
def largest_density(table: Matrix) -> float:
    """Largest product of a piece's length and its variance; ``table`` as in `fill_integrals`."""
    largest = 0.0
    for k in range(table.shape[0]):
        largest = max(largest, (table[k, 1] - table[k, 0]) * table[k, 4])
    return largest


@entry(
    "UniTuple(float64, 2)(float64[::1], float64[::1], float64[:, ::1], float64[::1], float64[::1], float64[::1])"
)
def weigh_latencies(
    log_likelihood: Vector,
    log_prior: Vector,
    interpolation: Matrix,
    fine_s: Vector,
    fine_log_prior: Vector,
    weights: Vector,
) -> tuple[float, float]:
    """Mean and sigma of the latency in s, on the fine grid ``(f,)``.

    ``log_likelihood`` ``(k,)``, whose largest becomes 0, is brought there by ``interpolation`` ``(f, k)``.
    ``weights`` ``(k,)`` gets those of the filters.
    """
    log_likelihood -= log_likelihood.max()
    weights[:] = np.exp(log_likelihood + log_prior)
    weights /= weights.sum()
    fine = fine_log_prior.copy()
    for i in range(fine.shape[0]):
        for k in range(log_likelihood.shape[0]):
            fine[i] += interpolation[i, k] * log_likelihood[k]
    fine = np.exp(fine - fine.max())
    fine /= fine.sum()
    mean, square = 0.0, 0.0
    for i in range(fine.shape[0]):
        mean += fine[i] * fine_s[i]
    for i in range(fine.shape[0]):
        square += fine[i] * (fine_s[i] - mean) ** 2
    return mean, np.sqrt(square)


@entry(
    "void(float64[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1], float64, float64[::1],"
    " float64[::1], float64, float64)"
)
def move_bank(
    means: Matrix,
    covariance: Matrix,
    weights: Vector,
    gained: Matrix,
    moved: Matrix,
    duration_s: float,
    rate: Vector,
    stationary: Vector,
    grown: float,
    wander: float,
) -> None:
    """Move all filters on by a time, in place.

    ``means`` ``(k, 7)``, ``covariance`` ``(7, 7)``, ``weights`` ``(k,)``; ``gained``, ``moved`` ``(k, 2)`` is what
    the acceleration adds to velocity and position. Bias and heading ``(3,)`` fade at the ``rate``, 1/s, towards their
    ``stationary`` variance; the variance ``grown`` is added to the velocity per axis, ``wander`` to the position.
    """
    transition = np.eye(STATES)
    for axis in range(2):
        transition[axis, 2 + axis] = duration_s
        transition[axis, 4 + axis] = -0.5 * duration_s * duration_s
        transition[2 + axis, 4 + axis] = -duration_s
    kept = np.exp(-rate * duration_s)
    for i in range(3):
        transition[4 + i, 4 + i] = kept[i]
    before = np.empty(STATES)
    common = np.zeros((2, 2))  # weighted means of moved and gained
    for m in range(means.shape[0]):
        before[:] = means[m]
        psi = before[PSI]
        for i in range(STATES):
            means[m, i] = 0.0
            for j in range(i, STATES):
                means[m, i] += transition[i, j] * before[j]
        means[m, 0] += moved[m, 0] - psi * moved[m, 1]
        means[m, 1] += moved[m, 1] + psi * moved[m, 0]
        means[m, 2] += gained[m, 0] - psi * gained[m, 1]
        means[m, 3] += gained[m, 1] + psi * gained[m, 0]
        for axis in range(2):
            common[0, axis] += weights[m] * moved[m, axis]
            common[1, axis] += weights[m] * gained[m, axis]
    for part in range(2):
        transition[2 * part, PSI] = -common[part, 1]
        transition[2 * part + 1, PSI] = common[part, 0]
    _transform(transition, covariance)
    for axis in range(2):
        covariance[axis, axis] += wander + grown * duration_s**2 / 3
        covariance[axis, axis + 2] += 0.5 * grown * duration_s
        covariance[axis + 2, axis] += 0.5 * grown * duration_s
        covariance[axis + 2, axis + 2] += grown
    for i in range(3):
        covariance[4 + i, 4 + i] += (1.0 - kept[i] * kept[i]) * stationary[i]


@entry("boolean(float64[:, ::1], float64[:, ::1], float64[::1], int64, float64, float64, float64, float64[::1])")
def update_bank(
    means: Matrix,
    covariance: Matrix,
    weights: Vector,
    at: int,
    north: float,
    east: float,
    variance: float,
    squares: Vector,
) -> bool:
    """Update all filters, in place, with two components of the state from ``at`` on.

    False, and nothing changed, where their weighted mean is beyond the gate. Shapes as in `move_bank`; ``variance``
    is per axis, ``squares`` ``(k,)`` gets the normalised innovation squared of each filter.
    """
    a, b = covariance[at, at] + variance, covariance[at, at + 1]
    d = covariance[at + 1, at + 1] + variance
    scale = 1.0 / (a * d - b**2)
    innovations = np.empty((means.shape[0], 2))
    mean_north, mean_east = 0.0, 0.0
    for m in range(means.shape[0]):
        innovations[m, 0], innovations[m, 1] = north - means[m, at], east - means[m, at + 1]
        mean_north += weights[m] * innovations[m, 0]
        mean_east += weights[m] * innovations[m, 1]
    if not scale * (d * mean_north**2 - 2.0 * b * mean_north * mean_east + a * mean_east**2) <= GATE:
        return False
    gain = np.empty((STATES, 2))
    kept = np.eye(STATES)
    for i in range(STATES):
        gain[i, 0] = scale * (covariance[i, at] * d - covariance[i, at + 1] * b)
        gain[i, 1] = scale * (covariance[i, at + 1] * a - covariance[i, at] * b)
        kept[i, at] -= gain[i, 0]
        kept[i, at + 1] -= gain[i, 1]
    for m in range(means.shape[0]):
        n, e = innovations[m, 0], innovations[m, 1]
        squares[m] = scale * (d * n**2 - 2.0 * b * n * e + a * e**2)
        for i in range(STATES):
            means[m, i] += gain[i, 0] * n + gain[i, 1] * e
    _transform(kept, covariance)
    for i in range(STATES):
        for j in range(i, STATES):
            both = covariance[i, j] + covariance[j, i]
            noise = variance * (gain[i, 0] * gain[j, 0] + gain[i, 1] * gain[j, 1])
            covariance[i, j] = covariance[j, i] = 0.5 * both + noise
    return True


@kernel
def _transform(by: Matrix, covariance: Matrix) -> None:
    """covariance <- by covariance by'."""
    n = covariance.shape[0]
    half = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            for j in range(n):
                half[i, j] += by[i, k] * covariance[k, j]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += half[i, k] * by[j, k]
            covariance[i, j] = total
