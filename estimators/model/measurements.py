"""Measurement rows: what a sensor said, at which instant, how well, and how far off it can be at most.

Every sensor reduces to scalar rows with independent noise (a correlated vector measurement is turned into
its principal axes by the builders below), so one table serves the window, the filters and the wire.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
RowTable = NDArray[np.void]
"""Structured array of dtype `ROW`, one entry a scalar measurement."""
InputTable = NDArray[np.void]
"""Structured array of dtype `INPUT`, one entry the averaged acceleration of one agent over one tick."""


class Kind(IntEnum):
    """What a row measures; ``o`` is the row's ``offset_s``, ``p + v o`` the position at its own instant."""

    POSITION = 0
    """``direction . (p + v o)`` in m."""
    VELOCITY = 1
    """``direction . v`` in m/s."""
    SPEED = 2
    """``sqrt(|v + s|^2 + eps^2)`` in m/s; ``x, y, z`` is s, what the antenna moves against the body."""
    RANGE = 3
    """``sqrt(|p_agent - p_other + s|^2 + eps^2)``, both at the row's instant, in m; ``x, y, z`` is s, the lever arm
    of the one end's antenna less that of the other's."""
    ANCHOR_RANGE = 4
    """``sqrt(|p_agent - anchor|^2 + eps^2)`` in m; the anchor is in ``x, y, z``."""
    HEIGHT = 5
    """The third component of ``p + v o``, NED m; ``x`` is how much it holds of the agent's height errors: 1 for a
    barometer, 0 for a range finder above known ground."""
    ODOMETRY = 6
    """``direction . v`` in m/s, as `VELOCITY`, of another sensor than the receiver: neither vouches for the other."""
    RELATIVE = 7
    """``direction . (p_agent - p_other)``, both at the row's instant, in m."""


ROW = np.dtype(
    [
        ("tick", np.int64),  # the tick the instant belongs to
        ("offset_s", np.float64),  # instant minus the tick's time
        ("value", np.float64),  # m or m/s
        ("variance", np.float64),  # of the noise, unit of value squared
        ("half_width", np.float64),  # hard bound on the noise; inf where the sensor has none
        ("x", np.float64),  # unit direction of linear rows, anchor (ANCHOR_RANGE), shift s (others), NED
        ("y", np.float64),
        ("z", np.float64),
        ("kind", np.int32),
        ("agent", np.int32),  # slot of the agent measured
        ("other", np.int32),  # slot of the other end (RANGE, RELATIVE), -1 otherwise
        ("observer", np.int32),  # slot of the agent whose sensor it is
    ],
    align=True,
)

INPUT = np.dtype(
    [
        ("tick", np.int64),  # acts from this tick to the next
        ("accel", np.float64, 3),  # NED m/s^2, gravity removed
        ("variance", np.float64, 3),  # of its noise, (m/s^2)^2
        ("agent", np.int32),  # slot
    ],
    align=True,
)


def is_shifted(rows: RowTable) -> bool:
    """Whether ranges between agents or speeds are of antennas beside the bodies."""
    of_antennas = rows[(rows["kind"] == Kind.RANGE) | (rows["kind"] == Kind.SPEED)]
    return any(bool(of_antennas[axis].any()) for axis in ("x", "y", "z"))


def empty_rows() -> RowTable:
    """A table without rows."""
    return np.zeros(0, ROW)


def empty_inputs() -> InputTable:
    """A table without inputs."""
    return np.zeros(0, INPUT)


def _rows(count: int, **columns: Any) -> RowTable:
    rows = np.zeros(count, ROW)
    rows["other"] = -1
    for name, column in columns.items():
        rows[name] = column
    return rows


def _principal_axes(
    vector: ArrayLike, covariance: ArrayLike, half_width: ArrayLike
) -> tuple[Matrix, Vector, Vector, Vector]:
    """Directions (rows), values, variances and half widths of three independent scalar measurements.

    A diagonal covariance (given as a vector of three variances or a diagonal matrix) keeps the NED axes and
    its bounds. A full one is turned to its eigenvectors; a box bound in NED becomes the box that holds it.
    """
    value = np.asarray(vector, float)
    cov = np.asarray(covariance, float)
    half = np.broadcast_to(np.asarray(half_width, float), (3,))
    if cov.ndim == 1 or not (cov - np.diag(np.diag(cov))).any():
        return np.eye(3), value, np.array(cov if cov.ndim == 1 else np.diag(cov)), np.array(half)
    variances, axes = np.linalg.eigh(cov)
    directions = axes.T
    with np.errstate(invalid="ignore"):  # 0 * inf: an absent bound stays absent
        turned = np.abs(directions) @ half
    return directions, directions @ value, variances, np.where(np.isfinite(turned), turned, np.inf)


def position_rows(
    tick: int,
    agent: int,
    position_m: ArrayLike,
    covariance: ArrayLike,
    *,
    offset_s: float = 0.0,
    half_width_m: ArrayLike = np.inf,
    observer: int | None = None,
) -> RowTable:
    """Rows of a position fix ``(3,)`` NED m with covariance ``(3, 3)`` or variances ``(3,)``."""
    direction, value, variance, half = _principal_axes(position_m, covariance, half_width_m)
    return _vector_rows(Kind.POSITION, tick, agent, offset_s, observer, direction, value, variance, half)


