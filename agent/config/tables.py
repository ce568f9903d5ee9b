"""The tables of a fleet's configuration, one frozen struct each; `agent.config.reading` reads and checks them.

Keys carry their unit. An absent optional key means what its docstring says.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from agent.config.fields import AgentId, Fraction, LeverArm, Name, NotNegative, Point, Positive, Seed, Table
from agent.config.integrity_table import IntegrityTable
from agent.config.observer_tables import AdsbTable, LogTable, MetricsTable
from agent.config.other_tables import OtherTables
from agent.config.security_table import SecurityTable
from agent.feedback.feedback_table import FeedbackTable
from agent.radio.radio_faults import FaultsTable
from agent.radio.radio_links import LOOPBACK, RadioLink, radio_endpoints
from estimators.model.layout import BodyKind, Kinds, Layout
from estimators.settings import EstimatorSettings, default_settings
from transport.messages.uwb_body import MAX_TAGS

JOINT_BODIES = 10
"""Default of `fleet.joint_bodies`."""


class OriginTable(Table, frozen=True):
    """Geodetic origin of the fleet's NED frame."""

    lat_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    """WGS84 latitude."""
    lon_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    """WGS84 longitude."""
    alt_m: Annotated[float, msgspec.Meta(ge=-12_000, le=100_000)]
    """Its height, above what ``altitude`` says."""
    altitude: Literal["ellipsoid", "msl"] = "msl"
    """What ``alt_m`` and all heights of the fleet are above: the WGS84 ellipsoid or mean sea level."""


class FleetTable(Table, frozen=True):
    """``[fleet]``: what all agents agree on."""

    name: Name
    """Stands in topics, keys and reports; another fleet on the same radio needs another one."""
    origin: OriginTable
    """Where the fleet's NED frame has its zero; a replay takes it from the log where it is absent."""
    period_s: Annotated[float, msgspec.Meta(ge=0.02, le=10)] = 0.1
    """Length T of a tick."""
    epoch_unix_s: NotNegative = 1_767_225_600.0
    """Tick k is ``floor((t - epoch)/T)``, t the common (GNSS-disciplined) Unix time; absent = start of 2026.

    Ticks are 32 bits wide on the wire, so that the epoch must be within 13 years at 10 Hz.
    """
    edges: tuple[tuple[AgentId, AgentId], ...] | None = None
    """Who may hear and range whom, both ways; absent = neighbours are all who are heard."""
    joint_bodies: Annotated[int, msgspec.Meta(ge=2, le=999)] = JOINT_BODIES
    """Most drones of one joint state. In a larger fleet a drone estimates itself and its nearest neighbours, by hops;
    of those beyond it has what they report of themselves, once a second, with its age."""
    absent_after_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 10.0
    """A drone of which nothing was heard or measured for longer is let go; it comes back when it is located again."""


class AgentTable(Table, frozen=True):
    """``[[agents]]``: one drone."""

    id: AgentId
    """Of the drone, in packets, files and options."""
    mavlink: str
    """Address of the autopilot, e.g. ``udpin:127.0.0.1:14551`` or ``serial:/dev/ttyAMA0:921600``."""
    name: str = ""
    """For people only."""
    autopilot: Literal["px4", "ardupilot", "auto"] = "auto"
    """What flies it; auto = seen from its heartbeat."""
    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """MAVLink system id of the autopilot; absent = the agent's id (255 at most)."""
    gps_antennas_m: tuple[LeverArm, ...] = ()
    """Where the antennas of its GPS receivers are, in their order, from the IMU in body axes (front, right, down);
    absent = at the IMU."""
    uwb_tags_m: Annotated[tuple[LeverArm, ...], msgspec.Meta(max_length=MAX_TAGS)] = ()
    """Where the antennas of its UWB module are, by tag index, likewise."""
    radio: str | None = None
    """Address of this agent on the fleet's radio, IP or name; absent = its neighbours dial what it listens on."""
    listen: tuple[str, ...] | None = None
    """Zenoh endpoints of this agent besides those on the radio; absent = on loopback from ``transport.base_port``."""
    connect: tuple[str, ...] | None = None
    """Zenoh endpoints it dials; absent = those of the agents it hears that have a lower id."""


class AnchorTable(Table, frozen=True):
    """``[[anchors]]``: a UWB module that stands at a known place."""

    id: AgentId
    """Of the anchor, as drivers and files of ranges name it; no drone has it."""
    position_m: Point
    """Of its antenna, NED in the fleet frame."""


