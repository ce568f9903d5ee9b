"""Compiled steps on ellipsoids E(c, P) = {x: (x-c)' P^-1 (x-c) <= 1}; `cuts` has them as functions on values.

After Bolting and Fergani 2018, whose printed formulas are damaged: each was derived anew. None needs P^-1, so flat
sets are sets too. What a step gives holds everything that it must hold; it is the smallest of its one-parameter
family by trace, which is not always the smallest of all ellipsoids.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_solve, cholesky_upper
from estimators.model.measurements import Matrix, Vector

UNCHANGED, CUT, EMPTY = 0, 1, 2
"""What a cut did; after EMPTY the set is as it was."""
THINNEST = 1e-9
"""Of a strip's half width, of the set's own (at least of 1 m): a thinner one is widened to it, which is safe."""
ROUNDING = 1e-12
"""Of the lengths involved, by which rounding may part a strip from a set that it touches."""
FLAT = 1e-14
"""Of the trace's share across the strip, from which down the set is a line along it, and the cut exact."""
BISECTIONS = 60
NEWTON_STEPS = 3


@entry("float64(float64[::1], float64[:, ::1], float64[::1], float64[:, ::1])")
def add_ellipsoid(c: Vector, p: Matrix, u: Vector, q: Matrix) -> float:
    """(c, P) <- the sum of E(c, P) and E(u, Q), in place; gives beta.

    The Minkowski sum's ellipsoid of least trace, P/(1-beta) + Q/beta; tr = (sqrt tr P + sqrt tr Q)^2.
    """
    n = c.shape[0]
    own = added = 0.0
    for i in range(n):
        own += p[i, i]
        added += q[i, i]
        c[i] += u[i]
    if not added > 0.0:
        return 0.0
    beta = np.sqrt(added) / (np.sqrt(max(own, 0.0)) + np.sqrt(added))
    for i in range(n):
        for j in range(n):
            p[i, j] = q[i, j] / beta + (p[i, j] / (1.0 - beta) if own > 0.0 else 0.0)
    return float(beta)


@entry("Tuple((int64, float64, float64, float64))(float64[::1], float64[:, ::1], float64[::1], float64, float64)")
def cut_strip(c: Vector, p: Matrix, row: Vector, low: float, high: float) -> tuple[int, float, float, float]:
    """(c, P) <- around what of E(c, P) lies in ``low <= row . x <= high``, in place.

    Gives what it did, the weight q of the strip, and the strip drawn in to where the set is. Drawing it in against
    the set as it is now is what gives the cubic three real roots, so that its only positive one has a closed form.
    """
    n = c.shape[0]
    across = np.zeros(n)  # P row'
    middle = trace = 0.0
    for i in range(n):
        middle += row[i] * c[i]
        trace += p[i, i]
        for j in range(n):
            across[i] += p[i, j] * row[j]
    spread = square = 0.0
    for i in range(n):
        spread += row[i] * across[i]
        square += across[i] * across[i]
    half = np.sqrt(max(spread, 0.0))
    low, high = max(low, middle - half), min(high, middle + half)
    if not low <= high + ROUNDING * max(half, abs(middle), 1.0):
        return EMPTY, 0.0, low, high
    width, centre = max(0.5 * (high - low), THINNEST * max(half, 1.0)), 0.5 * (high + low)
    if not half > 0.0 or width >= half:
        return UNCHANGED, 0.0, low, high
    g = spread / (width * width)
    kappa = g * trace - square / (width * width)
    if kappa <= FLAT * g * trace:  # a line along the strip: the cut is exact
        _shrink(c, p, across, (centre - middle) / spread, (width * width) / spread)
        return CUT, np.inf, low, high
    d = (centre - middle) / width
    q = _weight(g, square / (width * width), trace, kappa, d * d)
    if not q > 0.0:
        return UNCHANGED, 0.0, low, high
    _combine(c, p, across, width, d, q, 1.0 + q * g)
    return CUT, q, low, high


@kernel
def _shrink(c: Vector, p: Matrix, across: Vector, step: float, factor: float) -> None:
    for i in range(c.shape[0]):
        c[i] += step * across[i]
        for j in range(c.shape[0]):
            p[i, j] *= factor


@kernel
def _weight(g: float, gamma: float, trace: float, kappa: float, d2: float) -> float:
    """The positive root of the cubic that the least trace obeys; zero where there is none."""
    b3 = (trace * (1.0 - d2) - gamma) / (g * g * kappa)
    if b3 >= 0.0:
        return 0.0
    b1 = 3.0 / g
    b2 = (g * (trace * (1.0 - d2) - gamma) + 2.0 * (g * trace - gamma * (1.0 - d2))) / (g * g * kappa)
    m = (3.0 * b2 - b1 * b1) / 9.0
    r = (9.0 * b1 * b2 - 27.0 * b3 - 2.0 * b1 * b1 * b1) / 54.0
    scale = np.sqrt(max(-m, 0.0))
    q = -b1 / 3.0
    if scale > 0.0:
        q += 2.0 * scale * np.cos(np.arccos(min(max(r / (scale * scale * scale), -1.0), 1.0)) / 3.0)
    for _ in range(NEWTON_STEPS):
        slope = (3.0 * q + 2.0 * b1) * q + b2
        if slope > 0.0:
            q -= (((q + b1) * q + b2) * q + b3) / slope
    return q


