"""The Zenoh session of one process: a thin asyncio shell.

Zenoh calls back on its own threads. There, nothing happens but a hand-over into a bounded inbox that the
event loop empties; whoever floods us loses packets, counted, before they cost more than that.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import zenoh

from transport.errors import SessionError
from transport.link.session_settings import SessionSettings, zenoh_config
from transport.link.streams import (
    Stream,
    check_agent_id,
    key_expression,
    parse_key,
    presence_pattern,
    self_contained,
)
from transport.security.uwb_seal import UwbSeal

_SOURCE_PLACE = re.compile(r" at /\S+:\d+\.?")
"""Zenoh's errors name places in its own source, which help nobody here."""
CLOSE_S = 2.0
"""Closing a session takes no longer; half a second is usual."""
_BATCH = 256
"""Packets handed to their handler before the event loop turns to other things."""


@dataclass(frozen=True, slots=True)
class Quality:
    """How a stream is sent; always dropping on congestion, since a stalled neighbour may not stall us."""

    priority: zenoh.Priority
    express: bool
    reliability: zenoh.Reliability


_RELIABLE, _BEST_EFFORT = zenoh.Reliability.RELIABLE, zenoh.Reliability.BEST_EFFORT
QUALITY = {
    Stream.MEAS: Quality(zenoh.Priority.INTERACTIVE_LOW, True, _RELIABLE),
    Stream.INFO: Quality(zenoh.Priority.INTERACTIVE_HIGH, True, _BEST_EFFORT),
    Stream.EST: Quality(zenoh.Priority.DATA_LOW, False, _RELIABLE),
    Stream.FAR: Quality(zenoh.Priority.DATA, False, _RELIABLE),
    Stream.AGREE: Quality(zenoh.Priority.DATA_LOW, False, _RELIABLE),
    Stream.DIAG: Quality(zenoh.Priority.BACKGROUND, False, _RELIABLE),
    Stream.UWB: Quality(zenoh.Priority.DATA_HIGH, True, _BEST_EFFORT),
}
OWN_STREAMS = (Stream.MEAS, Stream.INFO, Stream.EST, Stream.DIAG)
"""Declared before a member shows that it is there; others only with their first packet, as most fleets have none."""

SampleHandler = Callable[[str, bytes, float], None]
"""(key expression, payload, arrival on the clock of `asyncio` in s)."""
PresenceHandler = Callable[[int, bool], None]
"""(agent id, whether it is there); may be called again with what is known already."""
ClockHandler = Callable[[bytes, int], bytes | None]
"""(question, arrival on the UTC clock in ns) -> sealed answer, or ``None`` to leave it unanswered."""


@dataclass(frozen=True, slots=True)
class Handlers:
    """Where things go; all are called on the event loop."""

    on_sample: SampleHandler
    on_presence: PresenceHandler = lambda _agent_id, _alive: None
    on_clock_question: ClockHandler = lambda _question, _arrived_ns: None