class MavlinkTable(Table, frozen=True):
    """``[mavlink]``: how the daemon behaves on the autopilot's link."""

    component_id: Annotated[int, msgspec.Meta(ge=2, le=255)] = 197
    """MAVLink component id of the daemon."""
    imu_hz: Annotated[float, msgspec.Meta(ge=1, le=1000)] = 100.0
    """Rate asked of the autopilot for acceleration and turn rate."""
    attitude_hz: Annotated[float, msgspec.Meta(ge=1, le=400)] = 50.0
    """Rate asked of the autopilot for its attitude."""
    gps_hz: Annotated[float, msgspec.Meta(ge=0.2, le=50)] = 10.0
    """Rate asked of the autopilot for fixes."""
    appear_timeout_s: NotNegative = 60.0
    """The daemon gives up if no autopilot appears within this; 0 = it waits for ever. One that was there and
    disappears never stops it."""
    heartbeat_timeout_s: Positive = 3.0
    """An autopilot silent for longer is lost."""
    end_after_lost_s: Positive | None = None
    """An autopilot lost for this long ends the daemon, its records closed: for simulated flights; absent = never."""
    signing: Literal["auto", "on", "off"] = "auto"
    """Sign frames and refuse those that are not well signed: auto = in the field profiles on all links but serial
    ones; off is refused there unless the link is serial or on loopback."""


UwbTag = Annotated[int, msgspec.Meta(ge=0, lt=MAX_TAGS)]


class UwbPair(Table, frozen=True):
    """``[[sensors.uwb_pairs]]``: what calibration found of the ranges of two drones; `fleetloc ranges` writes it."""

    pair: tuple[AgentId, AgentId]
    """Two drones, whoever measures."""
    bias_m: Annotated[float, msgspec.Meta(ge=-10, le=10)]
    """How much too long their ranges are; it is subtracted."""
    tags: tuple[UwbTag, UwbTag] | None = None
    """Between which of their antennas, in the order of ``pair``; absent = all that have no entry of their own."""
    sigma_m: Positive | None = None
    """1-sigma of a range between them whose driver gives none; absent = ``uwb_sigma_m``."""


class TargetTable(Table, frozen=True):
    """``[[targets]]``: a body that is no part of the fleet, which its drones range under this id."""

    id: AgentId
    """Of the target, in packets and files; no drone has it."""
    name: str = ""
    """For people only."""
    motion: Literal["moving", "fixed"] = "moving"
    """Whether it moves; a fixed one is an anchor whose place the fleet surveys."""


class SensorsTable(Table, frozen=True):
    """``[sensors]``: the noise and delay that the daemon assumes.

    A half width is the hard bound of a uniform noise; it sets the variance too (its square over 3).
    """

    gps_position_half_width_m: Positive | None = None
    """Per axis; absent = the receiver's own accuracy (or the HDOP rule) and no hard bound."""
    gps_speed: Literal["horizontal", "norm", "off"] = "horizontal"
    """What GPS_RAW_INT.vel is: ground speed along cog (real receivers), or the velocity's norm (paper)."""
    gps_speed_half_width_mps: Positive | None = None
    """Of the speed; absent = the receiver's own accuracy and no hard bound."""
    gps_variance_factor: Annotated[float, msgspec.Meta(ge=1)] = 1.0
    """On the receiver's own position variance. Its error wanders over a minute; an estimator that takes ten fixes
    a second for independent (no `systematic_errors`) soon trusts their mean too much, unless each counts for less."""
    gps_min_fix: Annotated[int, msgspec.Meta(ge=2, le=8)] = 3
    """Least fix type (GPS_FIX_TYPE) of a fix that is used: 3 = 3-D, 4 = DGPS, 5 = RTK float, 6 = RTK fixed."""
    geoid_separation_m: float | None = None
    """Ellipsoid minus MSL height at the origin, for receivers that send only the other one."""
    barometer: bool = True
    """Use the autopilot's barometer, where it sends one and the estimator has `systematic_errors`: it tells how the
    height changes, over minutes. Off where the drone flies in the wind of others, or indoors with doors that open."""
    odometry: bool = True
    """Use velocities of sensors other than the receiver, where a companion computer or the autopilot sends them
    (ODOMETRY, VISION_SPEED_ESTIMATE, OPTICAL_FLOW_RAD). What was made of the autopilot's own estimate never is."""
    ground_m: float | None = None
    """Altitude above the fleet's origin of the ground, where it is flat and nothing stands on it: a range finder that
    looks down (DISTANCE_SENSOR) then tells the height; absent = range finders are not used."""
    uwb_sigma_m: Positive = 0.1
    """1-sigma of a range whose driver gives none."""
    uwb_sigma_floor_m: Positive = 0.03
    """Least 1-sigma, whatever the driver claims: what calibration leaves of a pair's bias does not average out."""
    uwb_pairs: tuple[UwbPair, ...] = ()
    """What calibration found, pair by pair; others are taken as they come."""
    uwb_bound_m: Positive | None = None
    """Hard bound of a range's noise; sets its variance (bound squared over 3) where present."""
    accel_sigma_mps2: Positive = 0.1
    """1-sigma per axis of the acceleration averaged over a tick."""
    imu_max_gap_s: Positive = 0.05
    """A longer silence between IMU samples counts as a gap."""
    gravity_mps2: Positive | None = None
    """Absent = WGS84 normal gravity at the origin."""
    imu_latency_s: float | None = None
    """How much older the value is than its stamp says; absent = the autopilot's profile (docs/autopilots.md)."""
    gps_latency_s: float | None = None
    """The same of a fix; absent = the autopilot's profile, by the kind of stamp."""
    gps_latency_sigma_s: NotNegative | None = None
    """1-sigma of it; absent = the profile's, or 0 (exactly known, not estimated) where ``gps_latency_s`` is given."""
    estimate_latency: bool = True
    """Estimate the latency of GPS on line from manoeuvres, from there on; else it stays as assumed."""
    uwb_latency_s: float = 0.0
    """How much older a range is than its driver says, subtracted from its time."""


