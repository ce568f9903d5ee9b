"""Heights above ground that is flat and known, by a range finder that looks down and the attitude of its instant."""

from __future__ import annotations

from agent.sensing.frames import rotated
from agent.sensing.samples import GroundSample
from agent.sensing.timeline import Orientation

LEAST_DOWN = 0.87
"""Part of the beam that goes down: tilted by more than 30 degrees, the range finder sees the ground beside."""
SIGMA_FLOOR_M = 0.1
"""1-sigma at least, whatever the sensor claims: no ground is flatter."""
ATTITUDE_RAD = 0.03
"""1-sigma of the attitude, which turns a long beam."""


def altitude_of(sample: GroundSample, orientation: Orientation | None, ground_m: float) -> tuple[float, float] | str:
    """Altitude above the fleet's origin and its 1-sigma, m, or why there is none; ``ground_m``: of the ground."""
    if orientation is None:
        return "attitude unknown"
    down = rotated(orientation.quaternion, (0.0, 0.0, 1.0))[2]
    if down < LEAST_DOWN:
        return "too much tilt"
    turned_m = sample.distance_m * ATTITUDE_RAD * (1.0 - down * down) ** 0.5
    sigma_m = max(sample.sigma_m, SIGMA_FLOOR_M)
    return ground_m + down * sample.distance_m, (sigma_m * sigma_m + turned_m * turned_m) ** 0.5


def distance_of(altitude_m: float, orientation: Orientation, ground_m: float) -> float | None:
    """How far the ground is along the body's down axis, of a drone at an altitude; ``None`` if it cannot be told.

    Altitude and ``ground_m`` are above the fleet's origin.
    """
    down = rotated(orientation.quaternion, (0.0, 0.0, 1.0))[2]
    above_m = altitude_m - ground_m
    return above_m / down if above_m > 0.0 and down >= LEAST_DOWN else None
