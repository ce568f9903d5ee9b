"""What a monitor needs: the estimates and the health of all drones, as they are published."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from fleetloc.monitor.listener import FleetListener
from fleetloc.whole_config import load_whole
from transport.messages.estimate_body import FleetEstimate
from transport.messages.report_body import Diagnostics
from transport.security.opening import Received


@dataclass(frozen=True, slots=True)
class Heard:
    """One message of a drone, checked as the security profile asks.

    ``received_s`` is on the clock of ``time.monotonic()``.
    """

    agent_id: int
    message: FleetEstimate | Diagnostics
    received_s: float


class FleetObserver:
    """Hears what the drones of a fleet publish, and says nothing; an asynchronous context and iterator.

    ::

        async with FleetObserver("fleet.toml") as fleet:
            async for heard in fleet:
                print(heard.agent_id, heard.message)

    Drones that are not there yet are dialled on and on. In the profile `field` it needs the observer's certificate.
    """

    def __init__(
        self, config_file: str | Path, endpoints: Sequence[str] = (), most_waiting: int = 1000
    ) -> None:
        """Read configuration and keys; raises `ConfigError`, `KeyFileError`.

        ``endpoints`` (``tcp/10.0.0.5:7447``) are dialled instead of those that the configuration gives the drones.
        Messages that are not taken wait, at most ``most_waiting`` of them; then the oldest go.
        """
        config = load_whole(config_file)
        self._listener = FleetListener(
            config, Path(config_file).parent, self._on_message, self._on_presence, endpoints
        )
        self._waiting: deque[Heard] = deque(maxlen=most_waiting)
        self._news = asyncio.Event()
        self._present: set[int] = set()
        self.dropped = 0
        """Messages that went since they were not taken in time."""

    @property
    def present(self) -> frozenset[int]:
        """Ids of the drones whose daemons are there."""
        return frozenset(self._present)

    def refusals(self) -> dict[str, int]:
        """Packets refused so far, by reason."""
        return self._listener.refusals()

    async def __aenter__(self) -> Self:
        """Begin to listen; raises `SessionError`."""
        await self._listener.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave."""
        await self._listener.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Heard:
        """The next message; waits for it."""
        while not self._waiting:
            self._news.clear()
            await self._news.wait()
        return self._waiting.popleft()

    def _on_message(self, received: Received) -> None:
        if isinstance(received.message, FleetEstimate | Diagnostics):
            self.dropped += len(self._waiting) == self._waiting.maxlen
            self._waiting.append(Heard(received.sender, received.message, received.received_s))
            self._news.set()

    def _on_presence(self, agent_id: int, there: bool, _now_s: float) -> None:
        (self._present.add if there else self._present.discard)(agent_id)
