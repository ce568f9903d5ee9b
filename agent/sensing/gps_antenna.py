"""A fix of an antenna beside the IMU, made one of the body.

An antenna at ``l`` in body axes is at ``p + R l`` and moves with ``v + R (w x l)``, R the attitude and w the turn
rate of the instant of the fix. Both are known from elsewhere, so the fix is corrected before anybody sees it. Of a
speed, which has no direction, the correction waits for the estimator.
"""

from __future__ import annotations

import math
from dataclasses import replace

from agent.sensing.frames import rotated
from agent.sensing.samples import GpsSample, Triple
from agent.sensing.timeline import Orientation

USUAL_RATE_RADPS = 0.5
"""1-sigma of a turn rate that is not known."""


def at_body(sample: GpsSample, arm_m: Triple, orientation: Orientation | None) -> GpsSample:
    """The fix as one of the body; where the attitude is not known it stays, and its accuracies say so."""
    if not any(arm_m):
        return sample
    if orientation is None:
        length_m = math.hypot(*arm_m)
        return replace(
            sample,
            horizontal_sigma_m=math.hypot(sample.horizontal_sigma_m, length_m / math.sqrt(3.0)),
            vertical_sigma_m=math.hypot(sample.vertical_sigma_m, length_m / math.sqrt(3.0)),
            speed_sigma_mps=math.hypot(sample.speed_sigma_mps, length_m * USUAL_RATE_RADPS),
        )
    north, east, down = rotated(orientation.quaternion, arm_m)
    moves = rotated(orientation.quaternion, cross(orientation.rate_radps, arm_m))
    position = sample.position_m
    velocity = sample.ground_velocity_mps
    return replace(
        sample,
        position_m=(position[0] - north, position[1] - east, position[2] - down),
        ground_velocity_mps=None if velocity is None else (velocity[0] - moves[0], velocity[1] - moves[1]),
        shift_mps=moves if velocity is None else (0.0, 0.0, 0.0),
    )


def cross(a: Triple, b: Triple) -> Triple:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
