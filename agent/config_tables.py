"""The tables of a fleet's configuration, one frozen struct each; `agent.config` reads and checks them.

Keys carry their unit. An absent optional key means what its docstring says.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from estimators.settings import EstimatorSettings, default_settings

AgentId = Annotated[int, msgspec.Meta(ge=1, le=999)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Seed = Annotated[int, msgspec.Meta(ge=0)]
Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9_-]{1,32}$")]
Point = tuple[float, float, float]
"""NED metres in the fleet frame."""


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration: frozen, unknown keys refused."""


class OriginTable(Table, frozen=True):
    """Geodetic origin of the fleet's NED frame."""

    lat_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    lon_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    alt_m: Annotated[float, msgspec.Meta(ge=-500, le=20_000)]
    altitude: Literal["ellipsoid", "msl"] = "msl"
    """What ``alt_m`` and all heights of the fleet are above: the WGS84 ellipsoid or mean sea level."""


class FleetTable(Table, frozen=True):
    """``[fleet]``: what all agents agree on."""

    name: Name
    origin: OriginTable
    period_s: Annotated[float, msgspec.Meta(ge=0.02, le=10)] = 0.1
    """Length T of a tick."""
    epoch_unix_s: NotNegative = 1_767_225_600.0
    """Tick k is ``floor((t - epoch)/T)``, t the common (GNSS-disciplined) Unix time; absent = start of 2026.

    Ticks are 32 bits wide on the wire, so that the epoch must be within 13 years at 10 Hz.
    """
    edges: tuple[tuple[AgentId, AgentId], ...] | None = None
    """Who hears and ranges whom, both ways; absent = all pairs."""


class AgentTable(Table, frozen=True):
    """``[[agents]]``: one drone."""

    id: AgentId
    mavlink: str
    """Address of the autopilot, e.g. ``udpin:127.0.0.1:14551`` or ``serial:/dev/ttyAMA0:921600``."""
    name: str = ""
    """For people only."""
    autopilot: Literal["px4", "ardupilot", "auto"] = "auto"
    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """MAVLink system id of the autopilot; absent = the agent's id (255 at most)."""
    listen: tuple[str, ...] | None = None
    """Zenoh endpoints of this agent; absent = on loopback from ``transport.base_port``."""
    connect: tuple[str, ...] | None = None
    """Zenoh endpoints it dials; absent = those of the agents it hears that have a lower id."""


class MavlinkTable(Table, frozen=True):
    """``[mavlink]``: how the daemon behaves on the autopilot's link."""

    component_id: Annotated[int, msgspec.Meta(ge=2, le=255)] = 197
    imu_hz: Annotated[float, msgspec.Meta(ge=1, le=1000)] = 100.0
    attitude_hz: Annotated[float, msgspec.Meta(ge=1, le=400)] = 50.0
    gps_hz: Annotated[float, msgspec.Meta(ge=0.2, le=50)] = 10.0
    local_position_hz: Annotated[float, msgspec.Meta(ge=0, le=50)] = 2.0
    """For comparison only, never a measurement; 0 = not requested."""
    timesync_respond: Literal["auto", "on", "off"] = "auto"
    """auto = answer until another component of the link is seen answering."""
    max_rtt_s: Positive = 0.010
    """TIMESYNC exchanges slower than this (or twice the best) are not used."""
    appear_timeout_s: NotNegative = 60.0
    """The daemon gives up if no autopilot appears within this; 0 = it waits for ever. One that was there and
    disappears never stops it."""
    heartbeat_timeout_s: Positive = 3.0
    rate_floor: Fraction = 0.6
    """A stream below this share of its requested rate is requested again."""


