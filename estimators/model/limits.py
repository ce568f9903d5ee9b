"""The limits that a fleet's states keep: where bodies can be, and how fast, in the state's own terms.

A configuration speaks of altitude above the fleet's origin; the state is north, east, down.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.model.layout import STATES_PER_AGENT, Layout
from estimators.model.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings

DOWN = 2
"""Of a block, the axis that altitude is on."""
SURELY = 3.0
"""How many sigmas beyond a limit a place is impossible."""


class StateLimits(NamedTuple):
    """Limits on every state of a window; infinite where there is none."""

    low: Vector
    """``(6n,)`` NED m and m/s."""
    high: Vector
    """``(6n,)``."""
    speed_mps: float
    """On the length of every velocity."""
    noise_price: float
    """Cost per half width that a corrected residual exceeds its sensor's bound by; zero: no such bounds."""

    def allow(self, slot: int, means: Matrix, covariances: NDArray[np.float64]) -> NDArray[np.bool_]:
        """``(K,)``: which hypotheses about an agent's state have a place that may be within limits.

        Means ``(K, 6)``, ``covariances`` ``(K, 6, 6)``. One is out where it is beyond a limit by `SURELY` sigmas.
        """
        place, own = slice(0, 3), slice(STATES_PER_AGENT * slot, STATES_PER_AGENT * slot + 3)
        room = SURELY * np.sqrt(np.maximum(np.einsum("kii->ki", covariances)[:, place], 0.0))
        at = means[:, place]
        return np.asarray(((at + room >= self.low[own]) & (at - room <= self.high[own])).all(axis=1))


def state_limits(settings: EstimatorSettings, layout: Layout) -> StateLimits | None:
    """The limits of the bodies of a layout, each by its kind; None where the settings have none."""
    vehicle = settings.limits.vehicle
    box = settings.state_box_position_m or np.inf
    speed_box = settings.state_box_speed_mps or np.inf
    north, east = vehicle.north_m or (-np.inf, np.inf), vehicle.east_m or (-np.inf, np.inf)
    floor_m = -np.inf if vehicle.floor_m is None else vehicle.floor_m
    ceiling_m = np.inf if vehicle.ceiling_m is None else vehicle.ceiling_m
    places = np.array([north, east, (-ceiling_m, -floor_m)])
    of_vehicle = (
        np.concatenate([np.maximum(places[:, 0], -box), np.full(3, -speed_box)]),
        np.concatenate([np.minimum(places[:, 1], box), np.full(3, speed_box)]),
    )
    of_target = target_limits(settings)
    sides = [of_vehicle if vehicle else of_target for vehicle in layout.is_vehicle.tolist()]
    low, high = (np.concatenate([each[side] for each in sides]) for side in (0, 1))
    speed_mps = vehicle.speed_mps or np.inf
    price = settings.noise_bounds_penalty if settings.noise_bounds == "soft" else 0.0
    if not (np.isfinite(low).any() or np.isfinite(high).any() or np.isfinite(speed_mps) or price > 0.0):
        return None
    return StateLimits(low, high, speed_mps, price)


def target_limits(settings: EstimatorSettings) -> tuple[Vector, Vector]:
    """Lowest and highest state ``(6,)`` of a body that is no vehicle, NED; infinite where there is no limit."""
    target = settings.limits.target
    low, high = np.full(STATES_PER_AGENT, -np.inf), np.full(STATES_PER_AGENT, np.inf)
    low[DOWN] = -np.inf if target.ceiling_m is None else -target.ceiling_m
    high[DOWN] = np.inf if target.floor_m is None else -target.floor_m
    return low, high
