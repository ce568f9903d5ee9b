"""Samples to the records that travel, and records to the rows that estimators take.

A measurement is put to the nearest tick: its row extrapolates with the velocity alone, and what that leaves
out grows with the offset. (Fixes come at whole tenths of a second, give or take a clock error: taken with the
tick that they fall into, half of them would be a whole period off.)

An agent feeds its own estimator with its records as the wire rounds them, so that all agents work on the
same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from agent.config.tables import SensorsTable
from agent.fleet.lever_arms import LeverArms, Shift
from agent.sensing.barometer import SIGMA_M
from agent.sensing.detections import DetectionSample
from agent.sensing.odometry import MeasuredVelocity
from agent.sensing.samples import BaroSample, GpsSample, RangeSample, Triple
from agent.sensing.timeline import TickInput, nearest_tick
from estimators.model.measurements import INPUT, ROW, InputTable, Kind, RowTable, relative_rows
from transport.messages.measurement_body import (
    NO_BOUND,
    UNSEEN_VARIANCE,
    AccelerationMeasurement,
    AnchorRangeMeasurement,
    AntennaSpeedMeasurement,
    GroundHeightMeasurement,
    HeightMeasurement,
    Measurement,
    OdometryMeasurement,
    OrientationMeasurement,
    PositionMeasurement,
    RangeMeasurement,
    SightingMeasurement,
    SpeedMeasurement,
    TagRangeMeasurement,
    VelocityMeasurement,
)

UNMEASURED_VARIANCE = 1e6
"""Stands for an axis that was not measured (the wire has no gap); such an axis makes no row."""
THREE_D_FIX = 3
LEAST_SIGMA = 0.01
"""Of any measurement, in m or m/s, whatever its owner claims: no sensor of a drone in flight is better, and a member
whose record says so would draw all others to it. The owner's own floors are higher."""

_Row = tuple[int, float, float, float, float, float, float, float, Kind, int, int, int]
"""A row in the order of `ROW`."""
_NED: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_NOWHERE: Triple = (0.0, 0.0, 0.0)


def gps_measurements(observer: int, sample: GpsSample, period_s: float, sensors: SensorsTable) -> list[Measurement]:
    """Position and speed (or horizontal velocity) of a fix; configured half widths replace its accuracies."""
    tick = nearest_tick(sample.t_s, period_s)
    offset_s = sample.t_s - tick * period_s
    half_width = sensors.gps_position_half_width_m
    if half_width is None:
        factor = sensors.gps_variance_factor
        horizontal, vertical = factor * sample.horizontal_sigma_m**2, factor * sample.vertical_sigma_m**2
        bounds = NO_BOUND
    else:
        horizontal = vertical = half_width**2 / 3
        bounds = (half_width, half_width, half_width)
    if sample.fix_type < THREE_D_FIX:
        vertical = UNMEASURED_VARIANCE
    variance = (horizontal, horizontal, vertical)
    position = PositionMeasurement(observer, tick, sample.position_m, variance, bounds, offset_s)
    return [position, *_speed_records(observer, tick, offset_s, sample, sensors)]


def _speed_records(
    observer: int, tick: int, offset_s: float, sample: GpsSample, sensors: SensorsTable
) -> list[Measurement]:
    half_width = sensors.gps_speed_half_width_mps
    variance = sample.speed_sigma_mps**2 if half_width is None else half_width**2 / 3
    bound = math.inf if half_width is None else half_width
    if sample.speed_mps is not None:
        said = observer, tick, sample.speed_mps, variance, bound, offset_s
        moves = any(sample.shift_mps)
        return [AntennaSpeedMeasurement(*said, sample.shift_mps) if moves else SpeedMeasurement(*said)]
    if sample.ground_velocity_mps is not None:
        north, east = sample.ground_velocity_mps
        variances = (variance, variance, UNMEASURED_VARIANCE)
        bounds = (bound, bound, math.inf)
        return [VelocityMeasurement(observer, tick, (north, east, 0.0), variances, bounds, offset_s)]
    return []


