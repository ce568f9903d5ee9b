"""PX4's ``vehicle_visual_odometry`` to velocities: what a companion gave the autopilot, as it measured it.

PX4's own ``vehicle_odometry`` is its estimate, and no measurement. Frames of velocities were numbered anew in 1.14,
when the fields got other names.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agent.mavlink.velocities import MAX_MPS, SIGMA_MPS
from agent.sensing.frames import normalised, rotated
from agent.sensing.samples import VelocitySample
from sim_bridge.replay.logs.ulog.samples import Timed, rows_of
from sim_bridge.replay.logs.ulog.tables import TopicTable

VISUAL_ODOMETRY = "vehicle_visual_odometry"
_Q = ("q[0]", "q[1]", "q[2]", "q[3]")
_SINCE_1_14 = (
    ("velocity[0]", "velocity[1]", "velocity[2]"),
    ("velocity_variance[0]", "velocity_variance[1]", "velocity_variance[2]"),
)
_BEFORE = (("vx", "vy", "vz"), ("velocity_covariance[0]", "velocity_covariance[6]", "velocity_covariance[11]"))
FIELDS = (
    "timestamp_sample", "quality", "velocity_frame", "pose_frame", "local_frame", *_Q, *_SINCE_1_14[0],
    *_SINCE_1_14[1], *_BEFORE[0], *_BEFORE[1],
)  # fmt: skip
_NED, _FRD, _BODY = "ned", "frd", "body"
_FRAMES_SINCE_1_14 = {1: _NED, 2: _FRD, 3: _BODY}
_FRAMES_BEFORE = {0: _NED, 1: _FRD, 3: _BODY}
FAILED = -1


def odometry_samples(table: TopicTable, skipped: Counter[str], *, may_be_ours: bool) -> Iterator[Timed]:
    """The velocities of a table; none where they may be what we gave the autopilot."""
    if may_be_ours:
        skipped["odometry: may be ours"] += len(table)
        return
    since = all(name in table.columns for name in _SINCE_1_14[0])
    names, variances = _SINCE_1_14 if since else _BEFORE
    velocities = table.stack(*names)
    if velocities is None:
        skipped[f"{table.name}: fields missing"] += len(table)
        return
    frames = _FRAMES_SINCE_1_14 if since else _FRAMES_BEFORE
    values = np.column_stack(
        (
            velocities,
            _columns(table, variances, math.nan),
            _columns(table, ("velocity_frame",), math.nan),
            _columns(table, _Q, math.nan),
            _columns(table, ("quality",), 0.0),
        )
    )
    for arrival_s, t_s, row in rows_of(table, values):
        sample = _sample(t_s, row, frames)
        if isinstance(sample, str):
            skipped[f"odometry: {sample}"] += 1
        else:
            yield arrival_s, sample


def _columns(table: TopicTable, names: tuple[str, ...], absent: float) -> NDArray[np.float64]:
    found = table.stack(*names)
    return np.full((len(table), len(names)), absent) if found is None else found


def _sample(t_s: float, row: list[float], frames: dict[int, str]) -> VelocitySample | str:
    velocity = (row[0], row[1], row[2])
    if not all(map(math.isfinite, velocity)):
        return "not finite"
    if max(map(abs, velocity)) > MAX_MPS:
        return "out of range"
    if row[11] == FAILED:
        return "says that it failed"
    a, b, c = (
        math.sqrt(variance) if math.isfinite(variance) and variance > 0.0 else SIGMA_MPS for variance in row[3:6]
    )
    frame = frames.get(int(row[6])) if math.isfinite(row[6]) else None
    if frame is None:
        return "in no frame that is known"
    if frame != _FRD:
        return VelocitySample(t_s, velocity, (a, b, c), in_body=frame == _BODY)
    w, x, y, z = row[7:11]
    attitude = normalised((w, -x, -y, -z))  # the heading of its frame is anything: back to the body
    if attitude is None:
        return "no attitude in its frame"
    widest = max(a, b, c)
    return VelocitySample(t_s, rotated(attitude, velocity), (widest, widest, widest), in_body=True)
