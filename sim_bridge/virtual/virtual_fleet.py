"""The agents of a fleet in virtual time: their timers and the radio between them, as a queue of events.

This is the shell of `agent.onboard.OnboardAgent` in virtual time, as `agent.daemon` is in real time: packets are
sealed and opened as on the radio. What feeds the sensors is somebody else's: the simulated world
(`sim_bridge.virtual.fleet_lockstep`), recorded flights (`sim_bridge.replay`) or a study (`sim_bridge.studies`).
Nothing reads a clock: the same events in the same order give the same result.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, HealthChanged, Output, Send, ToAutopilot
from agent.radio.radio_faults import channel_settings
from agent.watch.diagnostics import counters_of
from sim_bridge.virtual.event_queue import EventQueue
from transport.link.channel import Channel, Outage
from transport.link.streams import Stream, key_expression
from transport.security.sealing import Message

AIR_S = 0.001
"""How long a packet takes between two agents before the configured loss and delay."""
HOUSEKEEPING_S = 1.0
HEARD_STREAMS = (Stream.MEAS, Stream.INFO, Stream.FAR, Stream.AGREE)
"""What agents listen to; estimates and diagnostics are for people."""

OnEstimate = Callable[[OnboardAgent, EstimateReady], None]
"""(agent, its estimate of a tick)."""


class Tap(Protocol):
    """Follows packets for a study; what `on_sent` returns comes back with every copy that is heard."""

    def on_sent(self, sender: int, message: Message, size_bytes: int) -> Any:
        """A packet goes on the air."""

    def on_heard(self, receiver: int, sent: Any) -> None:
        """An agent gets it, after losses and delays."""


@dataclass(frozen=True, slots=True)
class Parcel:
    """A packet on its way; ``sent`` is what the tap wants to have back."""

    sender: int
    key: str
    data: bytes
    arrived_s: float
    sent: Any = None


@dataclass(slots=True)
class VirtualDrone:
    """An agent, what it hears through, and how wrong its computer's UTC is."""

    agent: OnboardAgent
    channel: Channel[Parcel]
    utc_error_s: float = 0.0
    timer_s: float = math.inf
    """When it is to be woken next, on the queue's clock."""

    def counters(self) -> dict[str, int]:
        """Those of a daemon that have a meaning here."""
        return counters_of(self.agent) | {"injected losses": sum(self.channel.lost.values())}


def channel_of(
    config: FleetConfig, agent_id: int, *, outages: Sequence[Outage] = (), began_s: float | None = None
) -> Channel[Parcel]:
    """What ``[transport]`` does to packets for an agent, its outages counted from ``began_s``, and ``outages``."""
    transport = config.transport
    faults = channel_settings(
        transport.faults,
        agent_id,
        loss=transport.loss,
        delay_s=transport.delay_s,
        delay_jitter_s=transport.delay_jitter_s,
        began_s=began_s,
        more=outages,
    )
    return Channel.seeded(faults, seed=transport.seed, receiver=agent_id, neighbours=config.neighbours(agent_id))


