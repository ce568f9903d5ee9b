"""What a fleet says of itself on the radio, collected for the live picture and the report: it only listens."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from agent.config.tables import FleetConfig
from agent.radio.security import observer_credentials, observer_session
from transport.errors import Rejected
from transport.link.session import Handlers, Session, open_session
from transport.link.streams import Stream
from transport.messages.estimate_body import FleetEstimate
from transport.messages.report_body import Diagnostics
from transport.security.opening import Opener


@dataclass(slots=True)
class Observed:
    """The latest of one agent; ``ended_lives`` holds the last counters of daemons that came before."""

    alive: bool = False
    estimate: FleetEstimate | None = None
    estimate_s: float = 0.0
    """Arrival of ``estimate`` on the monotonic clock."""
    diagnostics: Diagnostics | None = None
    ended_lives: list[Diagnostics] = field(default_factory=list)

    def on_diagnostics(self, diagnostics: Diagnostics) -> None:
        """Note a report; counters that went back mean that another daemon counts now."""
        last = self.diagnostics
        if last is not None and diagnostics.counters.get("ticks", 0) < last.counters.get("ticks", 0):
            self.ended_lives.append(last)
        self.diagnostics = diagnostics


class RunObserver:
    """Listens to the estimates and diagnostics of every agent; ``agents`` by id."""

    def __init__(self, config: FleetConfig, base: Path, on_presence: Callable[[], None]) -> None:
        """Read the keys; raises `SecurityError`. ``base`` is the folder that the key folder is relative to."""
        self._config = config
        trust, self._envelopes = observer_credentials(config, base, unix_s=time.time())
        self._settings = observer_session(config, base)
        self._opener = Opener(config.fleet.name, config.ids, trust, bodies=config.bodies)
        self._told = on_presence
        self._session: Session | None = None
        self.agents = {agent_id: Observed() for agent_id in config.ids}

    async def open(self) -> None:
        """Dial every agent; raises `SessionError`."""
        handlers = Handlers(self._on_sample, self._on_presence)
        session = await open_session(self._settings, self._config.fleet.name, None, self._config.ids, handlers)
        for agent_id in self._config.ids:
            session.subscribe(agent_id, (Stream.EST, Stream.DIAG))
        session.announce()
        self._session = session

    async def close(self) -> None:
        """Leave."""
        if self._session is not None:
            await self._session.close()

    @property
    def all_there(self) -> bool:
        """Whether every daemon has shown itself."""
        return all(observed.alive for observed in self.agents.values())

    def _on_presence(self, agent_id: int, alive: bool) -> None:
        if agent_id in self.agents:
            self.agents[agent_id].alive = alive
            self._told()

    def _on_sample(self, key: str, payload: bytes, arrived_s: float) -> None:
        if self._envelopes is not None:
            try:
                payload = self._envelopes.open(key, payload)
            except Rejected:
                return  # of another fleet or nobody's: not ours to show
        received = self._opener.open(key, payload, now=arrived_s, unix_ns=time.time_ns())
        if received is None:
            return  # counted by the opener
        observed = self.agents[received.sender]
        if isinstance(received.message, FleetEstimate):
            observed.estimate, observed.estimate_s = received.message, arrived_s
        elif isinstance(received.message, Diagnostics):
            observed.on_diagnostics(received.message)
