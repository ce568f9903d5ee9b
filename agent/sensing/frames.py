"""Frames: geodetic to the fleet's NED frame and back, body to NED, and gravity.

The fleet's frame is NED about a configured geodetic origin. Heights are all of one sort, above the WGS84
ellipsoid or above mean sea level, as the origin says; the two differ by the geoid separation (tens of
metres), which is taken as constant over the fleet's few kilometres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pymap3d

from agent.config.tables import FleetConfig
from agent.sensing.samples import Quaternion, Triple

STANDARD_GRAVITY_MPS2 = 9.80665

# WGS84 normal gravity (Somigliana): at the equator, formula constant k, and first eccentricity squared.
_EQUATOR_MPS2, _SOMIGLIANA_K, _ECCENTRICITY2 = 9.7803253359, 0.00193185265241, 0.00669437999014
_SEMI_MAJOR_M, _FLATTENING, _GRAVITY_RATIO = 6378137.0, 1 / 298.257223563, 0.00344978650684


@dataclass(frozen=True, slots=True)
class FleetFrame:
    """The fleet's NED frame.

    ``alt_m`` is the origin's height, ``msl`` says which one; ``geoid_separation_m`` is ellipsoid minus mean
    sea level height, ``None`` if unknown.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    msl: bool
    geoid_separation_m: float | None = None

    @classmethod
    def of(cls, config: FleetConfig) -> FleetFrame:
        """The frame that a configuration describes."""
        origin = config.fleet.origin
        msl = origin.altitude == "msl"
        return cls(origin.lat_deg, origin.lon_deg, origin.alt_m, msl, config.sensors.geoid_separation_m)

    def height(self, msl_m: float | None, ellipsoid_m: float | None) -> float | None:
        """The height of the fleet's sort out of what a receiver gives; ``None`` if it cannot be had."""
        wanted, other = (msl_m, ellipsoid_m) if self.msl else (ellipsoid_m, msl_m)
        if wanted is not None or other is None or self.geoid_separation_m is None:
            return wanted
        return other - self.geoid_separation_m if self.msl else other + self.geoid_separation_m

    def ned(self, lat_deg: float, lon_deg: float, height_m: float) -> Triple:
        """NED m of a point whose height is of the fleet's sort."""
        lift = self._lift_m
        north, east, down = pymap3d.geodetic2ned(
            lat_deg, lon_deg, height_m + lift, self.lat_deg, self.lon_deg, self.alt_m + lift
        )
        return float(north), float(east), float(down)

    def geodetic(self, ned_m: Triple) -> Triple:
        """Latitude and longitude in degrees and height in m (of the fleet's sort) of a point in NED."""
        lift = self._lift_m
        lat, lon, height = pymap3d.ned2geodetic(*ned_m, self.lat_deg, self.lon_deg, self.alt_m + lift)
        return float(lat), float(lon), float(height) - lift

    @property
    def _lift_m(self) -> float:
        """What makes the fleet's heights ellipsoidal; without the geoid 1 cm per km is lost, no more."""
        return (self.geoid_separation_m or 0.0) if self.msl else 0.0


def normal_gravity_mps2(lat_deg: float, height_m: float) -> float:
    """WGS84 normal gravity (Somigliana, second order in height) at a latitude and ellipsoidal height."""
    sin2 = math.sin(math.radians(lat_deg)) ** 2
    at_ellipsoid = _EQUATOR_MPS2 * (1 + _SOMIGLIANA_K * sin2) / math.sqrt(1 - _ECCENTRICITY2 * sin2)
    a = height_m / _SEMI_MAJOR_M
    return at_ellipsoid * (1 - 2 * a * (1 + _FLATTENING + _GRAVITY_RATIO - 2 * _FLATTENING * sin2) + 3 * a * a)


def gravity_mps2(config: FleetConfig) -> float:
    """The gravity that the fleet's daemons remove from their IMUs."""
    configured = config.sensors.gravity_mps2
    origin = config.fleet.origin
    return normal_gravity_mps2(origin.lat_deg, origin.alt_m) if configured is None else configured


def rotated(quaternion: Quaternion, vector: Triple) -> Triple:
    """A body FRD vector in NED; the quaternion must have unit length."""
    w, x, y, z = quaternion
    vx, vy, vz = vector
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def normalised(quaternion: Quaternion) -> Quaternion | None:
    """The quaternion with unit length; ``None`` unless it is finite and within 10 % of that already."""
    length = math.sqrt(sum(component * component for component in quaternion))
    if not 0.9 < length < 1.1:  # false for NaN as well
        return None
    w, x, y, z = quaternion
    return w / length, x / length, y / length, z / length


def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """The body-to-NED quaternion of the aerospace angles (yaw, then pitch, then roll)."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def interpolated(first: Quaternion, second: Quaternion, share: float) -> Quaternion:
    """Between two attitudes on the shorter arc; ``share`` 0 = first, 1 = second, beyond it extrapolates."""
    w0, x0, y0, z0 = first
    w1, x1, y1, z1 = second
    dot = w0 * w1 + x0 * x1 + y0 * y1 + z0 * z1
    sign = -1.0 if dot < 0 else 1.0
    dot = min(abs(dot), 1.0)
    angle = math.acos(dot)
    if angle < 1e-6:  # the sines below would divide two roundings
        a, b = 1 - share, share * sign
    else:
        sine = math.sin(angle)
        a, b = math.sin((1 - share) * angle) / sine, sign * math.sin(share * angle) / sine
    w, x, y, z = a * w0 + b * w1, a * x0 + b * x1, a * y0 + b * y1, a * z0 + b * z1
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length
