"""An MCAP file whose numbers can be plotted, and whose places a map and a 3D panel show.

==============================  =================================  ===========================================
topic                           schema
==============================  =================================  ===========================================
``/agent_001/estimate``         ``fleetloc.FleetEstimate``         as in a flight log (`agent.log.estimate_mcap`)
``/agent_001/poses``            ``foxglove.PosesInFrame``          all drones that agent 1 knows, at once
``/agent_001/sees/agent_002``   ``foxglove.PoseInFrame``           one of them, with its covariance
``/agent_001/location``         ``foxglove.LocationFix``           agent 1's estimate of itself
``/agent_001/gps``              ``foxglove.LocationFix``           its receiver's fixes; ``.../gps_ned`` in metres
``/agent_001/range/agent_002``  ``fleetloc.Range``                 ranges that agent 1 measured
``/agent_001/table``            ``fleetloc.Table``                 names and units of ``agent_001.csv``
==============================  =================================  ===========================================

Drones that are no part of an estimate are in none of its messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.log.estimate_mcap import LEVEL, POSES_FRAME, EstimateMcap, Ned, agent_key, enu, stamp
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Triple
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix
from fleetloc.export import plot_schemas as schemas

NO_COVARIANCE = [0.0] * 9


class PlotMcap:
    """One file for the estimates, fixes and ranges of several agents; all times are fleet time.

    ``start_s`` is the zero of the table's ``time_s``. Raises `LogFileError` and `OSError` where the disk refuses.
    """

    def __init__(self, path: Path, config: FleetConfig, start_s: float) -> None:
        self._agents = config.bodies
        self._frame = FleetFrame.of(config)
        self._epoch_unix_s, self._start_s = config.fleet.epoch_unix_s, start_s
        self._estimates = EstimateMcap(path, config.bodies, config.fleet.period_s, config.fleet.epoch_unix_s)
        self._table_schema = schemas.table_schema(self._agents)

    def write(self, agent_id: int, ready: EstimateReady, published_s: float) -> None:
        """What an agent estimated, in all its forms."""
        self._estimates.write(agent_id, ready, published_s)
        estimate = ready.estimate
        mean = estimate.mean.reshape(len(self._agents), STATES_PER_AGENT)
        sigma = np.sqrt(estimate.covariance.diagonal()).reshape(len(self._agents), STATES_PER_AGENT)
        absent = is_absent(estimate.age_ticks)
        line: dict[str, float] = {"time_s": ready.t_s - self._start_s, "status": int(estimate.status)}
        for slot, other in enumerate(self._agents):
            if absent[slot]:
                continue
            numbers = (*mean[slot].tolist(), *sigma[slot].tolist(), int(estimate.age_ticks[slot]))
            line |= zip(schemas.columns_of((other,)), numbers, strict=True)
            at = STATES_PER_AGENT * slot
            covariance = enu_covariance(estimate.covariance[at : at + 3, at : at + 3])
            place = mean[slot, :3].tolist()
            self._add_pose(agent_id, other, ready.t_s, published_s, place, covariance)
            if other == agent_id:
                message = self._location(ready.t_s, place, covariance)
                self._add(f"/{agent_key(agent_id)}/location", schemas.LOCATION, _LOCATION, published_s, message)
        self._add(f"/{agent_key(agent_id)}/table", schemas.TABLE, self._table_schema, published_s, line)

    def write_fix(self, agent_id: int, t_s: float, position_m: Triple, arrived_s: float) -> None:
        """A fix of an agent's receiver, NED, whose sigma is not known."""
        topic = f"/{agent_key(agent_id)}/gps"
        self._add(topic, schemas.LOCATION, _LOCATION, arrived_s, self._location(t_s, position_m, None))
        north, east, down = position_m
        numbers = {"t_s": t_s, "n_m": north, "e_m": east, "d_m": down}
        self._add(f"{topic}_ned", schemas.FIX, schemas.FIX_SCHEMA, arrived_s, numbers)

    def write_range(self, observer: int, target: int, t_s: float, range_m: float, sigma_m: float | None) -> None:
        """A range that an agent measured."""
        topic = f"/{agent_key(observer)}/range/{agent_key(target)}"
        message = {"t_s": t_s, "range_m": range_m} | ({} if sigma_m is None else {"sigma_m": sigma_m})
        self._add(topic, schemas.RANGE, schemas.RANGE_SCHEMA, t_s, message)

    def close(self) -> None:
        """Write the index and close the file."""
        self._estimates.close()

    def _add_pose(
        self, agent_id: int, other: int, t_s: float, published_s: float, place_m: list[float], covariance: list[float]
    ) -> None:
        message = {
            "timestamp": stamp(self._epoch_unix_s + t_s),
            "frame_id": POSES_FRAME,
            "pose": {"position": enu(Ned(*place_m)), "orientation": LEVEL},
            "position_covariance": covariance,
        }
        topic = f"/{agent_key(agent_id)}/sees/{agent_key(other)}"
        self._add(topic, schemas.POSE, schemas.POSE_SCHEMA, published_s, message)

    def _location(self, t_s: float, place_m: Any, covariance: list[float] | None) -> dict[str, Any]:
        north, east, down = place_m
        lat_deg, lon_deg, alt_m = self._frame.geodetic((north, east, 0.0 if math.isnan(down) else down))
        return {
            "timestamp": stamp(self._epoch_unix_s + t_s),
            "frame_id": POSES_FRAME,
            "latitude": lat_deg,
            "longitude": lon_deg,
            "altitude": alt_m,
            "position_covariance": covariance or NO_COVARIANCE,
            "position_covariance_type": schemas.COVARIANCE_KNOWN if covariance else schemas.COVARIANCE_UNKNOWN,
        }

    def _add(
        self, topic: str, schema: str, definition: dict[str, Any], at_s: float, message: Mapping[str, Any]
    ) -> None:
        file = self._estimates.file
        unix_ns = round((self._epoch_unix_s + at_s) * 1e9)
        file.add(file.channel(topic, schema, definition), unix_ns, msgspec.json.encode(message))


_LOCATION = schemas.LOCATION_SCHEMA


def enu_covariance(ned_m2: Matrix) -> list[float]:
    """A covariance ``(3, 3)`` of a place in NED as nine numbers in ENU, row by row."""
    (nn, ne, nd), (_, ee, ed), (_, _, dd) = ned_m2.tolist()
    return [ee, ne, -ed, ne, nn, -nd, -ed, -nd, dd]
