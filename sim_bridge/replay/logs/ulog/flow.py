"""Optical flow of PX4 logs: what the sensor integrated. Topic and fields got other names in 1.14.

``vehicle_optical_flow_vel`` is what PX4 made of it with its own height, and no measurement.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from agent.mavlink.velocities import integrated_flow
from agent.sensing.samples import FlowSample
from sim_bridge.replay.logs.ulog.samples import Timed, rows_of
from sim_bridge.replay.logs.ulog.tables import TopicTable

_SINCE_1_14 = (
    "pixel_flow[0]", "pixel_flow[1]", "delta_angle[0]", "delta_angle[1]", "integration_timespan_us", "quality",
    "distance_m",
)  # fmt: skip
_BEFORE = (
    "pixel_flow_x_integral", "pixel_flow_y_integral", "gyro_x_rate_integral", "gyro_y_rate_integral",
    "integration_timespan", "quality", "ground_distance_m",
)  # fmt: skip
FLOW_TOPICS: dict[str, tuple[str, ...]] = {
    "vehicle_optical_flow": ("timestamp_sample", *_SINCE_1_14),
    "optical_flow": ("timestamp_sample", *_BEFORE),
}
"""Fields by topic: flow and turning in rad, microseconds, 0 to 255, m."""


def flow_samples(table: TopicTable, skipped: Counter[str]) -> Iterator[Timed]:
    """The flow of a table."""
    values = table.stack(*(_SINCE_1_14 if table.name == "vehicle_optical_flow" else _BEFORE))
    if values is None:
        skipped[f"{table.name}: fields missing"] += len(table)
        return
    for arrival_s, t_s, row in rows_of(table, np.asarray(values, np.float64)):
        x, y, about_x, about_y, duration_us, quality, distance_m = row
        made = integrated_flow(t_s, 1e-6 * duration_us, (x, y), (about_x, about_y), quality, distance_m)
        if isinstance(made, FlowSample):
            yield arrival_s, made
        else:
            skipped[f"flow: {made}"] += 1
