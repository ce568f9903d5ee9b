"""Topics of a PX4 log to samples, one generator per topic, in order of publication.

Samples bear ``timestamp_sample``, the instant of the value, where the firmware logged it.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import SensorsTable
from agent.mavlink.sample_adapter import GROUND_SHARE, GROUND_SIGMA_M
from agent.sensing.barometer import pressure_altitude_m
from agent.sensing.frames import FleetFrame, normalised
from agent.sensing.receivers import ReceiverChoice
from agent.sensing.samples import (
    AttitudeSample,
    AutopilotEstimate,
    BaroSample,
    GpsSample,
    GroundSample,
    ImuSample,
    Quaternion,
    Triple,
)
from sim_bridge.replay.logs.events import LogSample, TruthSample
from sim_bridge.replay.logs.gps_samples import ReceiverFix, gps_sample, imu_sample
from sim_bridge.replay.logs.ulog.tables import TopicTable

_QUATERNION = ("q[0]", "q[1]", "q[2]", "q[3]")
_IMU = (
    "accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]", "gyro_rad[0]", "gyro_rad[1]",
    "gyro_rad[2]",
)  # fmt: skip
_BIAS = ("accel_bias[0]", "accel_bias[1]", "accel_bias[2]", "gyro_bias[0]", "gyro_bias[1]", "gyro_bias[2]")
LARGEST_BIAS_MPS2 = 1.0
"""What PX4's filter says beyond this is no bias (its own limit is 0.4)."""
FIX_3D = 3
LOOKS_DOWN = 25
"""ROTATION_DOWNWARD_FACING, as MAV_SENSOR_ROTATION_PITCH_270."""
_MOTION = ("x", "y", "z", "vx", "vy", "vz")
_REFERENCE = ("ref_lat", "ref_lon", "ref_alt")
_GPS = (
    "timestamp_sample", "time_utc_usec", "fix_type", "eph", "epv", "hdop", "vdop", "s_variance_m_s", "vel_m_s",
    "vel_n_m_s", "vel_e_m_s", "vel_d_m_s", "cog_rad", "vel_ned_valid", "latitude_deg", "longitude_deg",
    "altitude_msl_m", "altitude_ellipsoid_m", "lat", "lon", "alt", "alt_ellipsoid",
)  # fmt: skip
GPS_TOPICS = ("vehicle_gps_position", "sensor_gps")
WANTED: dict[str, tuple[str, ...]] = {
    "sensor_combined": _IMU,
    "estimator_sensor_bias": (*_BIAS, "accel_bias_valid", "gyro_bias_valid"),
    "vehicle_attitude": ("timestamp_sample", *_QUATERNION),
    "vehicle_local_position": ("timestamp_sample", *_MOTION, *_REFERENCE, "xy_global", "xy_valid", "z_valid"),
    "vehicle_local_position_groundtruth": ("timestamp_sample", *_MOTION, *_REFERENCE),
    "vehicle_attitude_groundtruth": _QUATERNION,
    "vehicle_air_data": ("timestamp_sample", "baro_pressure_pa"),
    "sensor_baro": ("timestamp_sample", "pressure"),
    "distance_sensor": (
        "current_distance", "min_distance", "max_distance", "variance", "signal_quality", "orientation",
    ),
    "timesync_status": ("remote_timestamp", "observed_offset"),
    **dict.fromkeys(GPS_TOPICS, _GPS),
}  # fmt: skip
ROWS = 1024
MAX_AGE_US = 5_000_000
"""A value older than this at its publication has a wrong stamp."""
SAME_INSTANT_US = 20_000
FIRMWARE_BEFORE_DEGREES = 1e-7
"""PX4 before 1.14 logged 1e-7 degrees and millimetres."""

Timed = tuple[float, LogSample]
"""A sample and the log time of its publication."""


def _sample_times_us(table: TopicTable) -> NDArray[np.int64]:
    """When the values were taken: ``timestamp_sample`` where it is there and can be true."""
    given = table.columns.get("timestamp_sample")
    if given is None:
        return table.timestamp_us
    taken = np.where(given < np.uint64(1 << 62), given, 0).astype(np.int64)
    age = table.timestamp_us - taken
    return np.where((age >= 0) & (age <= MAX_AGE_US), taken, table.timestamp_us)


