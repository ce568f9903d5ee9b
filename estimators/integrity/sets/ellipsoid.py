"""An ellipsoid, the form in which a guaranteed set is kept, and what it says: half axes, extent, nearest point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimators.integrity.sets.kernels import nearest_distance
from estimators.model.measurements import Matrix, Vector


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """All x with (x - centre)' shape^-1 (x - centre) <= 1; a singular shape is flat.

    ``centre`` ``(n,)``, ``shape`` ``(n, n)``, symmetric, in the unit of x squared. The centre is the middle of what
    is possible, not an estimate.
    """

    centre: Vector
    shape: Matrix

    @property
    def trace(self) -> float:
        """Sum of the squared half axes: the size that all cuts keep small."""
        return float(np.trace(self.shape))

    def half_axes(self) -> Vector:
        """``(n,)``, the longest first."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(self.shape)[::-1], 0.0)))

    def half_widths(self) -> Vector:
        """``(n,)``: how far it reaches from its centre along each axis of the frame."""
        return np.asarray(np.sqrt(np.maximum(self.shape.diagonal(), 0.0)))

    def reach(self, axes: slice) -> float:
        """How far it reaches from its centre in the plane (or line) of some axes of the frame."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.shape[axes, axes])[-1], 0.0)))

    def level(self, x: ArrayLike) -> float:
        """(x - centre)' shape^-1 (x - centre): at most 1 inside. For shapes that are not singular."""
        off = np.asarray(x, float) - self.centre
        return float(off @ np.linalg.solve(self.shape, off))

    def min_range(self) -> float:
        """Guaranteed least norm of what it holds: zero where the origin is inside; never above the true minimum."""
        return float(nearest_distance(self.centre, np.ascontiguousarray(self.shape)))


def box_ellipsoid(centre: ArrayLike, half_widths: ArrayLike) -> Ellipsoid:
    """The ellipsoid of least trace around a box ``(n,)`` parallel to the axes: shape diag(w_i sum(w)).

    That of least volume, n diag(w^2), never has a smaller trace.
    """
    widths = np.asarray(half_widths, float)
    return Ellipsoid(np.array(centre, float), np.diag(widths * widths.sum()))


def interval_ellipsoid(rows: ArrayLike, values: ArrayLike, half_widths: ArrayLike) -> Ellipsoid:
    """A set around all x with ``|rows @ x - values| <= half_widths``, of one batch of measurements.

    ``rows`` ``(m, n)`` of full rank n. The least-squares solution in interval arithmetic: centre H+ y, half widths
    |H+| W, then the ellipsoid around that box. Raises ``numpy.linalg.LinAlgError`` where the rows do not determine x.
    """
    h = np.asarray(rows, float)
    if np.linalg.matrix_rank(h) < h.shape[1]:
        raise np.linalg.LinAlgError(f"{h.shape[0]} rows do not determine {h.shape[1]} unknowns")
    inverse = np.linalg.pinv(h)
    return box_ellipsoid(inverse @ np.asarray(values, float), np.abs(inverse) @ np.asarray(half_widths, float))
