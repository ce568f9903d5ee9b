"""The ``[sim]`` table: the simulated world; no agent reads it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from agent.config.checks import unknown_ids
from agent.config.faults import Fault
from agent.config.fields import AgentId, NotNegative, Point, Positive, Seed, Table
from agent.config.reading import OtherTable
from agent.config.tables import FleetConfig
from sim_bridge.companions.target_camera import CameraTable
from sim_bridge.faults.fault_tables import FaultTable, wrong_settings


class GpsOutage(Table, frozen=True):
    """``[[sim.gps_outages]]``: one agent's receiver sees nothing for a while."""

    agent: AgentId
    """Whose receiver."""
    from_s: NotNegative
    """Since the start of the flight."""
    to_s: Positive
    """Likewise; later than ``from_s``."""


class WaypointsPath(Table, frozen=True, tag_field="kind", tag="waypoints"):
    """Fly to the points in turn, each held for a while."""

    agent: AgentId
    """Who flies it: a drone, or a target of ``[[targets]]``."""
    points_m: Annotated[tuple[Point, ...], msgspec.Meta(min_length=1)]
    """NED, the first one the start."""
    hold_s: Positive = 10.0
    """Time from one point to the next."""
    repeat: bool = True
    """From the last point to the first again; else stay there."""


class CirclePath(Table, frozen=True, tag_field="kind", tag="circle"):
    """A horizontal circle, right-handed about down (clockwise from above)."""

    agent: AgentId
    """Likewise."""
    center_m: Point
    """NED."""
    radius_m: Positive = 5.0
    """Of the circle."""
    lap_s: Positive = 20.0
    """Time of one lap."""
    phase_rad: float = 0.0
    """Where on it the flight starts."""


class FigureEightPath(Table, frozen=True, tag_field="kind", tag="figure_eight"):
    """A horizontal Lissajous eight: north at the lap's frequency, east at twice that."""

    agent: AgentId
    """Likewise."""
    center_m: Point
    """NED, where the eight crosses itself."""
    length_m: Positive = 10.0
    """North-south extent."""
    width_m: Positive = 5.0
    """East-west extent."""
    lap_s: Positive = 20.0
    """Time of one lap."""
    phase_rad: float = 0.0
    """Where on it the flight starts."""


class LinePath(Table, frozen=True, tag_field="kind", tag="line"):
    """Straight on at constant velocity, or swinging about such a line."""

    agent: AgentId
    """Likewise."""
    start_m: Point
    """NED, where the flight begins."""
    velocity_mps: Point
    """NED, along the line."""
    swing_m: Point = (0.0, 0.0, 0.0)
    """How far out it swings on each axis, NED."""
    swing_s: Positive = 60.0
    """Time of one swing to both sides."""


PathTable = WaypointsPath | CirclePath | FigureEightPath | LinePath


class SimTable(Table, frozen=True):
    """``[sim]``: the simulated world; no agent reads it."""

    seed: Seed = 1
    """Of starts and noise."""
    profile: Literal["paper", "realistic", "nom"] = "paper"
    """Noise: the paper's uniform one, what calibrated real sensors look like, or what the usual ones do."""
    duration_s: Positive = 60.0
    """Length of the flight."""
    gps_hz: Annotated[float, msgspec.Meta(ge=0.2, le=50)] = 10.0
    """Rate of the simulated receiver."""
    uwb_hz: Annotated[float, msgspec.Meta(ge=0.2, le=200)] = 10.0
    """Rate at which every pair ranges."""
    odometry_hz: Annotated[float, msgspec.Meta(ge=0, le=100)] = 0.0
    """Rate at which a camera of each drone tells its velocity (ODOMETRY of a companion); 0 = there are none."""
    ranged_targets: bool = True
    """Whether targets carry a UWB module, which all drones range."""
    uwb_module: Literal["none", "linktrack", "uci", "dwm1001", "dwm3001-cli"] = "none"
    """What measures the ranges of a live fleet: modules simulated down to their bytes, on pseudo terminals behind
    `fleetloc uwb`; or, with none, the simulator's own driver, which sends frames."""
    yaw_rate_radps: Annotated[float, msgspec.Meta(ge=-3, le=3)] = 0.0
    """At which all drones turn about the vertical."""
    autopilots: Literal["plain", "fusing"] = "plain"
    """How they navigate: by fixed gains, or by a filter that uses, refuses and loses positions as the firmware does;
    drones then fly by what it believes, and land without positions."""
    gps_outages: tuple[GpsOutage, ...] = ()
    """When which receivers see nothing."""
    faults: tuple[FaultTable, ...] = ()
    """What goes wrong with which drones when."""
    cameras: tuple[CameraTable, ...] = ()
    """Which drones have cameras that detect targets."""
    paths: tuple[PathTable, ...] = ()
    """One per drone or target. A drone without one hovers; a target without one stands still on the ground."""


def _faults(table: SimTable, config: FleetConfig) -> Iterator[Fault]:
    for index, outage in enumerate(table.gps_outages):
        key = f"sim.gps_outages[{index}]"
        yield from unknown_ids(config, f"{key}.agent", (outage.agent,))
        if outage.to_s <= outage.from_s:
            yield Fault(f"{key}.to_s", f"later than from_s = {outage.from_s:g}", f"{outage.to_s:g}")
    for index, camera in enumerate(table.cameras):
        yield from unknown_ids(config, f"sim.cameras[{index}].agent", (camera.agent,))
        if camera.agent in {other.agent for other in table.cameras[:index]}:
            yield Fault(f"sim.cameras[{index}].agent", "one camera per drone", f"a second one of {camera.agent}")
    yield from wrong_settings(table.faults, config, "sim.faults")
    if table.uwb_module != "none" and any(len(agent.uwb_tags_m) > 1 for agent in config.agents):
        yield Fault("sim.uwb_module", '"none" where a drone has several UWB tags', f'"{table.uwb_module}"')
    yield from _paths(table, config)


def _paths(table: SimTable, config: FleetConfig) -> Iterator[Fault]:
    """One per body; a target, which nothing accelerates, cannot leap between waypoints."""
    targets = {target.id for target in config.targets}
    flown: set[int] = set()
    for index, path in enumerate(table.paths):
        key = f"sim.paths[{index}]"
        if path.agent not in targets:
            yield from unknown_ids(config, f"{key}.agent", (path.agent,))
        elif isinstance(path, WaypointsPath) and len(path.points_m) > 1:
            yield Fault(f"{key}.points_m", "one point, where the target stands, or another kind of path", "several")
        if path.agent in flown:
            yield Fault(f"{key}.agent", "one path per drone or target", f"a second path of {path.agent}")
        flown.add(path.agent)


SIM = OtherTable("sim", SimTable, _faults)


def sim_table(config: FleetConfig) -> SimTable:
    """The table of a fleet's configuration, checked against its agents; raises `ConfigError`."""
    return SIM.of(config)
