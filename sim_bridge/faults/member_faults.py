"""Members that tell the others what is not so, with a good key: what they say is changed before it is sealed.

A packet cannot be changed on the air, as its signature would be bad; a liar signs what it says. The agent around the
sealer is as honest as ever and estimates as if nothing were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.config.agreement import shared_settings
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from sim_bridge.faults.fault_tables import FaultTable, MemberFault, MemberStuck, MemberWrong
from transport.messages.agreement_body import agreement_hash
from transport.messages.estimate_body import FleetEstimate
from transport.messages.information_body import STATES_PER_AGENT, Information
from transport.messages.measurement_body import Measurement, Measurements, PositionMeasurement
from transport.messages.window_body import WindowStates
from transport.security.auth import Identity
from transport.security.sealing import Message, Packet, Sealer

OfTheState = Measurements | Information | WindowStates | FleetEstimate
"""Messages with something of the fleet's state in them."""
Place = tuple[type[Message], int]
"""Kind of a message, and which of its tick it is."""


def corrupt(
    agent: OnboardAgent, config: FleetConfig, identity: Identity, faults: Sequence[FaultTable], start_unix_s: float
) -> None:
    """Let an agent that has sealed nothing yet say what the faults make of it; ``start_unix_s`` is their zero."""
    own = [fault for fault in faults if isinstance(fault, MemberFault) and agent.agent_id in fault.agents]
    if own:
        agent.sealer = CorruptSealer(config, agent.agent_id, identity, own, start_unix_s)


class CorruptSealer(Sealer):
    """Seals what faults make of the messages of one agent."""

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        identity: Identity,
        faults: Sequence[MemberFault],
        start_unix_s: float,
    ) -> None:
        agreement = agreement_hash(shared_settings(config))
        fleet, boot, signing = config.fleet.name, identity.boot, identity.signing
        super().__init__(fleet, agent_id, boot=boot, signing=signing, agreement=agreement)
        self._own_id = agent_id
        self._faults = tuple(faults)
        self._start_unix_s = start_unix_s
        self._last: dict[Place, Message] = {}
        """What is repeated: the last message of each place that was said while nothing was stuck."""

    def seal(self, message: Message, *, t_ns: int, double: bool | None = None) -> list[Packet]:
        """The packets that carry what the agent says in place of a message."""
        return super().seal(self._told(message, 1e-9 * t_ns - self._start_unix_s), t_ns=t_ns, double=double)

    def _told(self, message: Message, time_s: float) -> Message:
        stuck = False
        for fault in self._faults:
            if not fault.holds(time_s):
                continue
            if isinstance(fault, MemberWrong):
                message = _wrong(message, fault, self._own_id)
            stuck |= isinstance(fault, MemberStuck)
        if not isinstance(message, OfTheState):
            return message  # nothing of the fleet's state in it
        place = _place(message)
        if not stuck or place not in self._last:
            self._last[place] = message
        return _restamped(self._last[place], message.tick) if stuck else message


def _place(message: OfTheState) -> Place:
    match message:
        case Measurements():
            return Measurements, message.exchange
        case Information():
            return Information, message.round
        case WindowStates():
            return WindowStates, message.round
        case FleetEstimate():
            return FleetEstimate, 0


def _restamped(message: Message, tick: int) -> Message:
    """The same content as if it were of a later tick: on the wire only the header would differ."""
    match message:
        case Measurements():
            later = tick - message.tick
            records: list[Measurement] = [replace(each, tick=each.tick + later) for each in message.records]
            return replace(message, tick=tick, records=tuple(records))
        case Information() | WindowStates():
            return replace(message, tick=tick, state_tick=message.state_tick + tick - message.tick)
        case FleetEstimate():
            return replace(message, tick=tick)
    return message


def _wrong(message: Message, fault: MemberWrong, own_id: int) -> Message:
    """What a liar says in place of a message."""
    match message:
        case Measurements():
            return replace(message, records=tuple(_shifted(each, fault, own_id) for each in message.records))
        case Information():
            mean = np.linalg.solve(message.information, message.vector) + _offset(fault, message.agents, own_id)
            information = fault.variance_divisor * message.information
            return replace(message, information=information, vector=information @ mean)
        case WindowStates():
            return replace(message, path=message.path + _offset(fault, message.agents, own_id))
        case FleetEstimate():
            return replace(
                message,
                mean=message.mean + _offset(fault, message.agents, own_id),
                variance=message.variance / fault.variance_divisor,
                own_covariance=message.own_covariance / fault.variance_divisor,
            )
    return message


def _shifted(record: Measurement, fault: MemberWrong, own_id: int) -> Measurement:
    """A fix of its own is off; what it relays of others it cannot change without being found out."""
    if not isinstance(record, PositionMeasurement) or record.observer != own_id:
        return record
    north, east, down = np.add(record.position_m, fault.offset_m).tolist()
    return replace(record, position_m=(north, east, down))


def _offset(fault: MemberWrong, agents: tuple[int, ...], own_id: int) -> NDArray[np.float64]:
    """Of a state of these agents ``(6n,)``: the positions that the lie is about, all alike."""
    offset = np.zeros((len(agents), STATES_PER_AGENT))
    offset[[fault.lies_about == "fleet" or agent_id == own_id for agent_id in agents], :3] = fault.offset_m
    return offset.ravel()
