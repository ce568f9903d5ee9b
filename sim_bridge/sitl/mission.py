"""A scripted mission: who flies where, in the fleet frame. Reading and checking; `sitl_pilot` flies it."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec

from agent.config.tables import FleetConfig
from agent.sensing.samples import Triple

OVERHEAD_S = 120.0
"""Start of the client, connections, single requests."""
Seconds = Annotated[float, msgspec.Meta(gt=0, le=36_000)]
Metres = Annotated[float, msgspec.Meta(gt=0, le=10_000)]


class MissionError(ValueError):
    """A mission that cannot be used; the message says where, what was expected and what was found."""


class DroneMission(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[drones]]``: one drone's way."""

    agent: int
    waypoints_m: Annotated[tuple[Triple, ...], msgspec.Meta(min_length=1, max_length=1000)]
    """NED in the fleet frame; down is negative above the origin."""
    hold_s: Annotated[float, msgspec.Meta(ge=0, le=36_000)] = 2.0
    """At each of them."""


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole mission; a drone of the fleet that is not in it stays on the ground."""

    drones: Annotated[tuple[DroneMission, ...], msgspec.Meta(min_length=1)]
    takeoff_m: Metres = 8.0
    """Height above home to climb to; waypoints are flown from there once everyone is up."""
    reached_m: Metres = 1.5
    """A waypoint is reached within this distance, by the autopilot's own estimate."""
    speed_mps: Annotated[float, msgspec.Meta(gt=0, le=50)] | None = None
    """Told to the autopilot before the first waypoint; absent = its own default."""
    ready_timeout_s: Seconds = 120.0
    """Arming is tried for this long: an autopilot refuses it until its filter has converged."""
    climb_timeout_s: Seconds = 60.0
    leg_timeout_s: Seconds = 90.0
    """From one waypoint to the next."""
    land_timeout_s: Seconds = 120.0

    @property
    def limit_s(self) -> float:
        """Longer than this it cannot take, whatever is waited for."""
        way_s = max(len(drone.waypoints_m) * (self.leg_timeout_s + drone.hold_s) for drone in self.drones)
        return OVERHEAD_S + 2.0 * self.ready_timeout_s + self.climb_timeout_s + way_s + 2.0 * self.land_timeout_s


def load_mission(path: Path, config: FleetConfig) -> Mission:
    """Read a mission file (TOML); raises `MissionError`."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise MissionError(f"{path}: expected a readable mission (TOML): {error.strerror or error}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MissionError(f"{path}: expected valid TOML: {error}") from error
    try:
        mission = msgspec.convert(document, Mission)
    except msgspec.ValidationError as error:
        raise MissionError(f"{path}: {error}") from error
    _check(mission, path, config)
    return mission


def _check(mission: Mission, path: Path, config: FleetConfig) -> None:
    numbers = [value for value in msgspec.structs.astuple(mission) if isinstance(value, float)]
    numbers += [value for drone in mission.drones for value in (drone.hold_s, *sum(drone.waypoints_m, ()))]
    if not all(map(math.isfinite, numbers)):
        raise MissionError(f"{path}: expected finite numbers, found nan or inf")
    seen: set[int] = set()
    for index, drone in enumerate(mission.drones):
        key = f"{path}: drones[{index}].agent"
        if drone.agent not in config.ids:
            raise MissionError(f"{key}: expected one of {', '.join(map(str, config.ids))}, found {drone.agent}")
        if drone.agent in seen:
            raise MissionError(f"{key}: expected one entry per drone, found a second one of {drone.agent}")
        seen.add(drone.agent)
        if drone.hold_s >= mission.leg_timeout_s:
            raise MissionError(
                f"{path}: drones[{index}].hold_s: expected less than leg_timeout_s, found {drone.hold_s:g}"
            )
