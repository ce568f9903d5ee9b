"""Sensor samples as MAVLink messages: units, integer scales and the values that mean "unknown"."""

from __future__ import annotations

import math
from typing import Any

from agent.mavlink.dialect import mavlink
from sim_bridge.world.quaternions import Array, to_euler
from sim_bridge.world.sensors import GpsFix, SensedAttitude, SensedImu

Message = Any
"""A pymavlink message; the library has no useful common type."""

STANDARD_GRAVITY_MPS2 = 9.80665
UINT16_UNKNOWN = 0xFFFF
ACCURACY_UNKNOWN = 0
SATELLITES_UNKNOWN = 0xFF
SATELLITES_USED = 14
FIX_NO_GPS, FIX_NONE, FIX_3D = 0, 1, 3
HIGHRES_ALL_UPDATED = 0x1FFF
HIGHRES_PRESSURE = mavlink.HIGHRES_IMU_UPDATED_ABS_PRESSURE | mavlink.HIGHRES_IMU_UPDATED_PRESSURE_ALT
TEMPERATURE_DEG_C = 35.0


def clamp(value: float, low: int, high: int) -> int:
    """The nearest whole number within the range of an integer field."""
    return min(max(round(value), low), high)


def int16(value: float) -> int:
    """Saturating 16-bit field."""
    return clamp(value, -0x8000, 0x7FFF)


def millimetres(value_m: float) -> int:
    """Saturating 32-bit field in mm."""
    return clamp(1e3 * value_m, -0x80000000, 0x7FFFFFFF)


def highres_imu(time_us: int, imu: SensedImu) -> Message:
    """HIGHRES_IMU: m/s2, rad/s, gauss, hPa, degC."""
    return mavlink.MAVLink_highres_imu_message(
        time_us,
        *(float(axis) for axis in imu.accel_mps2),
        *(float(axis) for axis in imu.gyro_rps),
        *(float(axis) for axis in imu.mag_gauss),
        imu.pressure_hpa or 0.0,
        0.0,
        imu.pressure_alt_m if imu.pressure_hpa else 0.0,
        TEMPERATURE_DEG_C,
        HIGHRES_ALL_UPDATED if imu.pressure_hpa else HIGHRES_ALL_UPDATED & ~HIGHRES_PRESSURE,
        id=0,
    )


def scaled_pressure(time_ms: int, imu: SensedImu) -> Message | None:
    """SCALED_PRESSURE: hPa, and the sensor's own temperature, which is not that of the air; ``None`` without one."""
    if imu.pressure_hpa is None:
        return None
    return mavlink.MAVLink_scaled_pressure_message(time_ms, imu.pressure_hpa, 0.0, round(100.0 * TEMPERATURE_DEG_C))


def _scaled_axes(imu: SensedImu) -> tuple[int, ...]:
    """Accelerations in mG, rates in mrad/s, field in milligauss."""
    return (
        *(int16(1000.0 * float(axis) / STANDARD_GRAVITY_MPS2) for axis in imu.accel_mps2),
        *(int16(1000.0 * float(axis)) for axis in imu.gyro_rps),
        *(int16(1000.0 * float(axis)) for axis in imu.mag_gauss),
    )


def raw_imu(time_us: int, imu: SensedImu) -> Message:
    """RAW_IMU as ArduPilot fills it: scaled to mG, mrad/s and milligauss, degC times 100."""
    return mavlink.MAVLink_raw_imu_message(
        time_us, *_scaled_axes(imu), id=0, temperature=round(100.0 * TEMPERATURE_DEG_C)
    )


def scaled_imu(time_ms: int, imu: SensedImu) -> Message:
    """SCALED_IMU."""
    return mavlink.MAVLink_scaled_imu_message(time_ms, *_scaled_axes(imu))


def scaled_imu2(time_ms: int, imu: SensedImu) -> Message:
    """SCALED_IMU2, the second sensor; here the same one."""
    return mavlink.MAVLink_scaled_imu2_message(time_ms, *_scaled_axes(imu))


def attitude_quaternion(time_ms: int, attitude: SensedAttitude) -> Message:
    """ATTITUDE_QUATERNION: w x y z body to NED, rad/s."""
    return mavlink.MAVLink_attitude_quaternion_message(
        time_ms,
        *(float(part) for part in attitude.quaternion),
        *(float(axis) for axis in attitude.rates_rps),
    )


def attitude_euler(time_ms: int, attitude: SensedAttitude) -> Message:
    """ATTITUDE: roll, pitch, yaw in rad."""
    return mavlink.MAVLink_attitude_message(
        time_ms, *to_euler(attitude.quaternion), *(float(axis) for axis in attitude.rates_rps)
    )


