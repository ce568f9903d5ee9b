"""The fleet's frame about a point of a log, where no configuration gives its origin."""

from __future__ import annotations

from collections.abc import Iterable

from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.events import GeodeticPoint, SystemSurvey


def origin_of(systems: Iterable[SystemSurvey]) -> GeodeticPoint | None:
    """The first origin, else home, else fix of the vehicles, by their ids; ``None`` if no log tells one."""
    ordered = sorted(systems, key=lambda found: found.system_id)
    for points in (
        (found.origin for found in ordered),
        (found.home for found in ordered),
        (found.first_fix for found in ordered),
    ):
        for point in points:
            if point is not None:
                return point
    return None


def frame_about(systems: Iterable[SystemSurvey]) -> FleetFrame:
    """A frame about `origin_of`, heights above mean sea level.

    A log that tells no place holds no geodetic position either, so that any frame serves it: (0, 0).
    """
    point = origin_of(systems)
    if point is None:
        return FleetFrame(0.0, 0.0, 0.0, msl=True)
    return FleetFrame(point.lat_deg, point.lon_deg, point.alt_msl_m, msl=True)
