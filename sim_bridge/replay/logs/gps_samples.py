"""Fixes and IMU readings of logs to samples, by the rules of the MAVLink adapter (`agent.mavlink.sample_adapter`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from agent.config.tables import SensorsTable
from agent.mavlink.sample_adapter import (
    GPS_RANGE_ERROR_M,
    GPS_SIGMA_FLOOR_M,
    GPS_SPEED_SIGMA_MPS,
    MAX_FORCE_MPS2,
    MAX_TURN_RADPS,
)
from agent.sensing.frames import FleetFrame
from agent.sensing.latency import gps_prior, imu_latency_s
from agent.sensing.samples import GpsSample, ImuSample, Triple

BEST_FIX_TYPE = 8
LEAST_HDOP = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverFix:
    """What a receiver said, in SI units and degrees; ``None``, and 0 of an accuracy, are "unknown"."""

    t_s: float
    fix_type: int
    lat_deg: float
    lon_deg: float
    alt_msl_m: float | None
    alt_ellipsoid_m: float | None
    horizontal_sigma_m: float | None
    vertical_sigma_m: float | None
    hdop: float | None
    vdop: float | None
    speed_mps: float | None
    """Over ground."""
    course_rad: float | None
    down_mps: float | None
    speed_sigma_mps: float | None
    ground_velocity_mps: tuple[float, float] | None = None
    """North and east, where the receiver gives them; surer than speed and course."""


def gps_sample(
    fix: ReceiverFix, frame: FleetFrame, flavour: str, sensors: SensorsTable, receiver: int = 0
) -> GpsSample | str:
    """The sample of a fix stamped with the boot clock of an autopilot ``flavour``, or why there is none.

    ``receiver`` counts the autopilot's receivers from 0.
    """
    if not sensors.gps_min_fix <= fix.fix_type <= BEST_FIX_TYPE:
        return "gps: no fix"
    place = abs(fix.lat_deg) <= 90.0 and abs(fix.lon_deg) <= 180.0 and (fix.lat_deg or fix.lon_deg)
    if not place or (fix.alt_msl_m is not None and not math.isfinite(fix.alt_msl_m)):
        return "gps: no position"
    height_m = frame.height(fix.alt_msl_m, fix.alt_ellipsoid_m)
    if height_m is None or not math.isfinite(height_m):
        return "gps: no height of the fleet's sort"
    horizontal_m = _sigma_m(fix.horizontal_sigma_m, fix.hdop)
    vertical_m = _sigma_m(fix.vertical_sigma_m, fix.vdop)
    if horizontal_m is None:
        return "gps: no accuracy"
    ground, norm = _speeds(fix, sensors)
    return GpsSample(
        t_s=fix.t_s,
        position_m=frame.ned(fix.lat_deg, fix.lon_deg, height_m),
        horizontal_sigma_m=horizontal_m,
        vertical_sigma_m=1.5 * horizontal_m if vertical_m is None else vertical_m,
        ground_velocity_mps=ground,
        speed_mps=norm,
        speed_sigma_mps=_known(fix.speed_sigma_mps) or GPS_SPEED_SIGMA_MPS,
        fix_type=fix.fix_type,
        latency=gps_prior(flavour, "boot", sensors),
        receiver=receiver,
        speed_may_be_norm=flavour == "px4" and fix.ground_velocity_mps is None,
    )


def imu_sample(t_s: float, force: Triple, turn: Triple, flavour: str, sensors: SensorsTable) -> ImuSample | str:
    """The sample of specific force (m/s2) and turn rate (rad/s), body FRD, or why there is none."""
    if not all(map(math.isfinite, force + turn)):
        return "imu: not finite"
    if max(map(abs, force)) > MAX_FORCE_MPS2 or max(map(abs, turn)) > MAX_TURN_RADPS:
        return "imu: out of range"
    return ImuSample(t_s - imu_latency_s(flavour, sensors), force, turn)


def _known(value: float | None) -> float | None:
    """A positive finite number; ``None`` if the receiver did not know it."""
    return value if value is not None and math.isfinite(value) and value > 0.0 else None


def _sigma_m(accuracy_m: float | None, dilution: float | None) -> float | None:
    """1-sigma in m: the receiver's own, else from the dilution of precision."""
    own, diluted = _known(accuracy_m), _known(dilution)
    if own is None and diluted is None:
        return None
    sigma_m = own if own is not None else max(diluted or 0.0, LEAST_HDOP) * GPS_RANGE_ERROR_M
    return max(sigma_m, GPS_SIGMA_FLOOR_M)


def _speeds(fix: ReceiverFix, sensors: SensorsTable) -> tuple[tuple[float, float] | None, float | None]:
    """Ground velocity, or norm of the velocity, whichever the configuration takes."""
    speed, course, down = fix.speed_mps, fix.course_rad, fix.down_mps
    ground = fix.ground_velocity_mps
    if ground is not None and all(map(math.isfinite, ground)) and sensors.gps_speed != "off":
        if sensors.gps_speed == "horizontal":
            return ground, None
        speed = math.hypot(*ground)
    if sensors.gps_speed == "off" or speed is None or not math.isfinite(speed):
        return None, None
    if sensors.gps_speed == "norm":
        return None, speed if down is None or not math.isfinite(down) else math.hypot(speed, down)
    if course is None or not math.isfinite(course):
        return None, None
    return (speed * math.cos(course), speed * math.sin(course)), None