def rows_of(table: TopicTable, values: NDArray[np.float64]) -> Iterator[tuple[float, float, list[float]]]:
    """Publication, instant of the value (log time in s) and values, a few rows in Python's own types at a time."""
    taken_us = _sample_times_us(table)
    for start in range(0, len(table), ROWS):
        part = slice(start, start + ROWS)
        yield from zip(
            (table.timestamp_us[part] * 1e-6).tolist(),
            (taken_us[part] * 1e-6).tolist(),
            values[part].tolist(),
            strict=True,
        )


def imu_samples(
    table: TopicTable, biases: TopicTable | None, sensors: SensorsTable, skipped: Counter[str]
) -> Iterator[Timed]:
    """``sensor_combined``: gyro at the record's stamp; the accelerometer's few microseconds beside it are left.

    What the autopilot's filter knows of the biases (``estimator_sensor_bias``) is taken off, as in PX4's HIGHRES_IMU.
    """
    values = table.stack(*_IMU)
    if values is None:
        skipped["sensor_combined: fields missing"] += len(table)
        return
    if biases is not None:
        values = values - _biases_at(table, biases)
    for arrival_s, t_s, row in rows_of(table, values):
        sample = imu_sample(t_s, (row[0], row[1], row[2]), (row[3], row[4], row[5]), "px4", sensors)
        if isinstance(sample, ImuSample):
            yield arrival_s, sample
        else:
            skipped[sample] += 1


def _biases_at(table: TopicTable, biases: TopicTable) -> NDArray[np.float64]:
    """The biases known at each record ``(m, 6)``, in the order of `_IMU`; zero before, and where not valid."""
    known = np.zeros((len(biases) + 1, len(_IMU)))
    for columns, sensor, largest in ((slice(0, 3), "accel", LARGEST_BIAS_MPS2), (slice(3, 6), "gyro", math.inf)):
        told = biases.stack(*(f"{sensor}_bias[{axis}]" for axis in range(3)))
        if told is None:
            continue
        flags = biases.columns.get(f"{sensor}_bias_valid", np.ones(len(biases)))
        usable = np.isfinite(told).all(axis=1) & (np.abs(told) <= largest).all(axis=1) & (flags != 0)
        known[1:, columns] = np.where(usable[:, None], told, 0.0)
    return known[np.searchsorted(biases.timestamp_us, table.timestamp_us, side="right")]


def attitude_samples(table: TopicTable, skipped: Counter[str]) -> Iterator[Timed]:
    """``vehicle_attitude``."""
    values = table.stack(*_QUATERNION)
    if values is None:
        skipped["vehicle_attitude: fields missing"] += len(table)
        return
    for arrival_s, t_s, row in rows_of(table, values):
        quaternion = _unit(row)
        if quaternion is None:
            skipped["attitude: no unit quaternion"] += 1
        else:
            yield arrival_s, AttitudeSample(t_s, quaternion)


def barometer_table(topics: Mapping[str, TopicTable]) -> TopicTable | None:
    """The one to be listened to: what the autopilot has chosen of its barometers, or else the first one."""
    return topics.get("vehicle_air_data") or topics.get("sensor_baro")


def baro_samples(table: TopicTable, skipped: Counter[str]) -> Iterator[Timed]:
    """``vehicle_air_data`` in Pa, or ``sensor_baro``, in hPa before PX4 1.14 and in Pa since."""
    values = table.stack("baro_pressure_pa" if table.name == "vehicle_air_data" else "pressure")
    if values is None:
        skipped[f"{table.name}: fields missing"] += len(table)
        return
    for arrival_s, t_s, (pressure,) in rows_of(table, values):
        altitude_m = pressure_altitude_m(pressure)
        if altitude_m is None:
            skipped["baro: no pressure of air"] += 1
        else:
            yield arrival_s, BaroSample(t_s, altitude_m)