def velocity_rows(
    tick: int,
    agent: int,
    velocity_mps: ArrayLike,
    covariance: ArrayLike,
    *,
    offset_s: float = 0.0,
    half_width_mps: ArrayLike = np.inf,
    observer: int | None = None,
    kind: Kind = Kind.VELOCITY,
) -> RowTable:
    """Rows of a velocity vector ``(3,)`` NED m/s with covariance ``(3, 3)`` or variances ``(3,)``.

    ``kind``: `Kind.VELOCITY` of a receiver, or `Kind.ODOMETRY`.
    """
    direction, value, variance, half = _principal_axes(velocity_mps, covariance, half_width_mps)
    return _vector_rows(kind, tick, agent, offset_s, observer, direction, value, variance, half)


def _vector_rows(
    kind: Kind,
    tick: int,
    agent: int,
    offset_s: float,
    observer: int | None,
    direction: Matrix,
    value: Vector,
    variance: Vector,
    half_width: Vector,
) -> RowTable:
    return _rows(
        3,
        kind=kind,
        tick=tick,
        offset_s=offset_s,
        value=value,
        variance=variance,
        half_width=half_width,
        x=direction[:, 0],
        y=direction[:, 1],
        z=direction[:, 2],
        agent=agent,
        observer=agent if observer is None else observer,
    )


def speed_row(
    tick: int,
    agent: int,
    speed_mps: float,
    variance: float,
    *,
    offset_s: float = 0.0,
    half_width_mps: float = np.inf,
    shift_mps: ArrayLike = (0.0, 0.0, 0.0),
) -> RowTable:
    """The row of a speed norm in m/s (second line of Borelle et al. 2023, eq. 28).

    ``shift_mps`` ``(3,)`` NED: velocity of the antenna against the body's.
    """
    shift = np.asarray(shift_mps, float)
    return _rows(
        1,
        kind=Kind.SPEED,
        tick=tick,
        offset_s=offset_s,
        value=speed_mps,
        variance=variance,
        half_width=half_width_mps,
        x=shift[0],
        y=shift[1],
        z=shift[2],
        agent=agent,
        observer=agent,
    )


def range_row(
    tick: int,
    observer: int,
    target: int,
    range_m: float,
    variance: float,
    *,
    offset_s: float = 0.0,
    half_width_m: float = np.inf,
    shift_m: ArrayLike = (0.0, 0.0, 0.0),
) -> RowTable:
    """The row of a range in m between two agents, measured by ``observer`` (Borelle et al. 2023, eq. 29).

    ``shift_m`` ``(3,)`` NED: lever arm of the observer's antenna less that of the target's.
    """
    shift = np.asarray(shift_m, float)
    return _rows(
        1,
        kind=Kind.RANGE,
        tick=tick,
        offset_s=offset_s,
        value=range_m,
        variance=variance,
        half_width=half_width_m,
        x=shift[0],
        y=shift[1],
        z=shift[2],
        agent=observer,
        other=target,
        observer=observer,
    )


def anchor_range_row(
    tick: int,
    agent: int,
    anchor_m: ArrayLike,
    range_m: float,
    variance: float,
    *,
    offset_s: float = 0.0,
    half_width_m: float = np.inf,
) -> RowTable:
    """The row of a range in m to a fixed anchor at ``anchor_m`` ``(3,)``, NED m."""
    anchor = np.asarray(anchor_m, float)
    return _rows(
        1,
        kind=Kind.ANCHOR_RANGE,
        tick=tick,
        offset_s=offset_s,
        value=range_m,
        variance=variance,
        half_width=half_width_m,
        x=anchor[0],
        y=anchor[1],
        z=anchor[2],
        agent=agent,
        observer=agent,
    )


def height_row(
    tick: int,
    agent: int,
    down_m: float,
    variance: float,
    *,
    offset_s: float = 0.0,
    half_width_m: float = np.inf,
    drifts: bool,
) -> RowTable:
    """The row of a height: ``down_m`` is NED.

    ``drifts``: of a barometer, whose error is slow (`estimators.systematic.slow_errors`).
    """
    return _rows(
        1,
        kind=Kind.HEIGHT,
        tick=tick,
        offset_s=offset_s,
        value=down_m,
        variance=variance,
        half_width=half_width_m,
        x=float(drifts),
        agent=agent,
        observer=agent,
    )


def relative_rows(
    tick: int,
    observer: int,
    target: int,
    place_m: ArrayLike,
    along_variance: float | None,
    across_variance: float,
    *,
    offset_s: float = 0.0,
) -> RowTable:
    """The rows of where ``observer`` sees ``target``: ``place_m`` ``(3,)`` is p_target - p_observer, NED m.

    It must not be zero. ``along_variance`` of the distance (``None``: only the direction was seen),
    ``across_variance`` across it.
    """
    place = np.asarray(place_m, float)
    away_m = float(np.linalg.norm(place))
    sight = place / away_m
    first = np.zeros(3)
    first[int(np.argmin(np.abs(sight)))] = 1.0
    first -= (first @ sight) * sight
    first /= np.linalg.norm(first)
    axes = np.array([-sight, first, np.cross(sight, first)])
    variances = np.array([np.inf if along_variance is None else along_variance, across_variance, across_variance])
    values, unbounded = np.array([away_m, 0.0, 0.0]), np.full(3, np.inf)
    rows = _vector_rows(Kind.RELATIVE, tick, observer, offset_s, None, axes, values, variances, unbounded)
    rows["other"] = target
    return rows if along_variance is not None else rows[1:]


def input_rows(tick: int, agent: int, accel_mps2: ArrayLike, variance: ArrayLike) -> InputTable:
    """The averaged acceleration ``(3,)`` of one agent over the tick that starts at ``tick``."""
    table = np.zeros(1, INPUT)
    table["tick"] = tick
    table["agent"] = agent
    table["accel"] = np.asarray(accel_mps2, float)
    table["variance"] = np.broadcast_to(np.asarray(variance, float), (3,))
    return table
