"""One drone's agent with everything around it but sockets and clocks: what the daemon drives, and the replay.

Whatever comes in passes one of the methods here with its instant, and is noted in a journal if there is one.
Nothing else has an effect, so the same calls give the same estimates, bit by bit. Instants are ``host_s``, the
monotonic clock; fleet time follows from it and the fleet clock.
"""

from __future__ import annotations

from agent.config.endpoints import LinkKind, parse_endpoint
from agent.config.tables import FleetConfig
from agent.core import AgentCore, EstimatorFactory
from agent.inputs import Due, Gone, HouseKept, Input, Journal, MavlinkIn, PacketIn, Served, UwbIn
from agent.mavlink.codec import mavlink
from agent.mavlink.session import AutopilotSession
from agent.mavlink.signing import LinkSigning
from agent.outputs import Output
from agent.sensing.clock import FleetClock, clock_fault
from agent.uwb.adapter import UwbAdapter
from agent.watch.health import State
from agent.watch.position_watch import clock_finding
from transport.messages.clock_body import ClockAnswer
from transport.security.auth import Trust
from transport.security.opening import Opener

SYSTEM_STATUS = {
    State.INIT: mavlink.MAV_STATE_BOOT,
    State.ALIGNING: mavlink.MAV_STATE_STANDBY,
    State.OK: mavlink.MAV_STATE_ACTIVE,
    State.DEGRADED: mavlink.MAV_STATE_CRITICAL,
    State.FAULT: None,  # a component that is at fault sends no heartbeat
}


