"""The agents of a fleet in virtual time: their timers and the radio between them, as a queue of events.

What feeds their sensors is somebody else's: the simulated world (`sim_bridge.virtual.fleet_lockstep`) or recorded
flights (`sim_bridge.replay`). Nothing reads a clock: the same events in the same order give the same result.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import math
from collections.abc import Callable, Mapping

from agent.config.tables import FleetConfig
from agent.outputs import EstimateReady, Output, Send
from sim_bridge.virtual.lockstep_members import Member, Parcel
from transport.messages.estimate_body import FleetEstimate

AIR_S = 0.001
"""How long a packet takes between two agents before the configured loss and delay."""

OnEstimate = Callable[[int, EstimateReady], None]
"""(agent, its estimate of a tick)."""


class EventQueue:
    """What is to be done when; ``now_s`` is the virtual monotonic clock."""

    def __init__(self, start_s: float) -> None:
        self.now_s = start_s
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def at(self, time_s: float, act: Callable[[], None]) -> None:
        """Do something at a virtual time; what is due together is done in the order in which it was asked for."""
        heapq.heappush(self._events, (time_s, next(self._order), act))

    def run_until(self, last_s: float) -> None:
        """Do everything that is due up to a time, in order."""
        while self._events and self._events[0][0] <= last_s:
            time_s, _, act = heapq.heappop(self._events)
            self.now_s = max(self.now_s, time_s)
            act()

    def leap(self, to_s: float) -> None:
        """Set the clock forward; what was due in between is done at once, late, when the queue goes on."""
        self.now_s = max(self.now_s, to_s)


class VirtualFleet:
    """The members and the air between them; ``on_estimate`` gets every estimate in the order of their making.

    ``fleet_offset_s`` is fleet time, ``unix_offset_s`` Unix time less the queue's clock.
    """

    def __init__(
        self,
        config: FleetConfig,
        members: Mapping[int, Member],
        queue: EventQueue,
        on_estimate: OnEstimate,
        *,
        fleet_offset_s: float,
        unix_offset_s: float,
    ) -> None:
        self._members = dict(members)
        self._queue = queue
        self._on_estimate = on_estimate
        self._fleet_offset_s = fleet_offset_s
        self._unix_offset_s = unix_offset_s
        self._hearers = {i: config.neighbours(i) for i in config.ids}
        self._timers: dict[int, float] = {}
        """When each member is to be woken next, on the queue's clock."""

    @property
    def fleet_s(self) -> float:
        """Fleet time now."""
        return self._queue.now_s + self._fleet_offset_s

    def advance(self, member: Member) -> None:
        """Let a core do what is due; come back when it wants to."""
        self._put_out(member, member.core.advance(self.fleet_s))
        due_s = member.core.next_due_s()
        if due_s is not None:
            # a time that went through the offset may come out a hair early: the core then asks again
            self._set_timer(member, max(due_s - self._fleet_offset_s, math.nextafter(self._queue.now_s, math.inf)))

    def join(self, member: Member) -> None:
        """An agent begins."""
        self._members[member.agent_id] = member
        self._timers.pop(member.agent_id, None)
        self.advance(member)

    def leave(self, agent_id: int) -> None:
        """An agent ends: nothing wakes it or reaches it any more, and its neighbours are told (liveliness)."""
        del self._members[agent_id]
        for hearer in self._hearers[agent_id]:
            if hearer in self._members:
                self._members[hearer].core.on_gone(agent_id)
                self.advance(self._members[hearer])

    def _set_timer(self, member: Member, host_s: float) -> None:
        """Wake a member then, unless it will be woken before."""
        if host_s < self._timers.get(member.agent_id, math.inf):
            self._timers[member.agent_id] = host_s
            self._queue.at(host_s, lambda: self._wake(member, host_s))

    def _wake(self, member: Member, host_s: float) -> None:
        """A timer that an earlier one has replaced does nothing, one that a packet has overtaken is set anew."""
        if self._members.get(member.agent_id) is not member or self._timers.get(member.agent_id) != host_s:
            return
        del self._timers[member.agent_id]
        due_s = member.core.next_due_s()
        if due_s is None:
            return
        if due_s - self._fleet_offset_s <= math.nextafter(self._queue.now_s, math.inf):
            self.advance(member)
        else:
            self._set_timer(member, due_s - self._fleet_offset_s)

    def _put_out(self, member: Member, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, EstimateReady):
                self._on_estimate(member.agent_id, output)
            elif isinstance(output, Send) and not isinstance(output.message, FleetEstimate):
                # estimates are for people: no agent listens to them
                for parcel in member.pack(output.message, self._unix_ns):
                    self._transmit(member.agent_id, parcel)

    @property
    def _unix_ns(self) -> int:
        return round((self._queue.now_s + self._unix_offset_s) * 1e9)

    def _transmit(self, sender: int, parcel: Parcel) -> None:
        arrival_s = self._queue.now_s + AIR_S
        for hearer in self._hearers[sender]:
            self._queue.at(arrival_s, functools.partial(self._arrive, hearer, sender, parcel))

    def _arrive(self, hearer: int, sender: int, parcel: Parcel) -> None:
        receiver = self._members.get(hearer)
        if receiver is not None:
            receiver.channel.offer(sender, parcel, self._queue.now_s)
            self._deliver(receiver)

    def _deliver(self, receiver: Member) -> None:
        """Hand on what the channel lets through by now, and come back for what it delays."""
        if self._members.get(receiver.agent_id) is not receiver:
            return
        for _, parcel in receiver.channel.due(self._queue.now_s):
            received = receiver.unpack(parcel, self._queue.now_s, self._unix_ns)
            if received is not None:
                receiver.core.on_packet(received, self.fleet_s)
                self.advance(receiver)
        due_s = receiver.channel.next_due()
        if due_s is not None:
            self._queue.at(due_s, lambda: self._deliver(receiver))
