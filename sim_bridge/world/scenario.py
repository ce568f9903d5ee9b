"""What a simulated run is made of: vehicles, their sensors, and what goes wrong when."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from agent.sensing.frames import FleetFrame, normal_gravity_mps2
from sim_bridge.autopilot.link_faults import LinkQuality
from sim_bridge.companions.target_camera import CameraTable
from sim_bridge.faults.fault_tables import FaultTable, about
from sim_bridge.world.guidance import Path, Point, peak_accel_mps2
from sim_bridge.world.noise import FlavourName, ProfileName
from sim_bridge.world.world import STEP_RATE_HZ


class ScenarioError(ValueError):
    """A scenario that cannot be flown; the message names the key, what was expected and what was found."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle. A start that is absent is drawn; ``path`` absent is the studies' reference."""

    agent: int
    flavour: FlavourName = "px4"
    system_id: int = 1
    path: Path | None = None
    start_m: Point | None = None
    start_velocity_mps: Point | None = None
    yaw_rad: float = 0.0
    gps_antenna_m: Point = (0.0, 0.0, 0.0)
    """From the IMU in body axes, as the tags of its UWB module are."""
    uwb_tags_m: tuple[Point, ...] = ((0.0, 0.0, 0.0),)
    on_ground: bool = False
    clock_skew_ppm: float = 0.0
    """How much faster than true its boot clock runs."""
    stamp_quantum_us: int = 1
    """Stamps are whole multiples of this; 1000 for boards that count milliseconds."""
    gps_time_unknown: bool = False
    """GPS stamps are zero, as a PX4 sends them while it has no UTC."""
    link: LinkQuality = field(default_factory=LinkQuality)
    """Of the wire between autopilot and daemon, both ways."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Seconds since the start during which something is wrong with one agent."""

    agent: int
    from_s: float
    to_s: float

    def holds(self, time_s: float) -> bool:
        """Whether the time lies inside, the end excluded."""
        return self.from_s <= time_s < self.to_s