@kernel
def _combine(c: Vector, p: Matrix, across: Vector, width: float, d: float, q: float, big: float) -> None:
    """The ellipsoid that set and strip with weight q have in common."""
    n = c.shape[0]
    size = 1.0 + q - q * d * d / big
    for i in range(n):
        c[i] += across[i] / width * q * d / big
    for i in range(n):
        for j in range(i, n):
            value = 0.5 * (p[i, j] + p[j, i]) - q / big * (across[i] / width) * (across[j] / width)
            p[i, j] = p[j, i] = size * value


@entry("Tuple((float64, float64, float64))(float64[::1], float64[:, ::1], float64[::1], float64, float64)")
def range_strip(d0: Vector, p: Matrix, u: Vector, range_m: float, half_width_m: float) -> tuple[float, float, float]:
    """Low and high of ``u . d`` for all d of E(d0, P) with a norm within ``half_width_m`` of ``range_m``; and rho.

    Vectors ``(3,)``, ``u`` any unit vector. A sphere is no strip: rho is the most that it bends away from one over
    the set, and without it the strip cuts off the truth. High needs none, since u . d <= |d|.
    """
    first, second = np.zeros(3), np.zeros(3)
    _plane(u, first, second)
    along = bow = offside = 0.0
    for i in range(3):
        along += u[i] * d0[i]
        bow += first[i] * d0[i]
        offside += second[i] * d0[i]
    nearest = along - np.sqrt(max(_form(p, u, u), 0.0))
    one, other, mixed = _form(p, first, first), _form(p, second, second), _form(p, first, second)
    largest = 0.5 * (one + other) + np.hypot(0.5 * (one - other), mixed)
    farthest = np.hypot(bow, offside) + np.sqrt(max(largest, 0.0))
    rho = np.hypot(nearest, farthest) - nearest
    inner = range_m - half_width_m
    if nearest >= 0.0 and inner >= farthest:
        rho = min(rho, inner - np.sqrt(inner * inner - farthest * farthest))
    return inner - rho, range_m + half_width_m, rho


@kernel
def _form(p: Matrix, a: Vector, b: Vector) -> float:
    """a' P b."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += a[i] * p[i, j] * b[j]
    return total


@kernel
def _plane(u: Vector, first: Vector, second: Vector) -> None:
    """Two unit vectors that span the plane across a unit vector."""
    least = 0
    for i in range(1, 3):
        if abs(u[i]) < abs(u[least]):
            least = i
    norm = np.sqrt(1.0 - u[least] * u[least])
    for i in range(3):
        first[i] = ((1.0 if i == least else 0.0) - u[least] * u[i]) / norm
    second[0] = u[1] * first[2] - u[2] * first[1]
    second[1] = u[2] * first[0] - u[0] * first[2]
    second[2] = u[0] * first[1] - u[1] * first[0]


@entry("float64(float64[::1], float64[:, ::1])")
def nearest_distance(c: Vector, p: Matrix) -> float:
    """Least norm of the points of E(c, P), from below: zero where the origin is inside.

    The nearest point is lam (P + lam I)^-1 c; its norm grows with lam, and its level falls to 1. The bisection ends
    on the side where it is still outside.
    """
    n = c.shape[0]
    trace = distance = 0.0
    for i in range(n):
        trace += p[i, i]
        distance += c[i] * c[i]
    distance = np.sqrt(distance)
    x = np.empty(n)
    low, high = 1e-12 * max(trace, 1e-300), 0.0
    if not _level(c, p, low, x) > 1.0:
        return 0.0
    high = max(distance * np.sqrt(trace), low) * 2.0 + trace
    for _ in range(BISECTIONS):
        if not _level(c, p, high, x) > 1.0:
            break
        high *= 4.0
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        if _level(c, p, middle, x) > 1.0:
            low = middle
        else:
            high = middle
    _level(c, p, low, x)
    total = 0.0
    for i in range(n):
        total += x[i] * x[i]
    return float(low * np.sqrt(total))


@kernel
def _level(c: Vector, p: Matrix, lam: float, x: Vector) -> float:
    """Level of lam (P + lam I)^-1 c in E(c, P); x <- (P + lam I)^-1 c."""
    n = c.shape[0]
    factor = p.copy()
    for i in range(n):
        factor[i, i] += lam
        x[i] = c[i]
    if not cholesky_upper(factor):
        return np.inf
    cholesky_solve(factor, x)
    total = 0.0
    for i in range(n):
        for j in range(n):
            total += x[i] * p[i, j] * x[j]
    return total
