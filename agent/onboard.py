"""One drone, sans-I/O: whatever reaches it goes in with its instant, whatever it wants done comes out as a value.

The daemon, the fleets in virtual time, the replays, the studies and the tests drive this very class. It owns the
MAVLink session, the timeline, the UWB intake, the mailbox (opening, sealing) and the core with its estimator::

    autopilot --bytes--> on_mavlink ----.                          .--> ToAutopilot   frames for its link
    UWB module --frame--> on_uwb -------+--> advance, when due ----+--> Send          packets for the neighbours
    neighbours --packet--> on_packet ---'   (`next_due_host_s`)    +--> EstimateReady, HealthChanged, ...

What comes in is noted in a journal if there is one. Nothing else has an effect, so the same calls give the same
estimates, bit by bit. Instants are ``host_s``, the monotonic clock; fleet time follows from it and the fleet clock.
"""

from __future__ import annotations

import math
from collections import Counter

from agent.config.agreement import shared_settings
from agent.config.endpoints import LinkKind, parse_endpoint
from agent.config.tables import FleetConfig
from agent.core import AgentCore, EstimatorFactory
from agent.feedback.feeder import FedAutopilot, Feeder, Ready
from agent.inputs import Due, Gone, HouseKept, Input, Journal, MavlinkIn, PacketIn, Served, UwbIn
from agent.mavlink.codec import mavlink
from agent.mavlink.session import AutopilotSession, LinkState
from agent.mavlink.signing import LinkSigning
from agent.mavlink.slow_streams import slow_findings
from agent.outputs import (
    ClockStepped,
    CoreOutput,
    EstimateReady,
    Faulted,
    LinkChanged,
    NotSent,
    Output,
    Send,
    Tell,
    ToAutopilot,
)
from agent.sensing.clock import FleetClock, clock_fault, step_fault
from agent.sensing.detections import DetectionAdapter
from agent.sensing.frames import gravity_mps2
from agent.sensing.samples import Sample
from agent.sensing.timeline import Timeline
from agent.uwb.adapter import UwbAdapter
from agent.watch.agreement_watch import AgreementWatch
from agent.watch.health import State
from agent.watch.position_watch import clock_finding
from estimators.integrity.finding import Finding
from estimators.model.layout import block
from transport.errors import EncodeError, Rejected
from transport.messages.agreement_body import Agreement, agreement_hash
from transport.messages.clock_body import ClockAnswer, decode_clock_question
from transport.messages.detection_body import is_detection_frame
from transport.messages.uwb_body import UwbFrame
from transport.security.auth import Identity
from transport.security.opening import Opener
from transport.security.sealing import Message, Sealer

SERVICE_PERIOD_S = 0.05
"""How often the autopilot's link is looked after: heartbeats, TIMESYNC, rates, answers."""
SYSTEM_STATUS = {
    State.INIT: mavlink.MAV_STATE_BOOT,
    State.ALIGNING: mavlink.MAV_STATE_STANDBY,
    State.OK: mavlink.MAV_STATE_ACTIVE,
    State.DEGRADED: mavlink.MAV_STATE_CRITICAL,
    State.FAULT: None,  # a component that is at fault sends no heartbeat
}