def range_measurement(sample: RangeSample, period_s: float, sensors: SensorsTable) -> RangeMeasurement:
    """The record of a range; a configured bound replaces its accuracy."""
    tick = nearest_tick(sample.t_s, period_s)
    bound = sensors.uwb_bound_m
    variance = sample.sigma_m**2 if bound is None else bound**2 / 3
    half_width = math.inf if bound is None else bound
    offset_s = sample.t_s - tick * period_s
    said = sample.observer, tick, sample.target, sample.range_m, variance, half_width, offset_s
    if sample.tag or sample.other_tag:
        return TagRangeMeasurement(*said, sample.tag, sample.other_tag)
    return RangeMeasurement(*said)


def anchor_measurement(
    sample: RangeSample, anchor_m: Triple, arm: Shift, period_s: float, sensors: SensorsTable
) -> AnchorRangeMeasurement:
    """The record of a range to an anchor at ``anchor_m``, NED: as if the body had measured it.

    The distance from an antenna at p + arm to the anchor is that of p to the anchor less the arm.
    """
    said = range_measurement(sample, period_s, sensors)
    seen = (anchor_m[0] - arm.arm_m[0], anchor_m[1] - arm.arm_m[1], anchor_m[2] - arm.arm_m[2])
    noise = said.variance_m2 + arm.variance_m2, said.half_width_m
    return AnchorRangeMeasurement(said.observer, said.tick, seen, said.range_m, *noise, said.offset_s)


def sighting_measurement(
    observer: int, sample: DetectionSample, direction: Triple, away_m: float, period_s: float
) -> SightingMeasurement:
    """The record of a detection, along a ``direction`` in NED; ``away_m`` where it has no distance of its own."""
    tick = nearest_tick(sample.t_s, period_s)
    distance_m, sigma_m = sample.distance_m, sample.distance_sigma_m
    seen_m = away_m if distance_m is None else distance_m
    along = UNSEEN_VARIANCE if sigma_m is None else sigma_m**2
    across = (sample.sigma_rad * seen_m) ** 2
    offset_s = sample.t_s - tick * period_s
    return SightingMeasurement(
        observer, tick, sample.target, seen_m, along, math.inf, offset_s, direction, across
    )


def height_measurement(observer: int, sample: BaroSample, period_s: float) -> HeightMeasurement:
    """The record of a barometer's sample, whose altitude is above the fleet's origin."""
    tick = nearest_tick(sample.t_s, period_s)
    return HeightMeasurement(observer, tick, -sample.altitude_m, SIGMA_M**2, sample.t_s - tick * period_s)


def ground_measurement(
    observer: int, t_s: float, altitude_m: float, sigma_m: float, period_s: float
) -> GroundHeightMeasurement:
    """The record of an altitude above the fleet's origin by what was measured to the ground."""
    tick = nearest_tick(t_s, period_s)
    return GroundHeightMeasurement(observer, tick, -altitude_m, sigma_m**2, t_s - tick * period_s)


def odometry_measurement(
    observer: int, t_s: float, measured: MeasuredVelocity, period_s: float
) -> OdometryMeasurement:
    """The record of a velocity that is not the receiver's."""
    tick = nearest_tick(t_s, period_s)
    north, east, down = (min(variance, UNMEASURED_VARIANCE) for variance in measured.variance_m2ps2)
    offset_s = t_s - tick * period_s
    return OdometryMeasurement(observer, tick, measured.velocity_mps, (north, east, down), offset_s)


def acceleration_measurement(observer: int, closed: TickInput) -> AccelerationMeasurement:
    """The record of a tick's averaged acceleration."""
    return AccelerationMeasurement(observer, closed.tick, closed.accel_mps2, closed.variance)


