"""A fleet's configuration as a scenario of the simulator."""

from __future__ import annotations

from agent.config.tables import AgentTable, FleetConfig
from agent.sensing.frames import FleetFrame, gravity_mps2
from sim_bridge.world.guidance import Circle, FigureEight, Line, Path, Waypoints, standing
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.scenario import Interval, Scenario, Vehicle
from sim_bridge.world.sim_table import CirclePath, FigureEightPath, LinePath, PathTable, WaypointsPath, sim_table


def scenario_from_config(config: FleetConfig) -> Scenario:
    """The scenario that ``[sim]`` and the fleet's tables describe.

    An autopilot given as ``auto`` is a PX4. Raises `ScenarioError` for what the simulator cannot
    do, e.g. a rate above its own.
    """
    sim = sim_table(config)
    paths = {table.agent: _path(table) for table in sim.paths}
    return Scenario(
        vehicles=tuple(_vehicle(config, agent, paths.get(agent.id)) for agent in config.agents),
        frame=FleetFrame.of(config),
        seed=sim.seed,
        profile=sim.profile,
        period_s=config.fleet.period_s,
        epoch_unix_s=config.fleet.epoch_unix_s,
        edges=config.fleet.edges,
        anchors=tuple(config.places_m.items()),
        targets=tuple((t.id, paths.get(t.id) or standing(slot)) for slot, t in enumerate(config.targets)),
        ranged_targets=sim.ranged_targets,
        cameras=sim.cameras,
        gravity_mps2=gravity_mps2(config),
        gps_hz=sim.gps_hz,
        uwb_hz=sim.uwb_hz,
        odometry_hz=sim.odometry_hz,
        uwb_staggered=sim.profile != "paper",
        gps_speed="norm" if config.sensors.gps_speed == "norm" else "horizontal",
        fusing=sim.autopilots == "fusing",
        yaw_rate_radps=sim.yaw_rate_radps,
        gps_outages=tuple(Interval(o.agent, o.from_s, o.to_s) for o in sim.gps_outages),
        faults=sim.faults,
    )


def _vehicle(config: FleetConfig, agent: AgentTable, path: Path | None) -> Vehicle:
    flavour: FlavourName = "ardupilot" if agent.autopilot == "ardupilot" else "px4"
    at_imu = (0.0, 0.0, 0.0)
    return Vehicle(
        agent.id,
        flavour,
        config.system_id(agent.id),
        path,
        gps_antenna_m=next(iter(agent.gps_antennas_m), at_imu),
        uwb_tags_m=agent.uwb_tags_m or (at_imu,),
    )


def _path(table: PathTable) -> Path:
    match table:
        case WaypointsPath():
            return Waypoints(table.points_m, table.hold_s, table.repeat)
        case CirclePath():
            return Circle(table.center_m, table.radius_m, table.lap_s, table.phase_rad)
        case LinePath():
            return Line(table.start_m, table.velocity_mps, table.swing_m, table.swing_s)
        case FigureEightPath():
            return FigureEight(table.center_m, table.length_m, table.width_m, table.lap_s, table.phase_rad)