class OnboardAgent:
    """One drone's agent.

    The parts (``core``, ``autopilot``, ``opener``, ...) are there to be looked at; a step of the system's clock
    brings a new core. ``unsent`` counts messages that could not be encoded, by their type.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        make_estimator: EstimatorFactory,
        identity: Identity,
        *,
        unix_s: float,
        host_s: float,
        link_signing: LinkSigning | None = None,
        journal: Journal | None = None,
        linked: bool = True,
        recorded: bool = False,
    ) -> None:
        """``unix_s`` and ``host_s`` are one instant on the two clocks; ``link_signing`` is of the autopilot's link.

        ``linked``: whether there is such a link; without one samples come ready made (`on_sample`), as from a log.
        ``recorded``: whether packets come from a flight log; they may be of an earlier version then, and were sent by
        drones that agreed about what the log's own configuration said, not that of the replay.
        Raises ``ValueError`` for a journal without a link.
        """
        if journal is not None and not linked:
            raise ValueError("a journal takes down bytes, and there are none without the autopilot's link")
        self.agent_id = agent_id
        self._config = config
        self._make_estimator = make_estimator
        self._journal = journal
        self._linked = linked
        self.clock = FleetClock(config.fleet.epoch_unix_s, unix_s=unix_s, host_s=host_s)
        self.core = self._new_core()
        kind = parse_endpoint(config.agent(agent_id).mavlink).kind
        datagrams = kind in (LinkKind.UDP_IN, LinkKind.UDP_OUT)
        self.autopilot = AutopilotSession(config, agent_id, self.clock, datagrams=datagrams, signing=link_signing)
        antennas = {agent.id: len(agent.uwb_tags_m) for agent in config.agents if agent.uwb_tags_m}
        antennas |= dict.fromkeys(config.places_m, 1)
        self.detections = DetectionAdapter(agent_id, config.kinds)
        self.uwb = UwbAdapter(agent_id, (*config.bodies, *config.places_m), config.sensors, antennas)
        shared = shared_settings(config)
        self.opener = Opener(
            config.fleet.name,
            config.ids,
            identity.trust,
            own_id=agent_id,
            bodies=config.bodies,
            freshness_s=config.security.freshness_s,
            agreement=None if recorded else agreement_hash(shared),
            recorded=recorded,
        )
        self.agreement = AgreementWatch(shared, self.opener.peers, agent_id)
        self.sealer = Sealer(
            config.fleet.name,
            agent_id,
            boot=identity.boot,
            signing=identity.signing,
            agreement=agreement_hash(shared),
        )
        self.unsent: Counter[str] = Counter()
        self.feeder = Feeder(config, agent_id) if linked and config.feeds(agent_id) else None
        """What gives the autopilot the estimate, where that is asked for."""
        if self.feeder is not None:
            self.autopilot.follower = self.feeder.on_message
        self._cores = 1
        """How many cores there have been."""
        self._told_by_shell: tuple[Finding, ...] = ()
        self._told_state = LinkState.SEARCHING
        self._serve_s = -math.inf if linked else math.inf
        """When the autopilot's link is to be served next, host time."""
        self._something_came = True
        """Whether the core has anything new since it last did what was due."""
        self._look_around(host_s)

    def fleet_s(self, host_s: float) -> float:
        """Fleet time of a host time."""
        return self.clock.fleet_s(host_s)

    def unix_s(self, host_s: float) -> float:
        """UTC of a host time, as the fleet clock has it: without the jitter of the system's."""
        return self.fleet_s(host_s) + self._config.fleet.epoch_unix_s

    def next_due_host_s(self) -> float:
        """When `advance` has something to do even if nothing comes in; minus infinity at the start."""
        due_s = self.core.next_due_s()
        if due_s is None or self._something_came:
            return -math.inf
        return min(due_s - self.clock.offset_s, self._serve_s)

    @property
    def link_state(self) -> LinkState:
        """How the autopilot's link is; without one, samples are connected by definition."""
        return self.autopilot.state if self._linked else LinkState.CONNECTED

    @property
    def link_told(self) -> str:
        """The same in words."""
        return self.autopilot.told if self._linked else str(LinkState.CONNECTED)

    # --- what comes in --------------------------------------------------------------------------------------

    def on_mavlink(self, data: bytes, host_s: float) -> bool:
        """Bytes of the autopilot's link; whether its system sent them (a stranger's must not draw our answers)."""
        session = self.autopilot
        before = session.heard
        samples = session.receive(data, host_s)
        frames = session.decoder.frames
        # What was not authentic is not noted: a replay has no key to tell it by.
        noted = data if session.signing is None else b"".join(frames)
        self._note(MavlinkIn(host_s, noted, frames), host_s)
        now_s = self.fleet_s(host_s)
        for sample in samples:
            self.core.on_sample(sample, now_s)
            if self.feeder is not None:
                self.feeder.on_sample(sample)
        return session.heard > before

    def on_sample(self, sample: Sample, host_s: float) -> None:
        """A sample that was made elsewhere, of a log or a study; no journal takes it down."""
        self.core.on_sample(sample, self.fleet_s(host_s))

    def on_uwb(self, data: bytes, host_s: float) -> None:
        """A frame of the own UWB module, or camera, that arrived at ``host_s``."""
        self._note(UwbIn(host_s, data), host_s)
        now_s = self.fleet_s(host_s)
        if is_detection_frame(data):
            for seen in self.detections.receive(data, now_s=now_s, host_s=host_s, unix_s=self.unix_s(host_s)):
                self.core.on_detection(seen, now_s)
            return
        for sample in self.uwb.receive(data, now_s=now_s, host_s=host_s, unix_s=self.unix_s(host_s)):
            self.core.on_range(sample, now_s)

    def on_uwb_frame(self, frame: UwbFrame, age_s: float, host_s: float) -> None:
        """A frame that was decoded elsewhere, measured ``age_s`` before ``host_s``; no journal takes it down."""
        now_s = self.fleet_s(host_s)
        for sample in self.uwb.samples_of(frame, age_s, now_s):
            self.core.on_range(sample, now_s)

    def on_packet(self, key: str, data: bytes, *, arrived_s: float, host_s: float, unix_ns: int) -> None:
        """A packet under a key expression: opened, and given to the core or the neighbour's clock filter."""
        self._note(PacketIn(host_s, unix_ns, arrived_s, key, data), host_s)
        self._something_came = True
        received = self.opener.open(key, data, now=host_s, unix_ns=unix_ns)
        if received is None:
            return
        if isinstance(received.message, ClockAnswer):
            self.opener.peers[received.sender].clock.add(received.message, unix_ns)
        elif isinstance(received.message, Agreement):
            self.agreement.on_told(received.sender, received.message, host_s)
            self._look_around(host_s)
        else:
            self.core.on_packet(received, self.fleet_s(host_s))

    def on_gone(self, agent_id: int, host_s: float) -> None:
        """A neighbour has left."""
        self._note(Gone(host_s, agent_id), host_s)
        self._something_came = True
        self.core.on_gone(agent_id)

    # --- what is done ---------------------------------------------------------------------------------------

    def advance(self, host_s: float) -> list[Output]:
        """Do what is due: serve the autopilot's link, work on the tick."""
        outputs: list[Output] = []
        if host_s >= self._serve_s:
            self._serve_s = host_s + SERVICE_PERIOD_S
            outputs += self._serve(host_s)
        due_s = self.core.next_due_s()
        if due_s is None or self._something_came or self.fleet_s(host_s) >= due_s:
            self._something_came = False
            outputs += self._work(host_s)
        return outputs

    def keep_house(self, *, unix_s: float, host_s: float) -> list[Output]:
        """What is to be done once a second: compare clocks and agreements, give up what is incomplete."""
        self._note(HouseKept(host_s, unix_s), host_s)
        self.opener.expire(host_s)
        stepped = self.clock.sync(unix_s=unix_s, host_s=host_s)
        if stepped:
            self.core = self._new_core(first_tick=self.core.next_tick)
            self._cores += 1
        self._look_around(host_s)
        outputs: list[Output] = [ClockStepped()] if stepped else []
        told = self.agreement.to_tell(host_s)
        if told is not None:
            outputs += self._sealed(told, self._unix_ns(host_s))
        return outputs

    def hold(self, findings: tuple[Finding, ...]) -> None:
        """What the shell has found, for the health; until it says otherwise."""
        self._told_by_shell = findings

    def tell(self, message: Message, host_s: float) -> list[Output]:
        """Send a message of the shell's own, such as what the daemon says of itself."""
        return self._sealed(message, self._unix_ns(host_s))

    def answer_clock(self, question: bytes, *, arrived_ns: int, now_ns: int) -> bytes | None:
        """The packet that answers a neighbour's question for our UTC; ``None`` for a question that is none."""
        try:
            asked_ns = decode_clock_question(question)
        except Rejected:
            self.unsent["clock question malformed"] += 1
            return None
        # Our UTC clock may be set back while we answer; an answer may not come before its question.
        answer = ClockAnswer(asked_ns, arrived_ns, max(now_ns, arrived_ns))
        return self.sealer.seal(answer, t_ns=now_ns)[0].data

    def take(self, event: Input) -> list[Output]:
        """What a recorded input brings about."""
        match event:
            case MavlinkIn():
                self.on_mavlink(event.data, event.host_s)
            case Served():
                return self._serve(event.host_s)
            case PacketIn():
                self.on_packet(
                    event.key, event.data, arrived_s=event.arrived_s, host_s=event.host_s, unix_ns=event.unix_ns
                )
            case UwbIn():
                self.on_uwb(event.data, event.host_s)
            case Gone():
                self.on_gone(event.agent, event.host_s)
            case HouseKept():
                return self.keep_house(unix_s=event.unix_s, host_s=event.host_s)
            case Due():
                return self._work(event.host_s)
        return []

    # --- common ---------------------------------------------------------------------------------------------

    def _serve(self, host_s: float) -> list[Output]:
        """What is due on the autopilot's link."""
        self._note(Served(host_s), host_s)
        frames = self.autopilot.to_send(host_s, SYSTEM_STATUS[self.core.health.health.state])
        if self.feeder is not None:
            link = self._follow(self.feeder)
            frames += [self.autopilot.encode(each) for each in self.feeder.to_send(link, host_s)]
        outputs = self._for_autopilot(frames, host_s)
        if self.autopilot.state is not self._told_state:
            self._told_state = self.autopilot.state
            outputs.append(LinkChanged(self._told_state))
        return outputs

    def _work(self, host_s: float) -> list[Output]:
        """What is due in the core; its messages are sealed."""
        self._note(Due(host_s), host_s)
        outputs: list[Output] = []
        for output in self.core.advance(self.fleet_s(host_s), self.link_told):
            outputs += self._put_out(output, host_s)
        return outputs

    def _put_out(self, output: CoreOutput, host_s: float) -> list[Output]:
        if isinstance(output, Tell):
            return self._sealed(output.message, self._unix_ns(host_s))
        if isinstance(output, EstimateReady) and self.feeder is not None:
            try:
                return [output, *self._feed(output, self.feeder, host_s)]
            except Exception as fault:  # noqa: BLE001 - counted and told; the estimate is worth more than its feed
                return [output, Faulted(fault, of_estimator=False)]
        return [output]

    def _feed(self, ready: EstimateReady, feeder: Feeder, host_s: float) -> list[Output]:
        """What the autopilot is given of an estimate."""
        session, link = self.autopilot, self._follow(feeder)
        at_host_s = ready.t_s - self.clock.offset_s
        # PX4 puts stamps on its clock itself, by our answers to its TIMESYNC; ArduPilot takes them as they are
        ahead_s = 0.0 if session.reads_stamps else host_s - at_host_s
        stamp_s = at_host_s + ahead_s if link.flavour == "px4" else session.clock.boot_s(at_host_s)
        orientation = self.core.timeline.orientation_at(ready.t_s)
        own = block(self._config.bodies.index(self.agent_id))
        offered = Ready(
            t_s=ready.t_s,
            now_s=self.fleet_s(host_s),
            unix_s=self.unix_s(at_host_s),
            mean=ready.estimate.mean[own],
            covariance=ready.estimate.covariance[own, own],
            status=ready.estimate.status,
            statement=ready.integrity,
            quaternion=None if orientation is None else orientation.quaternion,
            stamp_us=None if stamp_s is None or stamp_s < 0.0 else round(stamp_s * 1e6),
            # its own word comes before the fixes are missed
            gps_lost=session.samples.without_fix or self.core.gps_is_lost(self.fleet_s(host_s)),
            ahead_s=ahead_s,
        )
        frames = [session.encode(message) for message in feeder.on_estimate(offered, link, host_s)]
        self._look_around(host_s)
        return self._for_autopilot(frames, host_s)

    def _for_autopilot(self, frames: list[bytes], host_s: float) -> list[Output]:
        if not frames:
            return []
        if self._journal is not None:
            self._journal.note_sent(frames, self.unix_s(host_s))
        return [ToAutopilot(tuple(frames))]

    def _follow(self, feeder: Feeder) -> FedAutopilot:
        """Tell the feeder who the autopilot is, and whether anything began anew."""
        link = self._link()
        feeder.on_life(link, (self.autopilot.reboots, self.autopilot.handovers, self._cores))
        return link

    def _link(self) -> FedAutopilot:
        autopilot = self.autopilot.autopilot
        if autopilot is None:
            return FedAutopilot(False, "", 0, 0)
        connected = self.autopilot.state is LinkState.CONNECTED
        return FedAutopilot(connected, autopilot.flavour, autopilot.system_id, autopilot.component_id)

    def _sealed(self, message: Message, t_ns: int) -> list[Output]:
        """A message in packets; one that does not fit into any is counted."""
        try:
            return [Send(tuple(self.sealer.seal(message, t_ns=t_ns)), message)]
        except EncodeError as error:
            self.unsent[type(message).__name__] += 1
            return [NotSent(message, error)]

    def _unix_ns(self, host_s: float) -> int:
        return round(self.unix_s(host_s) * 1e9)

    def _note(self, event: Input, host_s: float) -> None:
        if self._journal is not None:
            self._journal.note(event, self.unix_s(host_s))

    def _look_around(self, host_s: float) -> None:
        """Say in the health why we reach nobody, as the tick fits no packet, or why others do not reach us."""
        fault = clock_fault(self._config.fleet, self.unix_s(host_s)) or step_fault(self.clock)
        fed = () if self.feeder is None else self.feeder.findings()
        slow = slow_findings(self.autopilot.slow_streams())
        held = (*clock_finding(fault), *self.agreement.observe(host_s), *fed, *self._told_by_shell, *slow)
        self.core.health.hold(held)

    def _new_core(self, first_tick: int | None = None) -> AgentCore:
        """A core that begins now, but not before a tick: after a step back of the clock none comes twice."""
        period_s = self._config.fleet.period_s
        timeline = Timeline(period_s, gravity_mps2(self._config), self._config.sensors)
        return AgentCore(self._config, self.agent_id, self._make_estimator, timeline, first_tick)