class VirtualFleet:
    """The drones and the air between them; ``on_estimate`` gets every estimate in the order of their making.

    ``unix_offset_s`` is Unix time less the queue's clock; ``to_autopilot`` gets frames for an agent's autopilot,
    ``on_health`` changes of its health. ``lateness_s`` draws how much later than asked for things happen.
    """

    def __init__(
        self,
        config: FleetConfig,
        queue: EventQueue,
        on_estimate: OnEstimate,
        *,
        unix_offset_s: float,
        to_autopilot: Callable[[int, bytes], None] | None = None,
        on_health: Callable[[int, HealthChanged], None] | None = None,
        tap: Tap | None = None,
        lateness_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.drones: dict[int, VirtualDrone] = {}
        """Who is there, by agent."""
        self._config = config
        self._queue = queue
        self._on_estimate = on_estimate
        self._unix_offset_s = unix_offset_s
        self._to_autopilot = to_autopilot
        self._on_health = on_health
        self._tap = tap
        self._lateness_s = lateness_s
        self._hearers = {i: config.neighbours(i) for i in config.ids}

    def join(self, drone: VirtualDrone) -> None:
        """An agent begins."""
        self.drones[drone.agent.agent_id] = drone
        self._later(HOUSEKEEPING_S, functools.partial(self._keep_house, drone))
        self.advance(drone)

    def leave(self, agent_id: int, *, told: bool = True) -> None:
        """An agent ends: nothing wakes it or reaches it any more; its neighbours are ``told`` (liveliness)."""
        del self.drones[agent_id]
        for hearer in self._hearers[agent_id]:
            if told and hearer in self.drones:
                self.drones[hearer].agent.on_gone(agent_id, self._queue.now_s)
                self.advance(self.drones[hearer])

    def advance(self, drone: VirtualDrone) -> None:
        """Let an agent do what is due; come back when it wants to."""
        self._carry_out(drone, drone.agent.advance(self._queue.now_s))
        # a time that went through the clock's offset may come out a hair early: the agent is then asked again
        due_s = max(drone.agent.next_due_host_s(), math.nextafter(self._queue.now_s, math.inf))
        if due_s < drone.timer_s:
            drone.timer_s = due_s
            self._queue.at(due_s, lambda: self._wake(drone, due_s))

    def unix_ns(self, drone: VirtualDrone) -> int:
        """UTC as a drone's computer has it."""
        return round((self._queue.now_s + self._unix_offset_s + drone.utc_error_s) * 1e9)

    def transmit(self, sender: int, stream: Stream, data: bytes, sent: Any = None) -> None:
        """A packet goes out to all neighbours."""
        key = key_expression(self._config.fleet.name, sender, stream)
        for hearer in self._hearers[sender]:
            self._later(AIR_S, functools.partial(self._arrive, hearer, sender, key, data, sent))

    # --- events ---------------------------------------------------------------------------------------------

    def _is_there(self, drone: VirtualDrone) -> bool:
        return self.drones.get(drone.agent.agent_id) is drone

    def _later(self, after_s: float, act: Callable[[], None]) -> None:
        self._queue.at(self._queue.now_s + after_s + self._lateness_s(), act)

    def _wake(self, drone: VirtualDrone, timer_s: float) -> None:
        """A timer that an earlier one has replaced does nothing, one that a packet has overtaken is set anew."""
        if self._is_there(drone) and drone.timer_s == timer_s:
            drone.timer_s = math.inf
            self.advance(drone)

    def _carry_out(self, drone: VirtualDrone, outputs: Sequence[Output]) -> None:
        """Everything that an agent wants done is done here."""
        agent_id = drone.agent.agent_id
        for output in outputs:
            match output:
                case Send():
                    self._send(agent_id, output)
                case ToAutopilot() if self._to_autopilot is not None:
                    for frame in output.frames:
                        self._to_autopilot(agent_id, frame)
                case EstimateReady():
                    self._on_estimate(drone.agent, output)
                case HealthChanged() if self._on_health is not None:
                    self._on_health(agent_id, output)

    def _send(self, sender: int, output: Send) -> None:
        for packet in output.packets:
            sent = None if self._tap is None else self._tap.on_sent(sender, output.message, len(packet.data))
            if packet.stream in HEARD_STREAMS:
                self.transmit(sender, packet.stream, packet.data, sent)

    def _arrive(self, hearer: int, sender: int, key: str, data: bytes, sent: Any) -> None:
        receiver = self.drones.get(hearer)
        if receiver is not None:
            receiver.channel.offer(sender, Parcel(sender, key, data, self._queue.now_s, sent), self._queue.now_s)
            self._deliver(receiver)

    def _deliver(self, receiver: VirtualDrone) -> None:
        """Hand on what the channel lets through by now, and come back for what it delays."""
        if not self._is_there(receiver):
            return
        for _, parcel in receiver.channel.due(self._queue.now_s):
            receiver.agent.on_packet(
                parcel.key,
                parcel.data,
                arrived_s=parcel.arrived_s,
                host_s=self._queue.now_s,
                unix_ns=self.unix_ns(receiver),
            )
            if self._tap is not None:
                self._tap.on_heard(receiver.agent.agent_id, parcel.sent)
            self.advance(receiver)
        due_s = receiver.channel.next_due()
        if due_s is not None:
            self._queue.at(due_s, lambda: self._deliver(receiver))

    def _keep_house(self, drone: VirtualDrone) -> None:
        if not self._is_there(drone):
            return
        unix_s = self._queue.now_s + self._unix_offset_s + drone.utc_error_s
        self._carry_out(drone, drone.agent.keep_house(unix_s=unix_s, host_s=self._queue.now_s))
        self.advance(drone)
        self._later(HOUSEKEEPING_S, functools.partial(self._keep_house, drone))
