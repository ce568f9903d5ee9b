"""Geodetic positions of the whole fleet, and the two heights of a receiver around the fleet's one."""

from __future__ import annotations

import numpy as np
import pymap3d

from agent.sensing.frames import FleetFrame
from sim_bridge.world.quaternions import Array

SIMULATED_SEPARATION_M = 40.0
"""Ellipsoid minus mean sea level where the configuration does not say; not zero, so that taking one height
for the other shows."""


def separation_m(frame: FleetFrame) -> float:
    """Ellipsoidal minus MSL height in the simulated world."""
    return SIMULATED_SEPARATION_M if frame.geoid_separation_m is None else frame.geoid_separation_m


def msl_m(frame: FleetFrame, height_m: float) -> float:
    """Height above mean sea level of a height of the fleet's sort."""
    return height_m if frame.msl else height_m - separation_m(frame)


def ellipsoid_m(frame: FleetFrame, height_m: float) -> float:
    """Height above the WGS84 ellipsoid of a height of the fleet's sort."""
    return height_m + separation_m(frame) if frame.msl else height_m


def from_msl_m(frame: FleetFrame, height_msl_m: float) -> float:
    """Height of the fleet's sort of a height above mean sea level."""
    return height_msl_m if frame.msl else height_msl_m + separation_m(frame)


def geodetic(frame: FleetFrame, position_m: Array) -> Array:
    """Latitude and longitude in deg and height of the fleet's sort in m, ``(n, 3)``, of NED positions.

    The same as `FleetFrame.geodetic`, for all at once: one by one it would cost most of the simulator's time.
    """
    lift_m = (frame.geoid_separation_m or 0.0) if frame.msl else 0.0
    lat_deg, lon_deg, height_m = pymap3d.ned2geodetic(
        *position_m.T, frame.lat_deg, frame.lon_deg, frame.alt_m + lift_m
    )
    return np.stack((lat_deg, lon_deg, height_m - lift_m), axis=-1)