class InitialTable(Table, frozen=True):
    """``[initial]``: what an agent believes before anything is measured.

    The prior of each agent is at ``position_m``, or, where that is absent, at its first fixes.
    """

    position_m: Point | None = None
    """NED, for all agents; absent = wait for own fixes (or ranges and records of neighbours)."""
    fixes: Annotated[int, msgspec.Meta(ge=1, le=100)] = 5
    """Own GPS fixes before the estimator starts."""


class TransportTable(Table, frozen=True):
    """``[transport]``: the radio between the agents."""

    base_port: Annotated[int, msgspec.Meta(ge=1024, le=64_000)] = 17_447
    """Agent number i (from 0, in order of the file) listens on loopback at this port + i."""
    link: RadioLink = "tcp"
    """What carries packets between agents: a stream, datagrams, or both (rounds on datagrams).
    docs/links.md says which serves where; only ``tcp`` (TLS then) goes with ``security.profile = "field"``."""
    radio_port: Annotated[int, msgspec.Meta(ge=1, le=65_535)] = 7447
    """Where every agent listens at its address ``agents.radio``."""
    lease_s: Annotated[float, msgspec.Meta(ge=0.1, le=600)] = 2.0
    """Silence of a link after which neighbours consider this agent gone."""
    open_timeout_s: Annotated[float, msgspec.Meta(ge=0.1, le=600)] = 1.5
    """Longest time that a link may take to be opened before it is tried anew."""
    retry_max_s: Annotated[float, msgspec.Meta(ge=0.2, le=600)] = 2.0
    """Longest pause before a neighbour that does not answer is dialled again; from 0.2 s on they double."""
    guard_s: NotNegative = 0.01
    """A tick is closed this long after its end, when its last samples have come in."""
    exchange_fraction: Fraction = 0.3
    """Share of the period, from the tick's end, after which measurement packets of a tick count as late."""
    rounds_fraction: Fraction = 0.4
    """Share of the period that all consensus rounds together may take."""
    exchanges: Annotated[int, msgspec.Meta(ge=1, le=4)] = 4
    """Measurement packets per tick, at most. The second takes what the first ones brought a hop further at once;
    those after it are sent while a neighbour may lack a record of an earlier tick."""
    history_ticks: Annotated[int, msgspec.Meta(ge=1, le=64)] = 7
    """For how many ticks a record is sent again while a neighbour may lack it."""
    neighbour_timeout_s: Positive = 2.0
    """A neighbour silent for longer is not waited for."""
    loss: Fraction = 0.0
    """Injected after receive: probability that a packet is lost."""
    delay_s: NotNegative = 0.0
    """Injected after receive: constant delay."""
    delay_jitter_s: NotNegative = 0.0
    """Injected after receive: mean of an exponential delay on top."""
    seed: Seed = 0
    """Of what is injected."""
    faults: FaultsTable = msgspec.field(default_factory=FaultsTable)
    """What else is injected after receive."""


class RecordTable(Table, frozen=True):
    """``[record]``: flight logs on disk."""

    directory: str | None = None
    """Relative to the working folder; absent = record nothing."""
    flight: bool = True
    """Whether to write a flight log beside them: all that came in (.tlog, .mcap), so that it can be repeated."""
    flight_max_mb: Positive = 2000.0
    """Of a flight log, both files together; it ends here, the daemon goes on."""


class HealthTable(Table, frozen=True):
    """``[health]``: how a daemon answers those who look after it (`fleetloc health`)."""

    socket: str | None = None
    """Path of a UNIX socket that tells the daemon's state to whoever connects; absent = none."""