class SensorsTable(Table, frozen=True):
    """``[sensors]``: the noise and delay that the daemon assumes.

    A half width is the hard bound of a uniform noise; it sets the variance too (its square over 3).
    """

    gps_position_half_width_m: Positive | None = None
    """Per axis; absent = the receiver's own accuracy (or the HDOP rule) and no hard bound."""
    gps_speed: Literal["horizontal", "norm", "off"] = "horizontal"
    """What GPS_RAW_INT.vel is: ground speed along cog (real receivers), or the velocity's norm (paper)."""
    gps_speed_half_width_mps: Positive | None = None
    gps_sigma_floor_m: Positive = 0.02
    gps_speed_sigma_mps: Positive = 0.3
    """Where the receiver does not report a speed accuracy."""
    gps_uere_m: Positive = 2.5
    """sigma = HDOP times this where the receiver reports no accuracy."""
    gps_variance_factor: Annotated[float, msgspec.Meta(ge=1)] = 1.0
    """On the receiver's own position variance. Its error wanders over a minute; a filter that takes ten fixes
    a second for independent soon trusts their mean too much, unless each counts for less."""
    gps_min_fix: Annotated[int, msgspec.Meta(ge=2, le=8)] = 3
    geoid_separation_m: float | None = None
    """Ellipsoid minus MSL height at the origin, for receivers that send only the other one."""
    uwb_sigma_m: Positive = 0.1
    """1-sigma of a range whose driver gives none."""
    uwb_sigma_floor_m: Positive = 0.03
    """Least 1-sigma, whatever the driver claims: what calibration leaves of a pair's bias does not average out."""
    uwb_bound_m: Positive | None = None
    """Hard bound of a range's noise; sets its variance (bound squared over 3) where present."""
    uwb_max_range_m: Positive = 2000.0
    uwb_max_age_s: Positive = 1.0
    accel_sigma_mps2: Positive = 0.1
    """1-sigma per axis of the acceleration averaged over a tick."""
    accel_gap_sigma_mps2: Positive = 1.1547
    """1-sigma of the acceleration while no IMU sample came (uniform in +-2 m/s2)."""
    imu_max_gap_s: Positive = 0.05
    """A longer silence between IMU samples counts as a gap."""
    attitude_max_age_s: Positive = 0.3
    """An IMU sample without an attitude this close is a gap too."""
    gravity_mps2: Positive | None = None
    """Absent = WGS84 normal gravity at the origin."""
    imu_latency_s: float = 0.0
    """How much older the value is than its stamp says, subtracted from it; the same below."""
    gps_latency_s: float = 0.0
    uwb_latency_s: float = 0.0


class InitialTable(Table, frozen=True):
    """``[initial]``: what an agent believes before anything is measured.

    The prior of each agent is at ``position_m``, or, where that is absent, at its first fixes.
    """

    position_m: Point | None = None
    """NED, for all agents; absent = wait for own fixes (or ranges and records of neighbours)."""
    position_sigma_m: Positive = 50.0
    """Of agents that nothing was heard of yet; own fixes narrow it by themselves."""
    speed_sigma_mps: Positive = 3.0
    """About the velocity that the first fixes show, or about zero."""
    fixes: Annotated[int, msgspec.Meta(ge=1, le=100)] = 5
    """Own GPS fixes before the estimator starts."""
    settle_s: NotNegative = 2.0
    """With own fixes: wait this long for the first records of the others."""
    max_wait_s: NotNegative = 10.0
    """Without own GPS: start from the neighbours' fixes after this long."""


class TransportTable(Table, frozen=True):
    """``[transport]``: the radio between the agents."""

    base_port: Annotated[int, msgspec.Meta(ge=1024, le=64_000)] = 17_447
    """Agent number i (from 0, in order of the file) listens on loopback at this port + i."""
    guard_s: NotNegative = 0.01
    """A tick is closed this long after its end, when its last samples have come in."""
    exchange_fraction: Fraction = 0.3
    """Share of the period, from the tick's end, after which measurement packets of a tick count as late."""
    rounds_fraction: Fraction = 0.4
    """Share of the period that all consensus rounds together may take."""
    history_ticks: Annotated[int, msgspec.Meta(ge=1, le=20)] = 4
    """Ticks of own records in each measurement packet, so that one packet repairs earlier losses."""
    neighbour_timeout_s: Positive = 2.0
    """A neighbour silent for longer is not waited for."""
    information_format: Literal["auto", "float32", "float64"] = "auto"
    """Precision of information pairs on the wire; auto = single where their conditioning allows."""
    loss: Fraction = 0.0
    """Injected after receive: probability that a packet is lost."""
    delay_s: NotNegative = 0.0
    """Injected after receive: constant delay."""
    delay_jitter_s: NotNegative = 0.0
    """Injected after receive: mean of an exponential delay on top."""
    seed: Seed = 0


class SecurityTable(Table, frozen=True):
    """``[security]``: signatures of packets. Unsigned is for the lab and has to be asked for."""

    mode: Literal["signed", "unsigned"] = "signed"
    keys: str = "keys"
    """Folder of the key files, relative to the configuration file."""
    freshness_s: Positive = 10.0
    """Packets whose sender's UTC clock differs by more are refused, which also stops replays after a restart."""


class GpsOutage(Table, frozen=True):
    """``[[sim.gps_outages]]``: one agent's receiver sees nothing for a while."""

    agent: AgentId
    from_s: NotNegative
    to_s: Positive


class WaypointsPath(Table, frozen=True, tag_field="kind", tag="waypoints"):
    """Fly to the points in turn, each held for a while."""

    agent: AgentId
    points_m: Annotated[tuple[Point, ...], msgspec.Meta(min_length=1)]
    hold_s: Positive = 10.0
    """Time from one point to the next."""
    repeat: bool = True