def rows_of(
    records: Iterable[Measurement], slots: Mapping[int, int], arms: LeverArms | None = None
) -> RowTable:
    """The rows of records of sensors, in their order, sightings last.

    ``slots`` by agent id, ``arms`` where antennas have any. None is surer than `LEAST_SIGMA`. All in one table at
    once: numpy takes as long for a table of one row as for ten. Raises `TypeError` for an acceleration, which is an
    input, and for an orientation, which turns arms.
    """
    rows: list[_Row] = []
    tables: list[RowTable] = []
    for record in records:
        tick, slot = record.tick, slots[record.observer]
        match record:
            case PositionMeasurement(_, _, value, variance, half_width, offset_s):
                axes = zip(value, variance, half_width, _NED, strict=True)
                rows += _axis_rows(Kind.POSITION, tick, offset_s, slot, axes)
            case VelocityMeasurement(_, _, value, variance, half_width, offset_s):
                axes = zip(value, variance, half_width, _NED, strict=True)
                rows += _axis_rows(Kind.VELOCITY, tick, offset_s, slot, axes)
            case OdometryMeasurement(_, _, value, variance, offset_s):
                axes = zip(value, variance, NO_BOUND, _NED, strict=True)
                rows += _axis_rows(Kind.ODOMETRY, tick, offset_s, slot, axes)
            case SpeedMeasurement():
                noise = record.variance_m2ps2, record.half_width_mps
                shift = record.shift_mps if isinstance(record, AntennaSpeedMeasurement) else _NOWHERE
                rows.append((tick, record.offset_s, record.speed_mps, *noise, *shift, Kind.SPEED, slot, -1, slot))
            case SightingMeasurement():
                tables.append(_sighting_rows(record, slot, slots[record.other]))
            case RangeMeasurement():
                between = Shift() if arms is None else arms.shift(record)
                noise, other = (record.variance_m2 + between.variance_m2, record.half_width_m), slots[record.other]
                ends = Kind.RANGE, slot, other, slot
                rows.append((tick, record.offset_s, record.range_m, *noise, *between.arm_m, *ends))
            case AnchorRangeMeasurement():
                noise, kind = (record.variance_m2, record.half_width_m), Kind.ANCHOR_RANGE
                rows.append((tick, record.offset_s, record.range_m, *noise, *record.anchor_m, kind, slot, -1, slot))
            case HeightMeasurement():
                noise, kind = (record.variance_m2, math.inf), Kind.HEIGHT
                drifts = 0.0 if isinstance(record, GroundHeightMeasurement) else 1.0
                rows.append((tick, record.offset_s, record.down_m, *noise, drifts, 0.0, 0.0, kind, slot, -1, slot))
            case AccelerationMeasurement() | OrientationMeasurement():
                raise TypeError(f"not a measurement that makes rows: {record}")
    table = np.array(rows, ROW)
    if tables:
        table = np.concatenate((table, *tables))
    np.maximum(table["variance"], LEAST_SIGMA**2, out=table["variance"])
    return table


def _sighting_rows(record: SightingMeasurement, slot: int, other: int) -> RowTable:
    place = record.range_m * np.array(record.direction)
    along = None if record.is_bearing else record.variance_m2
    return relative_rows(record.tick, slot, other, place, along, record.variance_across_m2, offset_s=record.offset_s)


def inputs_of(records: Iterable[AccelerationMeasurement], slots: Mapping[int, int]) -> InputTable:
    """The inputs of records, in their order; ``slots`` by agent id."""
    return np.array(
        [(record.tick, record.accel_mps2, record.variance_m2ps4, slots[record.observer]) for record in records], INPUT
    )


def _axis_rows(
    kind: Kind, tick: int, offset_s: float, slot: int, axes: Iterable[tuple[float, float, float, Triple]]
) -> list[_Row]:
    """The rows of the axes that were measured (rounding on the wire only raises variances).

    ``axes``: value, variance, half width and direction of each.
    """
    return [
        (tick, offset_s, value, variance, half_width, *direction, kind, slot, -1, slot)
        for value, variance, half_width, direction in axes
        if variance < 0.99 * UNMEASURED_VARIANCE
    ]
