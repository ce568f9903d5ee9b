"""Small dense linear algebra for compiled kernels.

Matrices of a fleet of three are 18 by 18: there a library call costs more than the arithmetic. All inner
loops run along rows in memory without a reduction, so that they vectorise without reordering a sum. From
`LIBRARY_SIZE` on the products go to BLAS and the factorisation to LAPACK.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import kernel
from estimators.model.measurements import Matrix, Vector

LIBRARY_SIZE = 40
"""Order from which a library call beats the loops (measured with ``fleetloc bench speed``)."""


@kernel
def cholesky_upper(a: Matrix) -> bool:
    """Replace the upper triangle of ``a`` by U with a = U'U; False where ``a`` is not positive definite.

    Only the upper triangle is read and written.
    """
    n = a.shape[0]
    for k in range(0, n, 2):
        if not _scale_pivot(a, k):
            return False
        if k + 1 == n:
            break
        factor = a[k, k + 1]
        for j in range(k + 1, n):
            a[k + 1, j] -= factor * a[k, j]
        if not _scale_pivot(a, k + 1):
            return False
        for i in range(k + 2, n):  # two rows at once: half the traffic
            one, two = a[k, i], a[k + 1, i]
            if one != 0.0 or two != 0.0:
                for j in range(i, n):
                    a[i, j] = a[i, j] - one * a[k, j] - two * a[k + 1, j]
    return True


@kernel
def _scale_pivot(a: Matrix, k: int) -> bool:
    """Divide row k, from the diagonal on, by the root of its pivot; False where that is not positive."""
    pivot = a[k, k]
    if not pivot > 0.0 or pivot == np.inf:  # also refuses NaN
        return False
    root = np.sqrt(pivot)
    inverse = 1.0 / root
    a[k, k] = root
    for j in range(k + 1, a.shape[0]):
        a[k, j] *= inverse
    return True


@kernel
def solve_upper_transposed(u: Matrix, b: Vector) -> None:
    """b <- U'^-1 b."""
    n = u.shape[0]
    for k in range(n):
        value = b[k] / u[k, k]
        b[k] = value
        for j in range(k + 1, n):
            b[j] -= value * u[k, j]


@kernel
def solve_upper(u: Matrix, b: Vector) -> None:
    """b <- U^-1 b."""
    n = u.shape[0]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for j in range(i + 1, n):
            total -= u[i, j] * b[j]
        b[i] = total / u[i, i]


@kernel
def cholesky_solve(u: Matrix, b: Vector) -> None:
    """b <- (U'U)^-1 b."""
    solve_upper_transposed(u, b)
    solve_upper(u, b)


@kernel
def inverse_from_cholesky(u: Matrix, out: Matrix) -> None:
    """out <- (U'U)^-1, symmetric, both triangles."""
    n = u.shape[0]
    inverse = np.zeros((n, n))  # U^-1
    for i in range(n - 1, -1, -1):
        scale = 1.0 / u[i, i]
        inverse[i, i] = scale
        for j in range(i + 1, n):
            factor = -u[i, j] * scale
            if factor != 0.0:
                for k in range(j, n):
                    inverse[i, k] += factor * inverse[j, k]
    if n >= LIBRARY_SIZE:
        np.dot(inverse, inverse.T, out)
        return
    lower = inverse.T.copy()
    out[:, :] = 0.0
    for k in range(n):  # out = L'L with L = U^-T, row by row of L
        for i in range(k + 1):
            factor = lower[k, i]
            if factor != 0.0:
                for j in range(i, k + 1):
                    out[i, j] += factor * lower[k, j]
    for i in range(n):
        for j in range(i):
            out[i, j] = out[j, i]


@kernel
def factor_upper(a: Matrix) -> bool:
    """Like `cholesky_upper`, through LAPACK where the order is large enough for it to pay."""
    n = a.shape[0]
    if n < 2 * LIBRARY_SIZE:
        return cholesky_upper(a)
    mirror_upper(a)
    if not np.isfinite(a).all():
        return False
    try:
        lower = np.linalg.cholesky(a)
    except Exception:  # noqa: BLE001 - the only class that compiled code can name; it means "not definite"
        return False
    for i in range(n):
        for j in range(i, n):
            a[i, j] = lower[j, i]
    return True


@kernel
def multiply(a: Matrix, b: Matrix, out: Matrix) -> None:
    """out <- a b."""
    n, inner = a.shape
    m = b.shape[1]
    if n * inner * m >= LIBRARY_SIZE**3:
        np.dot(a, b, out)
        return
    for i in range(n):
        for j in range(m):
            out[i, j] = 0.0
        for k in range(inner):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(m):
                    out[i, j] += factor * b[k, j]


@kernel
def add_outer_upper(h: Matrix, weight: float, c: Vector) -> None:
    """Upper triangle of h += weight c c'."""
    n = c.shape[0]
    for i in range(n):
        factor = weight * c[i]
        if factor != 0.0:
            for j in range(i, n):
                h[i, j] += factor * c[j]


@kernel
def mirror_upper(a: Matrix) -> None:
    """Copy the upper triangle to the lower."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i):
            a[i, j] = a[j, i]
