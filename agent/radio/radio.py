"""The daemon's side of the transport: puts packets on the air, injects configured faults, watches presence.

Packets come sealed from `agent.onboard`, and are handed on to it as they came; here they are encrypted and decrypted
where the fleet encrypts.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from agent.config.tables import FleetConfig
from agent.fleet.neighbourhood import is_limited
from agent.radio.radio_faults import channel_settings
from agent.radio.security import agent_session, credentials, expiry_warnings, new_salt
from agent.radio.session_watch import SessionWatch
from transport.errors import Rejected, RejectionCounter, SessionError
from transport.link.channel import Channel, ChannelSettings
from transport.link.session import Handlers, Session, open_session
from transport.link.streams import Stream, key_expression, parse_key
from transport.messages.clock_body import check_echo, encode_clock_question
from transport.security.auth import Identity
from transport.security.sealing import Packet

LOG = logging.getLogger("fleetloc.agent")
USED_STREAMS = (Stream.MEAS, Stream.INFO, Stream.AGREE)
"""What is listened to of every neighbour; in a fleet larger than a joint state also its far field."""
REDECLARE_AFTER_S = 1.0
"""A neighbour silent for longer is told anew, as often as that, what we listen to: datagrams lose that too."""

OnPacket = Callable[[str, bytes, float, int], None]
"""(key expression, packet, arrival on the monotonic clock in s, UTC in ns that it is to be judged by)."""
OnUwb = Callable[[bytes, float], None]
"""(payload, arrival on the monotonic clock in s)."""
OnGone = Callable[[int], None]
OnClockQuestion = Callable[[bytes, int], bytes | None]
"""(question, UTC of its arrival in ns) -> the packet that answers it."""
LastHeard = Callable[[int], float | None]
"""Neighbour -> when its last authentic packet came, monotonic clock; ``None``: never."""


@dataclass(frozen=True, slots=True)
class Listener:
    """Whom the radio hands on to what comes in."""

    on_packet: OnPacket
    on_uwb: OnUwb
    on_gone: OnGone
    on_clock_question: OnClockQuestion
    last_heard_s: LastHeard


class Radio:
    """One agent's session with its neighbours; open it once, close it once.

    ``identity`` is whom the agent goes on the air as.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        base: Path,
        listener: Listener,
    ) -> None:
        """Read the keys and take the next start number; raises `SecurityError`, `KeyFileError`, `SettingsError`."""
        self._config = config
        self._agent_id = agent_id
        self._fleet = config.fleet.name
        self._neighbours = config.neighbours(agent_id)
        self._listener = listener
        own = credentials(config, agent_id, base, unix_s=time.time(), salt=new_salt())
        for warning in expiry_warnings(config, agent_id, base, unix_s=time.time()):
            LOG.warning("agent %d: %s", agent_id, warning)
        self.identity = Identity(own.signing, own.trust, own.boot)
        self._envelopes, self._uwb_seal = own.envelopes, own.uwb_seal
        self._settings = agent_session(config, agent_id, base)
        self._channel: Channel[tuple[str, bytes, float]] = Channel.seeded(
            self._faults(None), seed=config.transport.seed, receiver=agent_id, neighbours=self._neighbours
        )
        self._flying = False
        self._opened_s = 0.0
        self._watch = SessionWatch(frozenset(each for each in self._neighbours if each > agent_id))
        self._anew: asyncio.Task[None] | None = None
        self._opened_anew = 0
        self._lost = 0, 0
        """Of the sessions before this one: what they failed to send, and shed."""
        self._redeclared = 0
        self._timer: asyncio.TimerHandle | None = None
        self._repair: asyncio.TimerHandle | None = None
        self._session: Session | None = None
        self._rejections = RejectionCounter()
        self._uwb_rejections = RejectionCounter()

    async def open(self) -> None:
        """Open the session, listen to the neighbours, then show that we are there; raises `SessionError`."""
        self._session = await self._connected()
        self._look_later()

    async def _connected(self) -> Session:
        handlers = Handlers(self._on_sample, self._on_presence, self._on_clock_question)
        session = await open_session(self._settings, self._fleet, self._agent_id, self._config.ids, handlers)
        self._opened_s = time.monotonic()
        session.subscribe(self._agent_id, (Stream.UWB,))
        for neighbour in self._neighbours:
            session.subscribe(neighbour, (*USED_STREAMS, Stream.FAR) if is_limited(self._config) else USED_STREAMS)
        session.announce()
        return session

    async def close(self) -> None:
        """Leave; neighbours see it at once."""
        for timer in (self._timer, self._repair):
            if timer is not None:
                timer.cancel()
        if self._anew is not None:
            self._anew.cancel()
            await asyncio.gather(self._anew, return_exceptions=True)
        if self._session is not None and not await self._session.close():
            LOG.warning("agent %d: Zenoh does not let go of its links; not waited for", self._agent_id)

    def send(self, packets: Iterable[Packet]) -> None:
        """Put packets out, each on its stream; nothing while the session is not open."""
        if self._session is None:
            return
        for packet in packets:
            self._session.publish(packet.stream, self._enclosed(packet.stream, packet.data))

    def _enclosed(self, stream: Stream, data: bytes) -> bytes:
        """A packet as it crosses the link: encrypted where the fleet encrypts."""
        if self._envelopes is None:
            return data
        return self._envelopes.close(key_expression(self._fleet, self._agent_id, stream), data)

    def counters(self) -> dict[str, int]:
        """What this side counts."""
        session = self._session
        counts = {
            "packets unsent": self._lost[0] + (session.failed if session else 0),
            "packets shed": self._lost[1] + (session.shed if session else 0),
            "injected losses": sum(self._channel.lost.values()),
            "subscriptions repeated": self._redeclared,
            "sessions opened anew": self._opened_anew,
        }
        counts |= {f"rejected {reason}": count for reason, count in self._rejections.as_dict().items()}
        return counts | {f"rejected uwb {reason}": count for reason, count in self._uwb_rejections.as_dict().items()}

    async def ask_clocks(self) -> None:
        """Measure the offset of each neighbour's clock once."""
        if self._session is not None:
            await asyncio.gather(*(self._ask_clock(self._session, other) for other in self._neighbours))

    async def _ask_clock(self, session: Session, agent_id: int) -> None:
        asked_ns = time.time_ns()
        answer = await session.ask_clock(agent_id, encode_clock_question(asked_ns))
        if answer is None:
            return
        packet, arrived_ns = answer
        key = key_expression(self._fleet, agent_id, Stream.CLOCK)
        self._hand_on(key, packet, time.monotonic(), arrived_ns, asked_ns)

    def _on_clock_question(self, question: bytes, arrived_ns: int) -> bytes | None:
        answer = self._listener.on_clock_question(question, arrived_ns)
        return None if answer is None else self._enclosed(Stream.CLOCK, answer)

    def _on_sample(self, key: str, payload: bytes, arrived_s: float) -> None:
        parsed = parse_key(key)
        if parsed is None:
            return  # not one of the keys that were subscribed to
        _, sender, stream = parsed
        if stream is Stream.UWB:
            self._take_uwb(key, payload, arrived_s)
            return
        self._channel.offer(sender, (key, payload, arrived_s), arrived_s)
        self._deliver()

    def _take_uwb(self, key: str, payload: bytes, arrived_s: float) -> None:
        """Hand on a frame; where links are open to strangers, only one that our own driver sealed."""
        if self._uwb_seal is not None:
            try:
                payload = self._uwb_seal.open(key, payload)
            except Rejected as rejected:
                first = not self._uwb_rejections[rejected.reason]
                self._uwb_rejections.count(rejected.reason)
                LOG.log(logging.WARNING if first else logging.DEBUG, "agent %d: %s", self._agent_id, rejected)
                return
        self._listener.on_uwb(payload, arrived_s)

    def begin_flight(self, host_s: float) -> None:
        """The autopilot was heard: from the first such instant on count the times of injected outages."""
        if not self._flying:
            self._channel.change(self._faults(host_s))
        self._flying = True

    def _faults(self, began_s: float | None) -> ChannelSettings:
        transport = self._config.transport
        return channel_settings(
            transport.faults,
            self._agent_id,
            loss=transport.loss,
            delay_s=transport.delay_s,
            delay_jitter_s=transport.delay_jitter_s,
            began_s=began_s,
        )

    def _look_later(self) -> None:
        self._repair = asyncio.get_running_loop().call_later(REDECLARE_AFTER_S, self._look_after)

    def _look_after(self) -> None:
        """What silent neighbours call for: what we listen to once more, or a new session."""
        self._look_later()
        if self._session is None:
            return  # about to be opened anew
        now_s = time.monotonic()
        heard = {each: at_s for each in self._neighbours if (at_s := self._listener.last_heard_s(each)) is not None}
        if self._watch.is_due(now_s, {each: max(at_s, self._opened_s) for each, at_s in heard.items()}):
            self._anew = asyncio.get_running_loop().create_task(self._open_anew(self._session))
            return
        self._redeclare(now_s, heard)

    def _redeclare(self, now_s: float, heard: dict[int, float]) -> None:
        """Tell silent neighbours again what we listen to.

        Zenoh tells a neighbour once per link, and a datagram that is lost is not repeated: it would send us nothing
        as long as the link lives.
        """
        for neighbour in self._neighbours:
            at_s = max(heard.get(neighbour, self._opened_s), self._opened_s)
            if self._session is not None and at_s < now_s - REDECLARE_AFTER_S:
                self._session.resubscribe(neighbour)
                self._redeclared += 1

    async def _open_anew(self, deaf: Session) -> None:
        """Leave, and come back as soon as the address is free again."""
        LOG.warning("agent %d: neighbours fell silent; opening the session anew", self._agent_id)
        self._session = None
        self._lost = self._lost[0] + deaf.failed, self._lost[1] + deaf.shed
        await deaf.close()
        while True:
            try:
                self._session = await self._connected()
            except SessionError as error:  # the old one has not let go of the address yet
                LOG.debug("agent %d: %s", self._agent_id, error)
                await asyncio.sleep(REDECLARE_AFTER_S)
            else:
                self._opened_anew += 1
                return

    def _deliver(self) -> None:
        """Hand on what the channel lets through by now, and come back for what it delays."""
        now_s = time.monotonic()
        for _, (key, payload, arrived_s) in self._channel.due(now_s):
            self._hand_on(key, payload, arrived_s, time.time_ns())
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due_s = self._channel.next_due()
        if due_s is not None:
            self._timer = asyncio.get_running_loop().call_at(due_s, self._deliver)

    def _hand_on(self, key: str, payload: bytes, arrived_s: float, unix_ns: int, asked_ns: int | None = None) -> None:
        """Hand on a packet as it was sealed; with ``asked_ns`` only if it answers the question asked then."""
        try:
            if self._envelopes is not None:
                payload = self._envelopes.open(key, payload)
            if asked_ns is not None:
                check_echo(payload, asked_ns)
        except Rejected as rejected:
            self._rejections.count(rejected.reason)
            LOG.debug("agent %d: %s", self._agent_id, rejected)
            return
        self._listener.on_packet(key, payload, arrived_s, unix_ns)

    def _on_presence(self, agent_id: int, alive: bool) -> None:
        if agent_id in self._neighbours and not alive:
            LOG.info("agent %d: neighbour %d has left", self._agent_id, agent_id)
            self._listener.on_gone(agent_id)
