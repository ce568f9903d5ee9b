"""The monitor's ear: a session that subscribes to what drones say of themselves, and to nothing else.

It puts nothing, answers nothing and shows no presence, so that the observer's certificate of a field fleet, which
may only listen, is enough for it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from agent.config.tables import FleetConfig
from agent.fleet.neighbourhood import is_limited
from agent.radio.security import is_field, observer_credentials, observer_session
from transport.errors import Rejected
from transport.link.session import Handlers, Session, open_session
from transport.link.streams import Stream
from transport.security.opening import Opener, Received

STREAMS = (Stream.EST, Stream.DIAG)
"""What is listened to of every drone; in a fleet larger than a joint state also its far field."""
OnMessage = Callable[[Received], None]
OnPresence = Callable[[int, bool, float], None]
"""(agent id, whether it is there, monotonic clock in s)."""


class FleetListener:
    """Listens to all drones of a fleet; what is well-formed and from whom it says goes to ``on_message``.

    ``endpoints`` are dialled instead of those that the configuration gives the drones; ``base`` is the folder of the
    configuration file. In the field profiles a packet's age is judged by this machine's clock, as drones do.
    """

    def __init__(
        self,
        config: FleetConfig,
        base: Path,
        on_message: OnMessage,
        on_presence: OnPresence,
        endpoints: Sequence[str] = (),
    ) -> None:
        """Read keys and certificates; raises `SecurityError`, `KeyFileError`, `SettingsError`."""
        self._config = config
        self._on_message, self._on_presence = on_message, on_presence
        trust, self._envelopes = observer_credentials(config, base, unix_s=time.time())
        self._settings = observer_session(config, base)
        if endpoints:
            self._settings = msgspec.structs.replace(self._settings, connect=tuple(endpoints))
        freshness_s = config.security.freshness_s if is_field(config) else None
        self._opener = Opener(
            config.fleet.name, config.ids, trust, freshness_s=freshness_s, bodies=config.bodies
        )
        self._envelope_refusals: Counter[str] = Counter()
        self._session: Session | None = None

    async def open(self) -> None:
        """Dial every drone; those that are not there yet are dialled on and on. Raises `SessionError`."""
        handlers = Handlers(self._on_sample, self._on_there)
        session = await open_session(self._settings, self._config.fleet.name, None, self._config.ids, handlers)
        self._session = session
        streams = (*STREAMS, Stream.FAR) if is_limited(self._config) else STREAMS
        for agent_id in self._config.ids:
            session.subscribe(agent_id, streams)
        session.announce()

    async def close(self) -> None:
        """Leave."""
        if self._session is not None:
            await self._session.close()

    def refusals(self) -> dict[str, int]:
        """Packets refused so far, by reason."""
        return dict(Counter(self._opener.peers.rejections()) + self._envelope_refusals)

    def _on_there(self, agent_id: int, there: bool) -> None:
        self._on_presence(agent_id, there, time.monotonic())

    def _on_sample(self, key: str, payload: bytes, arrived_s: float) -> None:
        if self._envelopes is not None:
            try:
                payload = self._envelopes.open(key, payload)
            except Rejected as rejected:
                self._envelope_refusals[str(rejected.reason)] += 1
                return
        received = self._opener.open(key, payload, now=arrived_s, unix_ns=time.time_ns())
        if received is not None:
            self._on_message(received)
