"""Schemas of the channels that viewers plot: Foxglove's own, and numbers by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

NUMBER, INTEGER, TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
STATE_COLUMNS = (
    "n_m", "e_m", "d_m", "vn_mps", "ve_mps", "vd_mps",
    "sigma_n_m", "sigma_e_m", "sigma_d_m", "sigma_vn_mps", "sigma_ve_mps", "sigma_vd_mps", "age_ticks",
)  # fmt: skip
"""Of a drone in a table of estimates; the drone's id follows after an underscore."""
COVARIANCE_UNKNOWN, COVARIANCE_KNOWN = 0, 3


def columns_of(agents: Iterable[int]) -> list[str]:
    """All columns of the drones in a table."""
    return [f"{name}_{agent}" for agent in agents for name in STATE_COLUMNS]


def described(name: str, **properties: Any) -> dict[str, Any]:
    """A JSON schema."""
    return {"title": name, "type": "object", "properties": properties}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TIME = _object(sec=INTEGER, nsec=INTEGER)
_POSE = _object(
    position=_object(**dict.fromkeys("xyz", NUMBER)), orientation=_object(**dict.fromkeys("xyzw", NUMBER))
)
_NINE = {"type": "array", "items": NUMBER, "minItems": 9, "maxItems": 9}

LOCATION = "foxglove.LocationFix"
LOCATION_SCHEMA = described(
    LOCATION,
    timestamp=_TIME, frame_id=TEXT, latitude=NUMBER, longitude=NUMBER, altitude=NUMBER,
    position_covariance=_NINE, position_covariance_type=INTEGER,
)  # fmt: skip
"""What Foxglove defines under this name (https://docs.foxglove.dev/docs/sdk/schemas/location-fix)."""
POSE = "foxglove.PoseInFrame"
POSE_SCHEMA = described(POSE, timestamp=_TIME, frame_id=TEXT, pose=_POSE, position_covariance=_NINE)
"""What Foxglove defines under this name, and the covariance of the position beside it: ENU, m2, row by row."""
RANGE = "fleetloc.Range"
RANGE_SCHEMA = described(RANGE, t_s=NUMBER, range_m=NUMBER, sigma_m=NUMBER)
FIX = "fleetloc.Fix"
FIX_SCHEMA = described(FIX, t_s=NUMBER, n_m=NUMBER, e_m=NUMBER, d_m=NUMBER)
TABLE = "fleetloc.Table"


def table_schema(agents: Iterable[int]) -> dict[str, Any]:
    """A line of the table of estimates (`agent_001.csv`), by the names of its columns."""
    return described(TABLE, time_s=NUMBER, status=INTEGER, **dict.fromkeys(columns_of(agents), NUMBER))