@dataclass(frozen=True, slots=True)
class Reboot:
    """An autopilot restarts: silent for ``down_s``, then its boot clock begins at zero."""

    agent: int
    at_s: float
    down_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """A whole run. Times count from its start; ``edges`` absent means that all pairs range each other."""

    vehicles: tuple[Vehicle, ...]
    frame: FleetFrame
    seed: int = 1
    profile: ProfileName = "paper"
    period_s: float = 0.1
    epoch_unix_s: float = 0.0
    edges: tuple[tuple[int, int], ...] | None = None
    anchors: tuple[tuple[int, Point], ...] = ()
    """Ids and places, NED, of modules that all vehicles range."""
    targets: tuple[tuple[int, Path], ...] = ()
    """Ids and paths of bodies that are no part of the fleet."""
    ranged_targets: bool = True
    """Whether all vehicles range them."""
    gravity_mps2: float | None = None
    """Absent: normal gravity at the origin."""
    imu_hz: float = 100.0
    """Sensors' own rates: a stream gives at most these."""
    attitude_hz: float = 50.0
    gps_hz: float = 10.0
    uwb_hz: float = 10.0
    uwb_staggered: bool = False
    """Observers take turns within a cycle instead of all ranging at once."""
    uwb_reach_m: float = math.inf
    uwb_calibrated: bool = True
    """False: pairs have the bias of modules as delivered, 0.3 m on average."""
    odometry_hz: float = 0.0
    """Rate at which a camera of each vehicle tells its velocity; 0 = there are none."""
    cameras: tuple[CameraTable, ...] = ()
    """Of vehicles that detect targets."""
    gps_speed: Literal["horizontal", "norm"] = "horizontal"
    """What GPS_RAW_INT.vel holds: ground speed, as receivers have it, or the velocity's norm (the paper)."""
    fusing: bool = False
    """Autopilots navigate as the firmware does, and vehicles fly by that."""
    max_accel_mps2: float = 2.0
    yaw_rate_radps: float = 0.0
    """All vehicles turn at it."""
    start_position_half_width_m: float = 15.0
    """Starts are drawn from a cube of this half width about the begin of the path."""
    start_speed_half_width_mps: float = 2.0
    gps_outages: tuple[Interval, ...] = ()
    faults: tuple[FaultTable, ...] = ()
    """Injected ones; those of members are left to who flies the agents."""
    reboots: tuple[Reboot, ...] = ()
    silences: tuple[Interval, ...] = ()
    """An autopilot's link is dead."""
    ground_d_m: float = 0.0
    """Where vehicles land."""
    truth_hz: float = 50.0
    ids: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", tuple(vehicle.agent for vehicle in self.vehicles))
        self._check_ids()
        self._check_rates()
        self._check_paths()

    def _check_ids(self) -> None:
        if not self.ids:
            raise ScenarioError("scenario: vehicles: expected at least one, found none")
        for what, values in (
            ("agent", self.ids),
            ("system_id", tuple(vehicle.system_id for vehicle in self.vehicles)),
        ):
            if len(set(values)) != len(values):
                raise ScenarioError(f"scenario: vehicles: expected a distinct {what} for each, found {list(values)}")
        for vehicle in self.vehicles:
            if not 1 <= vehicle.system_id <= 255:
                raise ScenarioError(
                    f"scenario: agent {vehicle.agent}: system_id: expected 1..255, found {vehicle.system_id}"
                )
            if vehicle.stamp_quantum_us < 1:
                raise ScenarioError(
                    f"scenario: agent {vehicle.agent}: stamp_quantum_us: expected at least 1, "
                    f"found {vehicle.stamp_quantum_us}"
                )
        self._check_known("edges", (agent for edge in self.edges or () for agent in edge))
        self._check_known("gps_outages", (outage.agent for outage in self.gps_outages))
        self._check_known("cameras", (camera.agent for camera in self.cameras))
        self._check_known("faults", (agent for fault in self.faults for agent in about(fault)))
        self._check_known("reboots", (reboot.agent for reboot in self.reboots))
        self._check_known("silences", (silence.agent for silence in self.silences))

    def _check_known(self, key: str, agents: Iterable[int]) -> None:
        for agent in agents:
            if agent not in self.ids:
                raise ScenarioError(f"scenario: {key}: expected one of the agents {list(self.ids)}, found {agent}")

    def _check_rates(self) -> None:
        for key in ("imu_hz", "attitude_hz", "gps_hz", "uwb_hz", "truth_hz"):
            rate = getattr(self, key)
            if not 0.0 < rate <= STEP_RATE_HZ:
                raise ScenarioError(f"scenario: {key}: expected more than 0 and at most {STEP_RATE_HZ}, found {rate}")
        if not 0.0 <= self.odometry_hz <= STEP_RATE_HZ:
            raise ScenarioError(
                f"scenario: odometry_hz: expected from 0 to {STEP_RATE_HZ}, found {self.odometry_hz}"
            )
        if not (math.isfinite(self.period_s) and self.period_s > 0.0):
            raise ScenarioError(f"scenario: period_s: expected a positive number, found {self.period_s}")

    def _check_paths(self) -> None:
        for vehicle in self.vehicles:
            if vehicle.path is None:
                continue
            needed = peak_accel_mps2(vehicle.path)
            if needed > self.max_accel_mps2:
                raise ScenarioError(
                    f"scenario: agent {vehicle.agent}: path: expected one that needs at most "
                    f"{self.max_accel_mps2} m/s2 per axis, found {needed:.2f} m/s2"
                )

    @property
    def gravity(self) -> float:
        """Gravity of this world in m/s^2, pointing down."""
        if self.gravity_mps2 is not None:
            return self.gravity_mps2
        return normal_gravity_mps2(self.frame.lat_deg, self.frame.alt_m)

    def slot(self, agent: int) -> int:
        """Place of an agent in the order of the vehicles."""
        return self.ids.index(agent)

    def ranged_by(self, agent: int) -> tuple[int, ...]:
        """Whom an agent ranges, in the order of the vehicles."""
        if self.edges is None:
            return tuple(other for other in self.ids if other != agent)
        joined = {b if a == agent else a for a, b in self.edges if agent in (a, b)}
        return tuple(other for other in self.ids if other in joined and other != agent)