class OnboardAgent:
    """The core with its MAVLink session, UWB input, opener of packets and fleet clock; sans-I/O.

    ``core`` and the other parts are there to be looked at; a step of the system's clock brings a new core.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        make_estimator: EstimatorFactory,
        trust: Trust,
        *,
        unix_s: float,
        host_s: float,
        signing: LinkSigning | None = None,
    ) -> None:
        """``unix_s`` and ``host_s`` are one instant on the two clocks; ``signing`` is of the autopilot's link."""
        self._config = config
        self._agent_id = agent_id
        self._make_estimator = make_estimator
        self.clock = FleetClock(config.fleet.epoch_unix_s, unix_s=unix_s, host_s=host_s)
        self.core = self._new_core()
        kind = parse_endpoint(config.agent(agent_id).mavlink).kind
        self.autopilot = AutopilotSession(
            config, agent_id, datagrams=kind in (LinkKind.UDP_IN, LinkKind.UDP_OUT), signing=signing
        )
        self.uwb = UwbAdapter(agent_id, config.ids, config.sensors)
        freshness_s = config.security.freshness_s
        self.opener = Opener(config.fleet.name, config.ids, trust, own_id=agent_id, freshness_s=freshness_s)
        self.journal: Journal | None = None
        """Told of every input."""
        self._look_at_clock(host_s)

    def fleet_s(self, host_s: float) -> float:
        """Fleet time of a host time."""
        return self.clock.fleet_s(host_s)

    def unix_s(self, host_s: float) -> float:
        """UTC of a host time, as the fleet clock has it: without the jitter of the system's."""
        return self.fleet_s(host_s) + self._config.fleet.epoch_unix_s

    def next_due_host_s(self) -> float | None:
        """When `advance` has something to do even if nothing comes in; ``None`` before its first call."""
        due_s = self.core.next_due_s()
        return None if due_s is None else due_s - self.clock.offset_s

    # --- what comes in --------------------------------------------------------------------------------------

    def on_mavlink(self, data: bytes, host_s: float) -> bool:
        """Bytes of the autopilot's link; whether its system sent them (a stranger's must not draw our answers)."""
        session = self.autopilot
        session.fleet_offset_s = self.clock.offset_s
        before = session.heard
        samples = session.receive(data, host_s)
        frames = session.decoder.frames
        # What was not authentic is not noted: a replay has no key to tell it by.
        noted = data if session.signing is None else b"".join(frames)
        self._note(MavlinkIn(host_s, noted, frames), host_s)
        now_s = self.fleet_s(host_s)
        for sample in samples:
            self.core.on_sample(sample, now_s)
        return session.heard > before

    def serve_autopilot(self, host_s: float) -> list[bytes]:
        """The frames to send to the autopilot now."""
        self._note(Served(host_s), host_s)
        self.autopilot.fleet_offset_s = self.clock.offset_s
        self.autopilot.system_status = SYSTEM_STATUS[self.core.health.health.state]
        frames = self.autopilot.to_send(host_s)
        self.core.autopilot_state = str(self.autopilot.state)
        if frames and self.journal is not None:
            self.journal.note_sent(frames, self.unix_s(host_s))
        return frames

    def on_packet(self, key: str, data: bytes, *, arrived_s: float, host_s: float, unix_ns: int) -> None:
        """A packet under a key expression: opened, and given to the core or the neighbour's clock filter."""
        self._note(PacketIn(host_s, unix_ns, arrived_s, key, data), host_s)
        received = self.opener.open(key, data, now=host_s, unix_ns=unix_ns)
        if received is None:
            return
        if isinstance(received.message, ClockAnswer):
            self.opener.peers[received.sender].clock.add(received.message, unix_ns)
        else:
            self.core.on_packet(received, self.fleet_s(host_s))

    def on_uwb(self, data: bytes, host_s: float) -> None:
        """A frame of the own UWB module that arrived at ``host_s``."""
        self._note(UwbIn(host_s, data), host_s)
        now_s = self.fleet_s(host_s)
        for sample in self.uwb.receive(data, now_s=now_s, host_s=host_s, unix_s=self.unix_s(host_s)):
            self.core.on_range(sample, now_s)

    def on_gone(self, agent_id: int, host_s: float) -> None:
        """A neighbour has left."""
        self._note(Gone(host_s, agent_id), host_s)
        self.core.on_gone(agent_id)

    def advance(self, host_s: float) -> list[Output]:
        """Let the core do what is due."""
        self._note(Due(host_s), host_s)
        return self.core.advance(self.fleet_s(host_s))

    def keep_house(self, *, unix_s: float, host_s: float) -> bool:
        """What is to be done once a second; true if the system's clock stepped: then the core is a new one."""
        self._note(HouseKept(host_s, unix_s), host_s)
        self.opener.expire(host_s)
        stepped = self.clock.sync(unix_s=unix_s, host_s=host_s)
        if stepped:
            self.core = self._new_core()
        self._look_at_clock(host_s)
        return stepped

    def take(self, event: Input) -> list[Output]:
        """What a recorded input brings about."""
        match event:
            case MavlinkIn():
                self.on_mavlink(event.data, event.host_s)
            case Served():
                self.serve_autopilot(event.host_s)
            case PacketIn():
                self.on_packet(
                    event.key, event.data, arrived_s=event.arrived_s, host_s=event.host_s, unix_ns=event.unix_ns
                )
            case UwbIn():
                self.on_uwb(event.data, event.host_s)
            case Gone():
                self.on_gone(event.agent, event.host_s)
            case HouseKept():
                self.keep_house(unix_s=event.unix_s, host_s=event.host_s)
            case Due():
                return self.advance(event.host_s)
        return []

    # --- common ---------------------------------------------------------------------------------------------

    def _note(self, event: Input, host_s: float) -> None:
        if self.journal is not None:
            self.journal.note(event, self.unix_s(host_s))

    def _look_at_clock(self, host_s: float) -> None:
        """An estimate whose tick fits no packet reaches nobody: say so in the health."""
        fault = clock_fault(self._config.fleet, self.unix_s(host_s))
        self.core.health.hold(clock_finding(fault))

    def _new_core(self) -> AgentCore:
        return AgentCore(self._config, self._agent_id, self._make_estimator)
