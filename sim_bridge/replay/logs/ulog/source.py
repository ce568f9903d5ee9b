"""PX4 logs (``.ulg``): log time is the autopilot's boot time. Needs the extra ``[ulog]``."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from agent.config.tables import SensorsTable
from agent.sensing.frames import FleetFrame
from sim_bridge.replay.logs.events import (
    Format,
    GeodeticPoint,
    LogCounts,
    LogError,
    LogEvent,
    LogSurvey,
    SystemSurvey,
    UnixZero,
)
from sim_bridge.replay.logs.gps_time import RECEIVER_LATENCY_SIGMA_S, fitted, since_earliest
from sim_bridge.replay.logs.surveyed import OwnWords, SurveyedLog
from sim_bridge.replay.logs.ulog.flow import FLOW_TOPICS, flow_samples
from sim_bridge.replay.logs.ulog.odometry import FIELDS, VISUAL_ODOMETRY, odometry_samples
from sim_bridge.replay.logs.ulog.samples import (
    FIX_3D,
    GPS_TOPICS,
    WANTED,
    Timed,
    attitude_samples,
    baro_samples,
    barometer_table,
    chosen_fixes,
    degrees,
    estimate_samples,
    fixes_of,
    ground_samples,
    has_fixes,
    imu_samples,
    truth_samples,
)
from sim_bridge.replay.logs.ulog.tables import MAGIC, Tables, TopicTable, load_tables

__all__ = ["MAGIC", "UlogSource"]

UNIX_US = 10**15
TIMESYNC_SIGMA_S = 0.01


class UlogSource(SurveyedLog):
    """A `LogSource` over a PX4 log, plain or gzip. Its tables stay in memory between survey and events."""

    format: Format = "ulog"

    def __init__(
        self, path: Path, frame: FleetFrame | None, sensors: SensorsTable, ours: OwnWords = OwnWords()
    ) -> None:
        super().__init__(path, frame, sensors, ours)
        self._loaded: Tables | None = None
        self._damage: Counter[str] = Counter()

    def events(self) -> Iterator[LogEvent]:
        """The samples of all topics, merged by the time of their publication."""
        (system,) = self.survey().systems.values()
        tables, frame = self._tables(), self.frame
        counts = self.counts = LogCounts(skipped=self._damage.copy())
        skipped = counts.skipped
        streams: list[Iterator[Timed]] = []
        for name, table in tables.topics.items():
            if name == "sensor_combined":
                biases = tables.topics.get("estimator_sensor_bias")
                streams.append(imu_samples(table, biases, self._sensors, skipped))
            elif table is barometer_table(tables.topics):
                streams.append(baro_samples(table, skipped))
            elif name == "distance_sensor":
                streams.append(ground_samples(table, skipped))
            elif name == VISUAL_ODOMETRY:
                streams.append(odometry_samples(table, skipped, may_be_ours=self._ours.odometry))
            elif name in FLOW_TOPICS:
                streams.append(flow_samples(table, skipped))
            elif name == "vehicle_attitude":
                streams.append(attitude_samples(table, skipped))
            elif name == "vehicle_local_position":
                streams.append(estimate_samples(table, frame, skipped))
            elif name == "vehicle_local_position_groundtruth":
                attitude = tables.topics.get("vehicle_attitude_groundtruth")
                streams.append(truth_samples(table, attitude, frame, skipped))
        streams.append(chosen_fixes(_receivers(tables), frame, self._sensors, skipped))
        for arrival_s, sample in heapq.merge(*streams, key=_arrival):
            event = LogEvent(arrival_s, system.system_id, sample)
            counts.count(event)
            yield event

    def _tables(self) -> Tables:
        if self._loaded is None:
            self._damage.clear()
            wanted = {**WANTED, VISUAL_ODOMETRY: FIELDS, **FLOW_TOPICS}
            self._loaded = load_tables(self.path, wanted, self._damage, several=GPS_TOPICS)
        return self._loaded

    def _made_survey(self) -> LogSurvey:
        tables = self._tables()
        receivers = _receivers(tables)
        everything = [*tables.topics.values(), *receivers.values()]
        if not everything:
            raise LogError(self.path, "topics of sensors or estimates", "none that could be read")
        first_s = min(int(table.timestamp_us[0]) for table in everything) * 1e-6
        last_s = max(int(table.timestamp_us[-1]) for table in everything) * 1e-6
        system_id = tables.parameters.get("MAV_SYS_ID", 1.0)
        system_id = system_id if 1.0 <= system_id <= 255.0 else 1.0  # false for NaN as well
        local = tables.topics.get("vehicle_local_position")
        origin = None if local is None else _reference(local)
        estimate_frame: Literal["fleet", "own", "none"] = "none" if local is None else "own"
        system = SystemSurvey(
            system_id=int(system_id),
            flavour="px4",
            first_s=first_s,
            last_s=last_s,
            reboots=0,
            messages={table.name: len(table) for table in reversed(everything)},
            origin=origin,
            home=None,
            first_fix=next((point for point in map(_first_fix, receivers.values()) if point is not None), None),
            estimate_frame="fleet" if origin is not None else estimate_frame,
            truth_from=next((name for name in tables.topics if name == "vehicle_local_position_groundtruth"), None),
            receivers=tuple(number for number, table in receivers.items() if has_fixes(table)) or (0,),
        )
        return LogSurvey(_unix(tables), first_s, last_s, {system.system_id: system})


def _arrival(timed: Timed) -> float:
    return timed[0]


def _receivers(tables: Tables) -> Mapping[int, TopicTable]:
    """The receivers by the topic with most fixes: firmware logs them and the blended one, each at its own rate."""
    found = [dict(sorted(tables.instances[name].items())) for name in GPS_TOPICS if name in tables.instances]
    return max(found, key=_fixes, default={})


def _fixes(receivers: Mapping[int, TopicTable]) -> tuple[int, int]:
    """Fixes, and records, of the receiver with most."""
    return max((fixes_of(table), len(table)) for table in receivers.values())


def _reference(local: TopicTable) -> GeodeticPoint | None:
    """The first origin of the local frame."""
    where = local.stack("ref_lat", "ref_lon", "ref_alt")
    if where is None:
        return None
    usable = np.isfinite(where).all(axis=1) & (where[:, :2] != 0.0).any(axis=1)
    if "xy_global" in local.columns:
        usable &= local.columns["xy_global"].astype(bool)
    if not usable.any():
        return None
    lat_deg, lon_deg, alt_m = (float(value) for value in where[int(np.argmax(usable))])
    return GeodeticPoint(lat_deg, lon_deg, alt_m) if abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 else None


def _first_fix(gps: TopicTable) -> GeodeticPoint | None:
    if "fix_type" not in gps.columns:
        return None
    where = degrees(gps)
    if where is None:
        return None
    fixed = (gps.columns["fix_type"] >= FIX_3D) & np.isfinite(where).all(axis=1)
    if not fixed.any():
        return None
    lat_deg, lon_deg, alt_m = (float(value) for value in where[int(np.argmax(fixed)), :3])
    return GeodeticPoint(lat_deg, lon_deg, alt_m)


def _unix(tables: Tables) -> UnixZero:
    """From the receiver's UTC, else from an exchange of time with a companion whose clock is Unix time."""
    for gps in _receivers(tables).values():
        if "time_utc_usec" not in gps.columns:
            continue
        utc_us = gps.columns["time_utc_usec"]
        known = utc_us > UNIX_US
        utc_s = map(since_earliest, (utc_us[known] * 1e-6).tolist())
        pairs = list(zip((gps.timestamp_us[known] * 1e-6).tolist(), utc_s, strict=True))
        line = fitted(pairs)
        if line is not None:
            return UnixZero(line[0], math.hypot(line[2], RECEIVER_LATENCY_SIGMA_S), "gps", line[1])
    timesync = tables.topics.get("timesync_status")
    if timesync is not None and {"remote_timestamp", "observed_offset"} <= set(timesync.columns):
        unix_us = timesync.columns["remote_timestamp"]
        known = unix_us > UNIX_US
        unix_s = unix_us[known] * 1e-6
        boot_s = (unix_us[known].astype(np.int64) + timesync.columns["observed_offset"][known]) * 1e-6
        line = fitted(list(zip(boot_s.tolist(), unix_s.tolist(), strict=True)))
        if line is not None:
            return UnixZero(line[0], math.hypot(line[2], TIMESYNC_SIGMA_S), "host", line[1])
    return UnixZero(0.0, math.inf, "unknown")
