"""Outside positions in latitude and longitude, taken as strictly as the real autopilots take them.

PX4 from 1.18 on, GLOBAL_POSITION_SENSOR: horizontal only, stamped by its arrival less EKF2_AGP0_DELAY, no error
counted smaller than EKF2_AGP0_NOISE, its id that of EKF2_AGP0_ID. ArduPilot, GPS_INPUT: a receiver among its own, of
the type GPSn_TYPE = 14; the second one is used while the first has no fix, if GPS_AUTO_SWITCH says so.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from agent.mavlink.dialect import mavlink
from sim_bridge.autopilot.navigation import OutsideState
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.sensors import GpsFix

AGP_GATE = 3.0
MAV_GPS = 14
USE_BEST, PRIMARY_IF_FIXED = 1, 4
"""Values of GPS_AUTO_SWITCH with which a second receiver comes in."""
DEGREES = 1e-7

FleetNed = Callable[[float, float, float], tuple[float, float, float]]


class GlobalFeed:
    """Judges the messages of one autopilot and keeps count of them."""

    def __init__(self, flavour: FlavourName, parameter: Callable[[str], float], fleet_ned: FleetNed) -> None:
        """``parameter`` reads one by name; ``fleet_ned``: latitude, longitude, MSL height into the fleet frame."""
        self._flavour = flavour
        self._parameter = parameter
        self._fleet_ned = fleet_ned
        self._delay_s = parameter("EKF2_AGP0_DELAY") * 1e-3 if flavour == "px4" else 0.0
        """Read at boot: a later change has no effect."""
        self.accepted = 0
        self.rejected: Counter[str] = Counter()

    def of_sensor(self, message: Any, now: float) -> OutsideState | None:
        """The position in a GLOBAL_POSITION_SENSOR, if this autopilot uses it."""
        if not self._takes(self._why_no_sensor(message)):
            return None
        north, east, _ = self._fleet_ned(message.lat * DEGREES, message.lon * DEGREES, 0.0)
        sigma_m = max(message.eph, self._parameter("EKF2_AGP0_NOISE"))
        return OutsideState(
            np.array((north, east, math.nan)),
            None,
            np.full(3, sigma_m),
            np.full(3, math.inf),
            now - self._delay_s,
            0,
            AGP_GATE,
        )

    def of_receiver(self, message: Any, now: float, first_has_fix: bool) -> GpsFix | None:
        """The fix in a GPS_INPUT, if this autopilot uses it; ``first_has_fix``: whether its first receiver does."""
        if not self._takes(self._why_no_receiver(message)):
            return None
        switches = self._parameter("GPS_AUTO_SWITCH") in (USE_BEST, PRIMARY_IF_FIXED)
        if message.gps_id == 1 and (first_has_fix or not switches):
            return None
        return GpsFix(
            now,
            True,
            position_ned_m=self._fleet_ned(message.lat * DEGREES, message.lon * DEGREES, message.alt),
            velocity_ned_mps=(message.vn, message.ve, message.vd),
            h_acc_m=message.horiz_accuracy,
            v_acc_m=message.vert_accuracy,
        )

    def _why_no_sensor(self, message: Any) -> str:
        if self._flavour != "px4":
            return "GLOBAL_POSITION_SENSOR not handled"
        if not int(self._parameter("EKF2_AGP0_CTRL")) & 1:
            return "EKF2_AGP0_CTRL"
        if message.id != self._parameter("EKF2_AGP0_ID"):
            return f"id {message.id}"
        known = _on_earth(message) and math.isfinite(message.eph) and message.eph > 0.0
        return "" if known else "no position"

    def _why_no_receiver(self, message: Any) -> str:
        if self._flavour != "ardupilot":
            return "GPS_INPUT not handled"
        if message.gps_id not in (0, 1) or self._parameter(f"GPS{message.gps_id + 1}_TYPE") != MAV_GPS:
            return f"no GPS{message.gps_id + 1} of MAVLink"
        known = _on_earth(message) and message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
        return "" if known else "no fix"

    def _takes(self, why_not: str) -> bool:
        """Count a message; whether it is taken."""
        if why_not:
            self.rejected[why_not] += 1
        else:
            self.accepted += 1
        return not why_not


def _on_earth(message: Any) -> bool:
    nowhere = message.lat == 0 and message.lon == 0
    return not nowhere and abs(message.lat) <= 900_000_000 and abs(message.lon) <= 1_800_000_000
