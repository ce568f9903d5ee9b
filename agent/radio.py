"""The daemon's side of the transport: seals and opens packets, injects configured faults, watches presence."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from agent.config_tables import FleetConfig
from transport.auth import UNSIGNED, Signing, Trust
from transport.channel import Channel, ChannelSettings
from transport.clock_body import (
    ClockAnswer,
    decode_clock_question,
    encode_clock_question,
)
from transport.errors import EncodeError, Rejected
from transport.information_body import Information
from transport.keys import load_secret, load_trust, next_boot
from transport.opening import Opener, Received
from transport.sealing import Message, Sealer
from transport.session import Handlers, Session, open_session
from transport.session_settings import SessionSettings
from transport.streams import Stream, key_expression, parse_key

LOG = logging.getLogger("fleetloc.agent")
USED_STREAMS = (Stream.MEAS, Stream.INFO)

OnReceived = Callable[[Received], None]
OnUwb = Callable[[bytes, float], None]
"""(payload, arrival on the monotonic clock in s)."""
OnGone = Callable[[int], None]


class Radio:
    """One agent's session with its neighbours; open it once, close it once.

    Ages and deadlines here are on the monotonic clock; ``opener`` holds what is known of each peer's link.
    """

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        base: Path,
        on_received: OnReceived,
        on_uwb: OnUwb,
        on_gone: OnGone,
    ) -> None:
        """Read the keys and take the next start number; raises `KeyFileError`, `SettingsError`."""
        self._config = config
        self._agent_id = agent_id
        self._fleet = config.fleet.name
        self._neighbours = config.neighbours(agent_id)
        self._on_received, self._on_uwb, self._on_gone = on_received, on_uwb, on_gone
        signing, trust, boot = _credentials(config, agent_id, base)
        self._sealer = Sealer(self._fleet, agent_id, boot=boot, signing=signing)
        self.opener = Opener(self._fleet, config.ids, trust, own_id=agent_id, freshness_s=config.security.freshness_s)
        transport = config.transport
        faults = ChannelSettings(
            loss=transport.loss,
            delay_s=transport.delay_s,
            delay_exponential_s=transport.delay_jitter_s,
        )
        self._channel: Channel[tuple[str, bytes]] = Channel.seeded(
            faults, seed=transport.seed, receiver=agent_id, neighbours=self._neighbours
        )
        self._double = {"auto": None, "float32": False, "float64": True}[transport.information_format]
        self._timer: asyncio.TimerHandle | None = None
        self._session: Session | None = None
        self._unsent: Counter[str] = Counter()

    async def open(self) -> None:
        """Open the session, listen to the neighbours, then show that we are there; raises `SessionError`."""
        settings = SessionSettings(
            listen=self._config.listen(self._agent_id), connect=self._config.connect(self._agent_id)
        )
        handlers = Handlers(self._on_sample, self._on_presence, self._on_clock_question)
        session = await open_session(settings, self._fleet, self._agent_id, self._config.ids, handlers)
        session.subscribe(self._agent_id, (Stream.UWB,))
        for neighbour in self._neighbours:
            session.subscribe(neighbour, USED_STREAMS)
        session.announce()
        self._session = session

    async def close(self) -> None:
        """Leave; neighbours see it at once."""
        if self._timer is not None:
            self._timer.cancel()
        if self._session is not None:
            await self._session.close()

    def send(self, message: Message) -> None:
        """Seal a message and put it out; one that cannot be sent is counted."""
        if self._session is None:
            return
        try:
            double = self._double if isinstance(message, Information) else None
            packets = self._sealer.seal(message, t_ns=time.time_ns(), double=double)
        except EncodeError as error:
            self._unsent[type(message).__name__] += 1
            LOG.debug("agent %d: not sent: %s", self._agent_id, error)
            return
        for packet in packets:
            self._session.publish(packet.stream, packet.data)

    def expire(self, now_s: float) -> None:
        """Give up what is incomplete for too long; ``now_s`` monotonic. Call it once in a while."""
        self.opener.expire(now_s)

    def counters(self) -> dict[str, int]:
        """What this side counts."""
        session = self._session
        return {
            "packets sent": self._sealer.sent,
            "packets unsent": self._unsent.total() + (session.failed if session else 0),
            "packets shed": session.shed if session else 0,
            "records left out": self._sealer.left_out,
            "injected losses": sum(self._channel.lost.values()),
        }

    async def ask_clocks(self) -> None:
        """Measure the offset of each neighbour's clock once."""
        if self._session is not None:
            await asyncio.gather(*(self._ask_clock(self._session, other) for other in self._neighbours))

    async def _ask_clock(self, session: Session, agent_id: int) -> None:
        answer = await session.ask_clock(agent_id, encode_clock_question(time.time_ns()))
        if answer is None:
            return
        packet, arrived_ns = answer
        key = key_expression(self._fleet, agent_id, Stream.CLOCK)
        received = self.opener.open(key, packet, now=time.monotonic(), unix_ns=arrived_ns)
        if received is not None and isinstance(received.message, ClockAnswer):
            self.opener.peers[agent_id].clock.add(received.message, arrived_ns)

    def _on_clock_question(self, question: bytes, arrived_ns: int) -> bytes | None:
        try:
            asked_ns = decode_clock_question(question)
        except Rejected:
            self._unsent["clock question malformed"] += 1
            return None
        now_ns = time.time_ns()
        # Our UTC clock may be set back while we answer; an answer may not come before its question.
        answer = ClockAnswer(asked_ns, arrived_ns, max(now_ns, arrived_ns))
        return self._sealer.seal(answer, t_ns=now_ns)[0].data

    def _on_sample(self, key: str, payload: bytes, arrived_s: float) -> None:
        parsed = parse_key(key)
        if parsed is None:
            return  # not one of the keys that were subscribed to
        _, sender, stream = parsed
        if stream is Stream.UWB:
            self._on_uwb(payload, arrived_s)
            return
        self._channel.offer(sender, (key, payload), arrived_s)
        self._deliver()

    def _deliver(self) -> None:
        """Hand on what the channel lets through by now, and come back for what it delays."""
        now_s = time.monotonic()
        for _, (key, payload) in self._channel.due(now_s):
            received = self.opener.open(key, payload, now=now_s, unix_ns=time.time_ns())
            if received is not None:
                self._on_received(received)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due_s = self._channel.next_due()
        if due_s is not None:
            self._timer = asyncio.get_running_loop().call_at(due_s, self._deliver)

    def _on_presence(self, agent_id: int, alive: bool) -> None:
        if agent_id in self._neighbours and not alive:
            LOG.info("agent %d: neighbour %d has left", self._agent_id, agent_id)
            self._on_gone(agent_id)


def _credentials(config: FleetConfig, agent_id: int, base: Path) -> tuple[Signing, Trust, int]:
    """What to sign with, whom to trust, and the number of this start."""
    if config.security.mode == "unsigned":
        return UNSIGNED, UNSIGNED, int(time.time())
    directory = base / config.security.keys
    secret = load_secret(directory, agent_id)
    trust = load_trust(directory, config.ids)
    return secret, trust, next_boot(directory / f"agent_{agent_id:03d}.boot", time.time())
