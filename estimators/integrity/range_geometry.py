"""Do ranges hold a drone: are there enough of them, and in directions that are not all in one plane?

The ranges to m located bodies, along unit vectors u_j, tell of the position what ``sum_j u_j u_j'`` tells. Where its
smallest eigenvalue is nearly zero, all bodies lie in one plane with the drone: across it nothing is measured, and the
mirror image of the drone fits as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import DIRECTIONS, HELD_SPREAD, RANGED_TICKS
from estimators.model.measurements import Matrix, Vector

SHORTEST_M = 1e-6


@dataclass(frozen=True, slots=True)
class RangeGeometry:
    """A drone and the m located bodies that it was ever ranged to."""

    units: Matrix
    """Unit vectors ``(m, 3)`` from the drone to each."""
    age_ticks: Vector
    """``(m,)``: since the last range to each, or since it was heard itself, whichever is longer ago."""

    @classmethod
    def of(cls, position_m: Vector, places_m: Matrix, age_ticks: Vector) -> RangeGeometry:
        """From a drone's position ``(3,)`` to bodies at ``places_m`` ``(m, 3)``, NED."""
        return cls(directions(position_m, places_m), np.asarray(age_ticks, np.float64))

    @property
    def recent(self) -> Matrix:
        """The unit vectors of ranges that are young enough to hold the drone."""
        return self.units[self.age_ticks <= RANGED_TICKS]


class GeometryMonitor:
    """Whether ranges alone hold a drone; without memory."""

    def observe(self, evidence: RangeGeometry) -> tuple[Finding, ...]:
        """Nothing if they do; else why not, the number of bodies or of directions against `DIRECTIONS`."""
        recent = evidence.recent
        if len(recent) < DIRECTIONS:
            return (Finding(What.TOO_FEW_RANGED, Gravity.ALARM, value=len(recent), limit=DIRECTIONS),)
        held = int(np.count_nonzero(spread(recent) > HELD_SPREAD))
        if held < DIRECTIONS:
            return (Finding(What.ONE_PLANE, Gravity.ALARM, value=held, limit=DIRECTIONS),)
        return ()


def directions(position_m: Vector, places_m: Matrix) -> Matrix:
    """Unit vectors ``(m, 3)`` from a position ``(3,)`` to places ``(m, 3)``; zero to a place that is the position."""
    away = np.asarray(places_m, np.float64).reshape(-1, 3) - position_m
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1), SHORTEST_M)[:, None], np.float64)


def spread(units: Matrix) -> Vector:
    """Eigenvalues ``(3,)``, ascending, of ``sum_j u_j u_j'``: how much of units ``(m, 3)`` is along each axis."""
    return np.asarray(np.linalg.eigvalsh(units.T @ units), np.float64)