class CirclePath(Table, frozen=True, tag_field="kind", tag="circle"):
    """A horizontal circle, right-handed about down (clockwise from above)."""

    agent: AgentId
    center_m: Point
    radius_m: Positive = 5.0
    lap_s: Positive = 20.0
    phase_rad: float = 0.0


class FigureEightPath(Table, frozen=True, tag_field="kind", tag="figure_eight"):
    """A horizontal Lissajous eight: north at the lap's frequency, east at twice that."""

    agent: AgentId
    center_m: Point
    length_m: Positive = 10.0
    """North-south extent."""
    width_m: Positive = 5.0
    """East-west extent."""
    lap_s: Positive = 20.0
    phase_rad: float = 0.0


Path = WaypointsPath | CirclePath | FigureEightPath


class SimTable(Table, frozen=True):
    """``[sim]``: the simulated world; no agent reads it."""

    seed: Seed = 1
    profile: Literal["paper", "realistic"] = "paper"
    """Noise: the paper's uniform one, or what real sensors look like."""
    duration_s: Positive = 60.0
    imu_hz: Annotated[float, msgspec.Meta(ge=10, le=1000)] = 100.0
    attitude_hz: Annotated[float, msgspec.Meta(ge=1, le=400)] = 50.0
    gps_hz: Annotated[float, msgspec.Meta(ge=0.2, le=50)] = 10.0
    uwb_hz: Annotated[float, msgspec.Meta(ge=0.2, le=200)] = 10.0
    max_accel_mps2: Positive = 2.0
    """Commanded acceleration is clipped to this per axis."""
    start_position_half_width_m: NotNegative = 15.0
    """Starts are drawn uniformly from a cube about each path's start."""
    start_speed_half_width_mps: NotNegative = 2.0
    gps_outages: tuple[GpsOutage, ...] = ()
    paths: tuple[Path, ...] = ()
    """One per agent."""


class RecordTable(Table, frozen=True):
    """``[record]``: flight records on disk."""

    directory: str | None = None
    """Relative to the working folder; absent = record nothing."""
    max_mb: Positive = 200.0
    """Per agent; a record stops growing here; the daemon goes on."""


class FleetConfig(Table, frozen=True):
    """The whole configuration of a fleet."""

    fleet: FleetTable
    agents: Annotated[tuple[AgentTable, ...], msgspec.Meta(min_length=1, max_length=999)]
    estimator: EstimatorSettings = msgspec.field(default_factory=default_settings)
    sensors: SensorsTable = msgspec.field(default_factory=SensorsTable)
    initial: InitialTable = msgspec.field(default_factory=InitialTable)
    mavlink: MavlinkTable = msgspec.field(default_factory=MavlinkTable)
    transport: TransportTable = msgspec.field(default_factory=TransportTable)
    security: SecurityTable = msgspec.field(default_factory=SecurityTable)
    sim: SimTable = msgspec.field(default_factory=SimTable)
    record: RecordTable = msgspec.field(default_factory=RecordTable)

    @property
    def ids(self) -> tuple[int, ...]:
        """Agent ids in the order of the file, which is the order of the state's blocks."""
        return tuple(agent.id for agent in self.agents)

    def agent(self, agent_id: int) -> AgentTable:
        """The table of one agent; raises `KeyError` naming the id if it is not in the fleet."""
        for table in self.agents:
            if table.id == agent_id:
                return table
        raise KeyError(f"agent {agent_id} is not in the fleet {self.ids}")

    def system_id(self, agent_id: int) -> int:
        """MAVLink system id of an agent's autopilot."""
        return self.agent(agent_id).system_id or agent_id

    def neighbours(self, agent_id: int) -> tuple[int, ...]:
        """Ids that an agent hears and ranges, in the order of the file."""
        if self.fleet.edges is None:
            return tuple(other for other in self.ids if other != agent_id)
        joined = {a if b == agent_id else b for a, b in self.fleet.edges if agent_id in (a, b)}
        return tuple(other for other in self.ids if other in joined)

    def listen(self, agent_id: int) -> tuple[str, ...]:
        """Zenoh endpoints an agent listens on."""
        own = self.agent(agent_id).listen
        port = self.transport.base_port + self.ids.index(agent_id)
        return (f"tcp/127.0.0.1:{port}",) if own is None else own

    def connect(self, agent_id: int) -> tuple[str, ...]:
        """Zenoh endpoints an agent dials: one side of each pair does, or both would build a link."""
        own = self.agent(agent_id).connect
        if own is not None:
            return own
        lower = (other for other in self.neighbours(agent_id) if other < agent_id)
        return tuple(endpoint for other in lower for endpoint in self.listen(other))