class FleetConfig(Table, frozen=True):
    """The whole configuration of a fleet."""

    fleet: FleetTable
    agents: Annotated[tuple[AgentTable, ...], msgspec.Meta(min_length=1, max_length=999)]
    anchors: Annotated[tuple[AnchorTable, ...], msgspec.Meta(max_length=999)] = ()
    estimator: EstimatorSettings = msgspec.field(default_factory=default_settings)
    sensors: SensorsTable = msgspec.field(default_factory=SensorsTable)
    initial: InitialTable = msgspec.field(default_factory=InitialTable)
    mavlink: MavlinkTable = msgspec.field(default_factory=MavlinkTable)
    transport: TransportTable = msgspec.field(default_factory=TransportTable)
    security: SecurityTable = msgspec.field(default_factory=SecurityTable)
    record: RecordTable = msgspec.field(default_factory=RecordTable)
    health: HealthTable = msgspec.field(default_factory=HealthTable)
    integrity: IntegrityTable = msgspec.field(default_factory=IntegrityTable)
    feedback: FeedbackTable = msgspec.field(default_factory=FeedbackTable)
    metrics: MetricsTable = msgspec.field(default_factory=MetricsTable)
    log: LogTable = msgspec.field(default_factory=LogTable)
    adsb: AdsbTable = msgspec.field(default_factory=AdsbTable)
    others: OtherTables = msgspec.field(default_factory=OtherTables)
    """Tables that other rooms read; no key of the file has this name."""
    targets: tuple[TargetTable, ...] = ()

    @property
    def bodies(self) -> tuple[int, ...]:
        """Ids of all bodies of the state in the order of its blocks: the drones, then the targets."""
        return (*self.ids, *(target.id for target in self.targets))

    @property
    def kinds(self) -> Kinds:
        """What the bodies are that are no drones."""
        return {t.id: BodyKind.ANCHOR if t.motion == "fixed" else BodyKind.TARGET for t in self.targets}

    @property
    def layout(self) -> Layout:
        """Of the state of all bodies."""
        return Layout.of(self.bodies, self.kinds)

    @property
    def ids(self) -> tuple[int, ...]:
        """Agent ids in the order of the file, which is the order of the state's blocks."""
        return tuple(agent.id for agent in self.agents)

    @property
    def places_m(self) -> dict[int, Point]:
        """Where the anchors are, by id."""
        return {anchor.id: anchor.position_m for anchor in self.anchors}

    def agent(self, agent_id: int) -> AgentTable:
        """The table of one agent; raises `KeyError` naming the id if it is not in the fleet."""
        for table in self.agents:
            if table.id == agent_id:
                return table
        raise KeyError(f"agent {agent_id} is not in the fleet {self.ids}")

    def feeds(self, agent_id: int) -> bool:
        """Whether an agent's autopilot is given the estimate."""
        fed = self.feedback.agents
        return self.feedback.kind != "off" and (fed is None or agent_id in fed)

    def fed_receiver(self, agent_id: int) -> int | None:
        """Which receiver of an agent's autopilot is what we give it; ``None`` if none is."""
        given = self.feeds(agent_id) and self.feedback.kind == "gps_input"
        return self.feedback.gps_id if given else None

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
        return tuple(dict.fromkeys((*self.device_endpoints(agent_id), *self._on_radio(agent_id))))

    def device_endpoints(self, agent_id: int) -> tuple[str, ...]:
        """Where a drone's own UWB driver, or an observer of the ground, dials its agent."""
        own = self.agent(agent_id).listen
        link = "tls" if self.security.profile == "field" else "tcp"
        return (f"{link}/{LOOPBACK}:{self._base_port(agent_id)}",) if own is None else own

    def connect(self, agent_id: int) -> tuple[str, ...]:
        """Zenoh endpoints an agent dials: one side of each pair does, or both would build a link."""
        own = self.agent(agent_id).connect
        if own is not None:
            return own
        lower = (other for other in self.neighbours(agent_id) if other < agent_id)
        return tuple(endpoint for other in lower for endpoint in self._on_radio(other))

    def _on_radio(self, agent_id: int) -> tuple[str, ...]:
        """What neighbours dial."""
        link, host = self.transport.link, self.agent(agent_id).radio
        if host is not None:
            secure = self.security.profile == "field"
            return radio_endpoints(link, host, self.transport.radio_port, secure=secure)
        if link == "tcp":
            return self.device_endpoints(agent_id)
        port_above_the_devices = self._base_port(agent_id) + len(self.agents)
        return radio_endpoints(link, LOOPBACK, port_above_the_devices)

    def _base_port(self, agent_id: int) -> int:
        return self.transport.base_port + self.ids.index(agent_id)