class Session:
    """One open Zenoh session; make it with `open_session`, and `close` it before the loop ends.

    ``shed`` counts packets dropped because the inbox was full, ``failed`` those Zenoh did not take.
    """

    def __init__(
        self,
        session: zenoh.Session,
        fleet: str,
        agent_id: int | None,
        handlers: Handlers,
        inbox_packets: int,
        *,
        over_datagrams: bool = False,
        uwb_seal: UwbSeal | None = None,
    ) -> None:
        self._session = session
        self._fleet = fleet
        self._agent_id = agent_id
        self._handlers = handlers
        self._loop = asyncio.get_running_loop()
        self._inbox: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._inbox_packets = inbox_packets
        self._over_datagrams = over_datagrams
        self._uwb_seal = uwb_seal
        self._lock = threading.Lock()
        self._draining = False
        self._closed = False
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[Any] = []
        self._subscribers: dict[tuple[int, Stream], Any] = {}
        self.shed = 0
        self.failed = 0

    def subscribe(self, agent_id: int, streams: Iterable[Stream]) -> None:
        """Listen to streams of one agent: its exact keys, so that the topology is what was configured."""
        for stream in streams:
            self._subscribers[agent_id, stream] = self._subscriber(agent_id, stream)

    def resubscribe(self, agent_id: int) -> None:
        """Declare the subscriptions to an agent anew, for the case that the declarations were lost on the way.

        Datagram links lose them silently. For a moment nothing is subscribed to: do it for silent agents only.
        """
        if self._closed:
            return
        for subject, subscriber in self._subscribers.items():
            if subject[0] == agent_id:
                try:
                    subscriber.undeclare()
                    self._subscribers[subject] = self._subscriber(*subject)
                except zenoh.ZError:
                    self.failed += 1

    def _subscriber(self, agent_id: int, stream: Stream) -> Any:
        key = key_expression(self._fleet, agent_id, stream)
        key = self_contained(key) if self._over_datagrams else key
        handler = zenoh.handlers.Callback(self._on_sample, indirect=False)
        return self._session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE)

    def announce(self) -> None:
        """Show that this agent is there, answer clock questions, and watch who else is there.

        Subscribe first: who sees our token then knows our subscriptions too, and its packets reach us.
        """
        pattern = presence_pattern(self._fleet)
        watch = zenoh.handlers.Callback(self._on_presence, indirect=False)
        self._declared.append(self._session.liveliness().declare_subscriber(pattern, watch, history=True))
        if self._agent_id is None:
            return
        clock = key_expression(self._fleet, self._agent_id, Stream.CLOCK)
        answer = zenoh.handlers.Callback(self._on_question, indirect=False)
        self._declared.append(self._session.declare_queryable(clock, answer))
        for stream in OWN_STREAMS:
            self._publisher(self._agent_id, stream)
        token = key_expression(self._fleet, self._agent_id, Stream.ALIVE)
        self._declared.append(self._session.liveliness().declare_token(token))

    def publish(self, stream: Stream, data: bytes, *, agent_id: int | None = None) -> bool:
        """Put bytes on an own stream, or (a UWB driver) on that of ``agent_id``; never blocks.

        UWB frames are sealed where the settings have a seal. False, and counted in ``failed``, if the session could
        not take it.
        """
        owner = self._agent_id if agent_id is None else agent_id
        if owner is None:
            raise ValueError("an observer has no streams of its own; name the agent")
        if stream is Stream.UWB and self._uwb_seal is not None:
            data = self._uwb_seal.close(key_expression(self._fleet, owner, stream), data)
        try:
            self._publisher(owner, stream).put(data)
        except zenoh.ZError:
            self.failed += 1
            return False
        return True

    async def ask_clock(self, agent_id: int, question: bytes, *, timeout_s: float = 0.2) -> tuple[bytes, int] | None:
        """A neighbour's sealed answer and its arrival on the UTC clock in ns; ``None`` if there is none."""
        answer: asyncio.Future[tuple[bytes, int] | None] = self._loop.create_future()

        def settle(result: tuple[bytes, int] | None) -> None:
            if not answer.done():
                answer.set_result(result)

        def on_reply(reply: zenoh.Reply) -> None:
            arrived_ns = time.time_ns()
            if reply.ok is not None:
                self._on_loop(settle, (reply.ok.payload.to_bytes(), arrived_ns))

        def on_end() -> None:
            self._on_loop(settle, None)

        key = key_expression(self._fleet, agent_id, Stream.CLOCK)
        handler = zenoh.handlers.Callback(on_reply, on_end, indirect=False)
        try:
            self._session.get(
                key,
                handler,
                timeout=timeout_s,
                payload=question,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            return await asyncio.wait_for(answer, 2 * timeout_s)
        except zenoh.ZError:
            self.failed += 1
            return None
        except TimeoutError:
            return None

    def connected(self) -> int:
        """Peers with an open link at this moment."""
        return len(self._session.info.peers_zid())

    async def close(self) -> bool:
        """Withdraw the token and leave; neighbours see it at once. Closing twice is harmless.

        False if Zenoh has not let go within `CLOSE_S`, as where its links are gone (10 s): then it does so later.
        """
        if self._closed:
            return True
        self._closed = True
        is_closed = await _within(CLOSE_S, self._close)
        with self._lock:
            self._inbox.clear()
        return is_closed

    def _close(self) -> None:
        try:
            for declared in (*self._subscribers.values(), *reversed(self._declared)):
                declared.undeclare()
        finally:
            self._session.close()  # type: ignore[no-untyped-call]

    def _publisher(self, agent_id: int, stream: Stream) -> zenoh.Publisher:
        key = key_expression(self._fleet, agent_id, stream)
        publisher = self._publishers.get(key)
        if publisher is None:
            quality = QUALITY[stream]
            publisher = self._publishers[key] = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=quality.priority,
                express=quality.express,
                reliability=quality.reliability,
            )
        return publisher

    # --- on threads of Zenoh: hand over, nothing else -------------------------------------------------------

    def _on_sample(self, sample: zenoh.Sample) -> None:
        arrived_s = self._loop.time()
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        self._hand_over(self._handlers.on_sample, key, payload, arrived_s)

    def _on_presence(self, sample: zenoh.Sample) -> None:
        parsed = parse_key(str(sample.key_expr))
        if parsed is not None and parsed[1] != self._agent_id:
            alive = sample.kind == zenoh.SampleKind.PUT
            self._hand_over(self._handlers.on_presence, parsed[1], alive)

    def _on_question(self, query: zenoh.Query) -> None:
        arrived_ns = time.time_ns()
        question = b"" if query.payload is None else query.payload.to_bytes()
        self._hand_over(self._answer, query, question, arrived_ns)

    def _hand_over(self, handler: Callable[..., None], *arguments: Any) -> None:
        with self._lock:
            if self._closed:
                return
            if len(self._inbox) >= self._inbox_packets:
                self.shed += 1
                return
            self._inbox.append((handler, arguments))
            wake, self._draining = not self._draining, True
        if wake:
            self._on_loop(self._drain)

    def _on_loop(self, function: Callable[..., None], *arguments: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:  # the loop has ended before `close`: there is nobody left to hand anything to
            self.shed += 1

    # --- on the event loop ----------------------------------------------------------------------------------

    def _drain(self) -> None:
        with self._lock:
            batch = [self._inbox.popleft() for _ in range(min(_BATCH, len(self._inbox)))]
            self._draining = bool(batch)
        for handler, arguments in batch:
            # each its own callback: one that fails is reported by the loop and stops no other
            self._loop.call_soon(self._deliver, handler, arguments)
        if batch:
            self._loop.call_soon(self._drain)

    def _deliver(self, handler: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        if not self._closed:
            handler(*arguments)

    def _answer(self, query: zenoh.Query, question: bytes, arrived_ns: int) -> None:
        with query:  # the asker waits until the query is dropped
            answer = self._handlers.on_clock_question(question, arrived_ns)
            if answer is None or self._agent_id is None:
                return
            key = key_expression(self._fleet, self._agent_id, Stream.CLOCK)
            try:
                query.reply(key, answer)  # as urgent as the question was
            except zenoh.ZError:
                self.failed += 1


async def _within(most_s: float, function: Callable[[], None]) -> bool:
    """Call on a thread that nobody waits for at the end of the program; whether it came to its end in time."""
    ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def settle(error: BaseException | None) -> None:
        if ended.cancelled():
            return
        if error is None:
            ended.set_result(None)
        else:
            ended.set_exception(error)

    def work(loop: asyncio.AbstractEventLoop) -> None:
        error: BaseException | None = None
        try:
            function()
        except BaseException as raised:  # noqa: BLE001  # handed on to whoever waits
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop is over
            loop.call_soon_threadsafe(settle, error)

    try:
        threading.Thread(target=work, args=(asyncio.get_running_loop(),), name="close", daemon=True).start()
    except RuntimeError:  # the system has no more threads
        function()
        return True
    try:
        await asyncio.wait_for(ended, most_s)
    except TimeoutError:
        return False
    return True


async def open_session(
    settings: SessionSettings,
    fleet: str,
    agent_id: int | None,
    members: Iterable[int],
    handlers: Handlers,
) -> Session:
    """Open the session of an agent, or without id that of an observer or a UWB driver.

    Returns though no neighbour is there yet: they are dialled in the background. Subscribe next, then
    `Session.announce`. Raises `SettingsError`, or `SessionError` if an endpoint cannot be listened on.
    """
    if agent_id is not None:
        check_agent_id(agent_id)
    config = zenoh_config(settings, fleet, agent_id, members)
    try:
        session = await asyncio.to_thread(zenoh.open, config)
    except zenoh.ZError as error:
        where = ", ".join(settings.listen) or "no endpoint"
        cause = _SOURCE_PLACE.sub("", str(error))
        raise SessionError(
            f"Zenoh session listening on {where}: {cause}; is the port taken, or the address not ours?"
        ) from None
    datagrams = any(endpoint.startswith("udp/") for endpoint in (*settings.listen, *settings.connect))
    return Session(
        session,
        fleet,
        agent_id,
        handlers,
        settings.inbox_packets,
        over_datagrams=datagrams,
        uwb_seal=settings.uwb_seal,
    )
