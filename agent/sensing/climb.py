"""Speeds that are at most the speed over ground: PX4 passes on the norm of all three axes from some receivers.

From DroneCAN receivers and VectorNav it is the norm, from u-blox and Septentrio the speed over ground, and no message
on the link tells which. They differ by what the drone climbs.
"""

from __future__ import annotations

import math
from dataclasses import replace

from agent.sensing.samples import GpsSample


def without_climb(sample: GpsSample, climb_mps: float | None) -> GpsSample:
    """A fix whose velocity allows for either meaning, at a rate of climb or descent; ``None``: it may be any.

    Where the two meanings are further apart than the receiver's own accuracy, the velocity is left out: for as long
    as the climb lasts it would be wrong by the same, which no noise is.
    """
    ground = sample.ground_velocity_mps
    if ground is None or not sample.speed_may_be_norm:
        return sample
    speed_mps = math.hypot(*ground)
    climb_mps = speed_mps if climb_mps is None else climb_mps
    apart_mps = speed_mps - math.sqrt(max(speed_mps**2 - climb_mps**2, 0.0))
    if apart_mps > sample.speed_sigma_mps:
        return replace(sample, ground_velocity_mps=None)
    return replace(sample, speed_sigma_mps=math.hypot(sample.speed_sigma_mps, apart_mps))