def gps_raw_int(time_us: int, fix: GpsFix) -> Message:
    """GPS_RAW_INT of a valid fix: 1e-7 deg, mm, dilutions times 100, cm/s, centidegrees."""
    return mavlink.MAVLink_gps_raw_int_message(
        time_us,
        FIX_3D,
        round(1e7 * fix.lat_deg),
        round(1e7 * fix.lon_deg),
        millimetres(fix.alt_msl_m),
        clamp(100.0 * fix.hdop, 0, UINT16_UNKNOWN - 1),
        clamp(100.0 * fix.vdop, 0, UINT16_UNKNOWN - 1),
        clamp(100.0 * fix.speed_mps, 0, UINT16_UNKNOWN - 1),
        clamp(100.0 * math.degrees(fix.course_rad), 0, 35999),
        SATELLITES_USED,
        alt_ellipsoid=millimetres(fix.alt_ellipsoid_m),
        h_acc=round(1e3 * fix.h_acc_m),
        v_acc=round(1e3 * fix.v_acc_m),
        vel_acc=round(1e3 * fix.speed_acc_mps),
        hdg_acc=ACCURACY_UNKNOWN,
        yaw=0,
    )


def gps_raw_int_lost(time_us: int, fix_type: int) -> Message:
    """GPS_RAW_INT of a receiver without a solution."""
    unknown = UINT16_UNKNOWN
    return mavlink.MAVLink_gps_raw_int_message(
        time_us, fix_type, 0, 0, 0, unknown, unknown, unknown, unknown, SATELLITES_UNKNOWN
    )


def local_position_ned(time_ms: int, position_m: Array, velocity_mps: Array) -> Message:
    """LOCAL_POSITION_NED relative to the autopilot's own origin."""
    return mavlink.MAVLink_local_position_ned_message(
        time_ms, *(float(axis) for axis in position_m), *(float(axis) for axis in velocity_mps)
    )


def global_position_int(
    time_ms: int,
    geodetic: tuple[float, float, float],
    relative_alt_m: float,
    velocity_mps: Array,
    heading_rad: float,
) -> Message:
    """GLOBAL_POSITION_INT of degrees, MSL height in m, velocity NED; heading in centidegrees."""
    lat_deg, lon_deg, alt_msl_m = geodetic
    return mavlink.MAVLink_global_position_int_message(
        time_ms,
        round(1e7 * lat_deg),
        round(1e7 * lon_deg),
        millimetres(alt_msl_m),
        millimetres(relative_alt_m),
        *(int16(100.0 * float(axis)) for axis in velocity_mps),
        clamp(100.0 * math.degrees(heading_rad % (2.0 * math.pi)), 0, 35999),
    )


def odometry(time_us: int, position_m: Array, velocity_body: Array, attitude: SensedAttitude) -> Message:
    """ODOMETRY as PX4 sends it: LOCAL_NED about its origin, BODY_FRD, off-diagonal covariances NaN."""
    covariance = [math.nan] * 21
    for diagonal, variance in zip((0, 6, 11, 15, 18, 20), (0.1, 0.1, 0.2, 1e-4, 1e-4, 1e-3), strict=True):
        covariance[diagonal] = variance
    return mavlink.MAVLink_odometry_message(
        time_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *(float(axis) for axis in position_m),
        [float(part) for part in attitude.quaternion],
        *(float(axis) for axis in velocity_body),
        *(float(axis) for axis in attitude.rates_rps),
        covariance,
        covariance,
        reset_counter=0,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        quality=0,
    )


def home_position(geodetic: tuple[float, float, float], local_m: Array, quaternion: Array, time_us: int) -> Message:
    """HOME_POSITION: latitude and longitude in deg, MSL height in m; the local part about the origin."""
    lat_deg, lon_deg, alt_msl_m = geodetic
    return mavlink.MAVLink_home_position_message(
        round(1e7 * lat_deg),
        round(1e7 * lon_deg),
        millimetres(alt_msl_m),
        *(float(axis) for axis in local_m),
        [float(part) for part in quaternion],
        0.0,
        0.0,
        0.0,
        time_usec=time_us,
    )


def gps_global_origin(geodetic: tuple[float, float, float], time_us: int) -> Message:
    """GPS_GLOBAL_ORIGIN: what LOCAL_POSITION_NED is relative to."""
    lat_deg, lon_deg, alt_msl_m = geodetic
    return mavlink.MAVLink_gps_global_origin_message(
        round(1e7 * lat_deg), round(1e7 * lon_deg), millimetres(alt_msl_m), time_usec=time_us
    )


def autopilot_version(capabilities: int, software_version: int, uid: int) -> Message:
    """AUTOPILOT_VERSION."""
    none = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        capabilities, software_version, 0, 0, 0, none, none, none, 0, 0, uid
    )


def statustext(severity: int, text: str) -> Message:
    """STATUSTEXT, one chunk of at most 50 bytes."""
    return mavlink.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:50])
