"""The estimate as each autopilot reads it: frames, clocks, and covariances coded as they are decoded there.

- PX4, ODOMETRY: LOCAL_NED/BODY_FRD, no attitude (it is PX4's own: NaN), variances as they are. PX4 puts ``time_usec``
  on its clock with its own TIMESYNC filter, so it is the host's monotonic time, with which TIMESYNC is answered.
- ArduPilot, ODOMETRY: LOCAL_FRD/BODY_FRD and nothing else; its own attitude, as it takes no NaN; it sees
  ``cbrt(c0^2 + c6^2 + c11^2)`` of the variances as a standard deviation. ``time_usec`` is its own boot time.
- GLOBAL_POSITION_SENSOR (PX4 from 1.18 on) and GPS_INPUT (ArduPilot): latitude and longitude, no origin needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agent.mavlink.codec import Message, mavlink
from agent.sensing.frames import FleetFrame, rotated
from agent.sensing.samples import Quaternion, Triple
from estimators.model.measurements import Matrix

LEAST_SIGMA_M, LEAST_SIGMA_MPS = 0.1, 0.1
"""Nothing is claimed to be better: an autopilot's filter takes each message for independent of the last."""
UNKNOWN_ATTITUDE_RAD2 = 1.0
"""Variance of the attitude in ArduPilot's ODOMETRY, which it does not use."""
QUALITY_SIGMA_M = 3.0
GPS_EPOCH_UNIX_S, LEAP_S, WEEK_S = 315_964_800.0, 18.0, 604_800.0
SATELLITES, HDOP, VDOP = 10, 0.8, 1.0
"""What GPS_INPUT has to say of a receiver that does not exist, so that ArduPilot's checks of receivers pass."""
GPS_YAW_UNKNOWN = 0
NAN = math.nan


@dataclass(frozen=True, slots=True)
class FedState:
    """What is fed: NED, position in m about the origin of the message's frame, velocity in m/s.

    ``covariance`` ``(6, 6)`` of position and velocity; ``quaternion`` the autopilot's own attitude at that instant,
    ``None`` if not known. ``time_usec`` is on the clock that the autopilot expects (see above).
    """

    time_usec: int
    position_m: Triple
    velocity_mps: Triple
    covariance: Matrix
    reset_counter: int
    quaternion: Quaternion | None = None


@dataclass(frozen=True, slots=True)
class GlobalPlace:
    """A place in WGS84: degrees, height in m above mean sea level, and above the ellipsoid where that is known."""

    lat_deg: float
    lon_deg: float
    msl_m: float
    ellipsoid_m: float | None

    @classmethod
    def of(cls, position_m: Triple, frame: FleetFrame) -> GlobalPlace | None:
        """The place of a point in the fleet frame; ``None`` if its height above mean sea level cannot be had."""
        lat_deg, lon_deg, height_m = frame.geodetic(position_m)
        geoid_m = frame.geoid_separation_m
        if frame.msl:
            return cls(lat_deg, lon_deg, height_m, None if geoid_m is None else height_m + geoid_m)
        return None if geoid_m is None else cls(lat_deg, lon_deg, height_m - geoid_m, height_m)


def px4_odometry(state: FedState) -> Message:
    """ODOMETRY for PX4: its velocity is in body axes, so that without an attitude there is none."""
    velocity, velocity_covariance = _in_body_axes(state)
    return _odometry(
        state,
        mavlink.MAV_FRAME_LOCAL_NED,
        (NAN, NAN, NAN, NAN),
        velocity,
        _upper_triangle(_floored(state.covariance[:3, :3], LEAST_SIGMA_M), NAN),
        _upper_triangle(velocity_covariance, NAN),
    )


def ardupilot_odometry(state: FedState) -> Message | None:
    """ODOMETRY for ArduPilot; ``None`` without an attitude, for it takes none without."""
    if state.quaternion is None:
        return None
    velocity, velocity_covariance = _in_body_axes(state)
    coded = np.eye(3) * ardupilot_variance(horizontal_sigma_m(state.covariance))
    return _odometry(
        state,
        mavlink.MAV_FRAME_LOCAL_FRD,
        state.quaternion,
        velocity,
        _upper_triangle(coded, UNKNOWN_ATTITUDE_RAD2),
        _upper_triangle(velocity_covariance, UNKNOWN_ATTITUDE_RAD2),
    )


