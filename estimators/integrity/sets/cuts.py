"""Prediction and cuts of guaranteed sets, as functions on values; the arithmetic is in `kernels`.

What comes in are bounds that hold for certain; what comes out holds everything that the bounds allow. Bounds that
contradict each other leave nothing: a cut says so (`Outcome.EMPTY`) and leaves the set as it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from estimators.integrity.sets.ellipsoid import Ellipsoid
from estimators.integrity.sets.kernels import CUT, EMPTY, UNCHANGED, add_ellipsoid, cut_strip, range_strip
from estimators.model.measurements import Matrix, Vector


class Outcome(IntEnum):
    """What a cut did."""

    UNCHANGED = UNCHANGED
    """The strip holds the whole set, or cutting would not make the trace smaller."""
    CUT = CUT
    EMPTY = EMPTY
    """No point of the set is in the strip: bounds that were stated do not hold. The set is as it was."""


@dataclass(frozen=True, slots=True)
class Strip:
    """All x with ``low <= row @ x <= high``; ``row`` ``(n,)``."""

    row: Vector
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Cut:
    """A set after a cut."""

    outcome: Outcome
    ellipsoid: Ellipsoid
    strip: Strip
    """Drawn in to where the set was."""
    weight: float
    """q of the strip, alpha = 1/(1 + q) of the paper; infinite where the set was a line along the strip."""


def predicted(ellipsoid: Ellipsoid, transition: ArrayLike, moved: ArrayLike, noise: ArrayLike) -> Ellipsoid:
    """The set of A x + u + w for x in the ellipsoid and w in E(0, ``noise``).

    ``transition`` A ``(n, n)``, ``moved`` u ``(n,)``, ``noise`` ``(n, n)``, which may be singular or zero. Of all
    ellipsoids around the sum this has the least trace. States of mixed units are to be scaled before.
    """
    a = np.asarray(transition, float)
    centre, shape = a @ ellipsoid.centre, np.ascontiguousarray(a @ ellipsoid.shape @ a.T)
    add_ellipsoid(centre, shape, np.array(moved, float), np.array(noise, float, order="C"))
    return Ellipsoid(centre, 0.5 * (shape + shape.T))


def cut(ellipsoid: Ellipsoid, strip: Strip) -> Cut:
    """The set around what of an ellipsoid lies in a strip, of least trace in the one-parameter family of the two."""
    centre, shape = ellipsoid.centre.copy(), np.array(ellipsoid.shape, order="C")
    done, weight, low, high = cut_strip(centre, shape, strip.row, strip.low, strip.high)
    outcome = Outcome(done)
    after = Ellipsoid(centre, shape) if outcome is Outcome.CUT else ellipsoid
    return Cut(outcome, after, Strip(strip.row, low, high), weight)


def strip_of_range(
    ellipsoid: Ellipsoid,
    range_m: float,
    half_width_m: float,
    of: Matrix | None = None,
    direction: Vector | None = None,
) -> tuple[Strip, float]:
    """The strip that a range makes of what an ellipsoid holds, and its remainder rho.

    The range is the norm of ``of @ x``, off by at most ``half_width_m``; ``of`` ``(3, n)``, absent: x itself, the
    position of one drone relative to another. ``direction``: the strip's unit normal ``(3,)``, any; absent: towards
    the centre.
    """
    turn = np.eye(3) if of is None else of
    d0, shape = turn @ ellipsoid.centre, np.ascontiguousarray(turn @ ellipsoid.shape @ turn.T)
    u = _towards(d0) if direction is None else direction
    low, high, rho = range_strip(d0, shape, u, range_m, half_width_m)
    return Strip(u @ turn, low, high), rho


def cut_range(ellipsoid: Ellipsoid, range_m: float, half_width_m: float, of: Matrix | None = None) -> Cut:
    """The set around what of an ellipsoid fits a range; see `strip_of_range`."""
    return cut(ellipsoid, strip_of_range(ellipsoid, range_m, half_width_m, of)[0])


def _towards(d0: Vector) -> Vector:
    """A unit vector towards a point, north where the point is the origin: any is valid."""
    distance = float(np.linalg.norm(d0))
    return d0 / distance if distance > 0.0 else np.array([1.0, 0.0, 0.0])