def ground_samples(table: TopicTable, skipped: Counter[str]) -> Iterator[Timed]:
    """``distance_sensor`` of a range finder that looks down: m, its variance m2."""
    values = table.stack("current_distance", "min_distance", "max_distance", "orientation")
    if values is None:
        skipped["distance_sensor: fields missing"] += len(table)
        return
    told = [table.columns.get(name, np.full(len(table), -1.0)) for name in ("variance", "signal_quality")]
    values = np.column_stack((values, *(np.asarray(column, np.float64) for column in told)))
    for arrival_s, t_s, (distance_m, least_m, most_m, orientation, variance, quality) in rows_of(table, values):
        if orientation != LOOKS_DOWN:
            skipped["ground: looks elsewhere"] += 1
        elif not (math.isfinite(distance_m) and least_m < distance_m < most_m and quality != 0.0):
            skipped["ground: out of its reach"] += 1
        else:
            known = math.isfinite(variance) and variance > 0.0
            sigma_m = math.sqrt(variance) if known else GROUND_SIGMA_M + GROUND_SHARE * distance_m
            yield arrival_s, GroundSample(t_s, distance_m, sigma_m)


def fixes_of(table: TopicTable) -> int:
    """How many fixes a receiver has."""
    return int((table.columns["fix_type"] >= FIX_3D).sum()) if "fix_type" in table.columns else 0


def has_fixes(table: TopicTable) -> bool:
    """Whether a receiver has any."""
    return fixes_of(table) > 0


def chosen_fixes(
    receivers: Mapping[int, TopicTable], frame: FleetFrame, sensors: SensorsTable, skipped: Counter[str]
) -> Iterator[Timed]:
    """The fixes of the receivers by their numbers, in the order of arrival, each of the one to be listened to."""
    choice = ReceiverChoice([number for number, table in receivers.items() if has_fixes(table)])
    streams = [_fixes(number, table, frame, sensors, skipped) for number, table in receivers.items()]
    for arrival_s, number, sample in heapq.merge(*streams, key=itemgetter(0, 1)):
        if isinstance(sample, str):
            skipped[sample] += 1
            choice.without_fix(number)
        elif choice.takes(number, arrival_s):
            yield arrival_s, sample
        else:
            skipped["gps: not the first one"] += 1


def _fixes(
    receiver: int, table: TopicTable, frame: FleetFrame, sensors: SensorsTable, skipped: Counter[str]
) -> Iterator[tuple[float, int, GpsSample | str]]:
    """``vehicle_gps_position`` or ``sensor_gps``; ``eph``, ``epv`` are 1-sigma in m."""
    where = degrees(table)
    if where is None or "fix_type" not in table.columns:
        skipped[f"{table.name}: fields missing"] += len(table)
        return
    others = (
        "fix_type", "eph", "epv", "hdop", "vdop", "s_variance_m_s", "vel_m_s", "vel_d_m_s", "cog_rad", "vel_n_m_s",
        "vel_e_m_s", "vel_ned_valid",
    )  # fmt: skip
    columns = [table.columns.get(name, np.full(len(table), np.nan)) for name in others]
    values = np.column_stack((where, *(np.asarray(column, np.float64) for column in columns)))
    for arrival_s, t_s, row in rows_of(table, values):
        fix = ReceiverFix(
            t_s=t_s,
            fix_type=int(row[4]),
            lat_deg=row[0],
            lon_deg=row[1],
            alt_msl_m=row[2],
            alt_ellipsoid_m=row[3],
            horizontal_sigma_m=row[5],
            vertical_sigma_m=row[6],
            hdop=row[7],
            vdop=row[8],
            speed_sigma_mps=row[9],
            speed_mps=row[10],
            down_mps=row[11],
            course_rad=row[12],
            # vel_m_s is the norm with some receivers (DroneCAN, VectorNav), the ground speed with others
            ground_velocity_mps=(row[13], row[14]) if row[15] == 1.0 else None,
        )
        yield arrival_s, receiver, gps_sample(fix, frame, "px4", sensors, receiver)


