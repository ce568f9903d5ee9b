"""Protection levels: how far off a position is at most, but for one output in a thousand.

The larger of what the covariance says and of how far the position moves where one receiver is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimators.model.measurements import Matrix, Vector

ELLIPSE_SIGMAS = 3.0
EXCEEDED = 1e-3
"""Share of the outputs whose error may be beyond the protection level."""
HORIZONTAL_SIGMAS = math.sqrt(-2.0 * math.log(EXCEEDED))
"""A circle as wide as the longest axis: of a round distribution it is exact, of any other on the safe side."""
VERTICAL_SIGMAS = 3.2905
"""Of a Gaussian, both sides together."""


@dataclass(frozen=True, slots=True)
class ErrorEllipse:
    """Horizontal ellipse and vertical half height of three sigma; metres, the angle from north towards east."""

    major_m: float
    minor_m: float
    angle_rad: float
    up_m: float


@dataclass(frozen=True, slots=True)
class ProtectionLevel:
    """Of a position: its error is within these, horizontally and vertically, but for `EXCEEDED`."""

    horizontal_m: float
    vertical_m: float


def error_ellipse(covariance: Matrix) -> ErrorEllipse:
    """Of a position's covariance ``(3, 3)``, NED m2."""
    values, axes = np.linalg.eigh(covariance[:2, :2])
    minor, major = np.sqrt(np.maximum(values, 0.0))
    angle = math.atan2(axes[1, 1], axes[0, 1])
    up = math.sqrt(max(float(covariance[2, 2]), 0.0))
    sigmas = ELLIPSE_SIGMAS
    return ErrorEllipse(sigmas * float(major), sigmas * float(minor), angle, sigmas * up)


def protection_level(covariance: Matrix, separation_m: Vector) -> ProtectionLevel:
    """Of a position with covariance ``(3, 3)``, NED m2; ``separation_m`` ``(3,)``: how far it moves per axis where
    one receiver is left out."""
    major = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2])[-1], 0.0)))
    up = math.sqrt(max(float(covariance[2, 2]), 0.0))
    return ProtectionLevel(
        max(HORIZONTAL_SIGMAS * major, float(np.hypot(separation_m[0], separation_m[1]))),
        max(VERTICAL_SIGMAS * up, abs(float(separation_m[2]))),
    )


def relative_covariance(covariance: Matrix, one: int, other: int) -> Matrix:
    """``(3, 3)`` of the position of slot ``other`` less that of ``one``, of a fleet's covariance ``(6n, 6n)``."""
    a, b = slice(6 * one, 6 * one + 3), slice(6 * other, 6 * other + 3)
    cross = covariance[a, b]
    return np.asarray(covariance[a, a] + covariance[b, b] - cross - cross.T)