def global_position_sensor(
    state: FedState, place: GlobalPlace, *, system_id: int, component_id: int, age_s: float
) -> Message:
    """GLOBAL_POSITION_SENSOR number 1; PX4 stamps it by its arrival, ``age_s`` is what it could take off."""
    return mavlink.MAVLink_global_position_sensor_message(
        system_id,
        component_id,
        1,
        state.time_usec,
        max(round(age_s * 1e6), 0),
        mavlink.GLOBAL_POSITION_SRC_ESTIMATOR,
        0,
        round(place.lat_deg * 1e7),
        round(place.lon_deg * 1e7),
        NAN if place.ellipsoid_m is None else place.ellipsoid_m,
        place.msl_m,
        horizontal_sigma_m(state.covariance),
        vertical_sigma_m(state.covariance),
    )


def gps_input(state: FedState, place: GlobalPlace, *, gps_id: int, unix_s: float) -> Message:
    """GPS_INPUT of the receiver ``gps_id``, true at ``unix_s``."""
    week, week_ms = gps_week(unix_s)
    north, east, down = state.velocity_mps
    speed_sigma_mps = max(math.sqrt(max(float(np.max(np.diagonal(state.covariance)[3:])), 0.0)), LEAST_SIGMA_MPS)
    return mavlink.MAVLink_gps_input_message(
        state.time_usec,
        gps_id,
        0,
        week_ms,
        week,
        mavlink.GPS_FIX_TYPE_3D_FIX,
        round(place.lat_deg * 1e7),
        round(place.lon_deg * 1e7),
        place.msl_m,
        HDOP,
        VDOP,
        north,
        east,
        down,
        speed_sigma_mps,
        horizontal_sigma_m(state.covariance),
        vertical_sigma_m(state.covariance),
        SATELLITES,
        GPS_YAW_UNKNOWN,
    )


def ardupilot_variance(sigma_m: float) -> float:
    """The variance to send, on all three axes, so that ArduPilot sees a standard deviation of ``sigma_m``."""
    return math.sqrt(sigma_m**3 / 3.0)


def horizontal_sigma_m(covariance: Matrix) -> float:
    """Of the longest horizontal axis of ``covariance`` ``(6, 6)``."""
    return max(math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0)), LEAST_SIGMA_M)


def vertical_sigma_m(covariance: Matrix) -> float:
    """Of the height of ``covariance`` ``(6, 6)``."""
    return max(math.sqrt(max(float(covariance[2, 2]), 0.0)), LEAST_SIGMA_M)


def gps_week(unix_s: float) -> tuple[int, int]:
    """GPS week and the milliseconds in it of a UTC instant."""
    ms = round((unix_s - GPS_EPOCH_UNIX_S + LEAP_S) * 1e3)
    return divmod(ms, round(WEEK_S * 1e3))


def _odometry(
    state: FedState,
    frame: int,
    quaternion: Quaternion,
    velocity_mps: Triple,
    pose_covariance: list[float],
    velocity_covariance: list[float],
) -> Message:
    quality = 100.0 * math.exp(-horizontal_sigma_m(state.covariance) / QUALITY_SIGMA_M)
    return mavlink.MAVLink_odometry_message(
        state.time_usec,
        frame,
        mavlink.MAV_FRAME_BODY_FRD,
        *state.position_m,
        quaternion,
        *velocity_mps,
        NAN,
        NAN,
        NAN,
        pose_covariance,
        velocity_covariance,
        state.reset_counter % 256,
        mavlink.MAV_ESTIMATOR_TYPE_VISION,
        min(max(round(quality), 1), 100),
    )


def _in_body_axes(state: FedState) -> tuple[Triple, Matrix]:
    """The velocity and its covariance ``(3, 3)`` in body axes; NaN where the attitude is not known."""
    if state.quaternion is None:
        return (NAN, NAN, NAN), np.full((3, 3), NAN)
    w, x, y, z = state.quaternion
    back = (w, -x, -y, -z)
    # columns: what the axes of NED are in the body's
    turn = np.array([rotated(back, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T
    covariance = turn @ state.covariance[3:, 3:] @ turn.T
    return rotated(back, state.velocity_mps), _floored(covariance, LEAST_SIGMA_MPS)


def _floored(covariance: Matrix, least_sigma: float) -> Matrix:
    """With no variance on the diagonal below that of ``least_sigma``."""
    floored = np.array(covariance, float)
    np.fill_diagonal(floored, np.maximum(np.diagonal(floored), least_sigma**2))
    return floored


def _upper_triangle(covariance: Matrix, rotation_variance: float) -> list[float]:
    """The 21 numbers of a 6x6 in MAVLink: ``(3, 3)`` of the first three, the rotations' variance on the diagonal."""
    whole = np.zeros((6, 6))
    whole[:3, :3] = covariance
    whole[range(3, 6), range(3, 6)] = rotation_variance
    return [float(value) for value in whole[np.triu_indices(6)]]