def degrees(table: TopicTable) -> NDArray[np.float64] | None:
    """Latitude, longitude (deg), height above mean sea level and above the ellipsoid (m), ``(m, 4)``."""
    where = table.stack("latitude_deg", "longitude_deg", "altitude_msl_m", "altitude_ellipsoid_m")
    if where is not None:
        return where
    whole = table.stack("lat", "lon", "alt", "alt_ellipsoid")
    return None if whole is None else whole * (FIRMWARE_BEFORE_DEGREES, FIRMWARE_BEFORE_DEGREES, 1e-3, 1e-3)


def estimate_samples(table: TopicTable, frame: FleetFrame, skipped: Counter[str]) -> Iterator[Timed]:
    """``vehicle_local_position`` in the fleet's frame, each record by its own reference.

    Records without reference are about the autopilot's own origin, and left out if others have one.
    """
    values = table.stack(*_MOTION, *_REFERENCE)
    if values is None:
        skipped["vehicle_local_position: fields missing"] += len(table)
        return
    shifts = _shifts(values[:, 6:], frame)
    for arrival_s, t_s, row in rows_of(table, values):
        if not all(map(math.isfinite, row[:6])):
            skipped["autopilot estimate: not finite"] += 1
            continue
        shift = shifts.get((row[6], row[7], row[8]))
        if shift is None:
            if shifts:
                skipped["autopilot estimate: origin unknown"] += 1
                continue
            shift = (0.0, 0.0, 0.0)
        position = (row[0] + shift[0], row[1] + shift[1], row[2] + shift[2])
        yield arrival_s, AutopilotEstimate(t_s, position, (row[3], row[4], row[5]))


def truth_samples(
    table: TopicTable, attitude: TopicTable | None, frame: FleetFrame, skipped: Counter[str]
) -> Iterator[Timed]:
    """``vehicle_local_position_groundtruth`` with the attitude of the same instant."""
    values = table.stack(*_MOTION, *_REFERENCE)
    if values is None:
        skipped["vehicle_local_position_groundtruth: fields missing"] += len(table)
        return
    quaternions = _beside(table, attitude)
    shifts = _shifts(values[:, 6:], frame)
    for arrival_s, t_s, row in rows_of(table, np.column_stack((values, quaternions))):
        shift = shifts.get((row[6], row[7], row[8]))
        if shift is None or not all(map(math.isfinite, row[:6])):
            skipped["truth: not finite or no place"] += 1
            continue
        position = (row[0] + shift[0], row[1] + shift[1], row[2] + shift[2])
        yield arrival_s, TruthSample(t_s, position, (row[3], row[4], row[5]), _unit(row[9:]))


def _beside(table: TopicTable, attitude: TopicTable | None) -> NDArray[np.float64]:
    """The attitude nearest to each record ``(m, 4)``; NaN where none is near."""
    missing = np.full((len(table), 4), np.nan)
    quaternions = None if attitude is None else attitude.stack(*_QUATERNION)
    if attitude is None or quaternions is None:
        return missing
    right = np.clip(np.searchsorted(attitude.timestamp_us, table.timestamp_us), 0, len(attitude) - 1)
    left = np.maximum(right - 1, 0)
    distance_right = np.abs(attitude.timestamp_us[right] - table.timestamp_us)
    distance_left = np.abs(attitude.timestamp_us[left] - table.timestamp_us)
    nearest = np.where(distance_left < distance_right, left, right)
    near = np.minimum(distance_left, distance_right) <= SAME_INSTANT_US
    missing[near] = quaternions[nearest[near]]
    return missing


def _shifts(references: NDArray[np.float64], frame: FleetFrame) -> dict[tuple[float, float, float], Triple]:
    """Each reference (latitude, longitude, height above mean sea level) in NED of the fleet."""
    shifts = {}
    for lat_deg, lon_deg, alt_m in np.unique(references, axis=0).tolist():
        if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and math.isfinite(alt_m) and (lat_deg or lon_deg)):
            continue
        height_m = frame.height(alt_m, None)
        if height_m is not None:
            shifts[lat_deg, lon_deg, alt_m] = frame.ned(lat_deg, lon_deg, height_m)
    return shifts


def _unit(row: list[float]) -> Quaternion | None:
    w, x, y, z = row
    return normalised((w, x, y, z))
