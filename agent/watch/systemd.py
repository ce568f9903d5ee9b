"""What a service manager is told over ``NOTIFY_SOCKET`` (sd_notify(3)): ready, alive, state, stopping.

The watchdog is fed once a second from the daemon's loop: a loop that hangs is started anew by the manager. What the
estimator is worth has no part in that, since a restart in flight would only lose what is known.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping

from agent.watch.observers import DaemonState, Observer

LOG = logging.getLogger("fleetloc.agent")
MIN_WATCHDOG_S = 3.0
"""It is fed once a second; a shorter patience would be tried by a busy machine."""


class ServiceManager(Observer):
    """Tells a service manager of the daemon's life; ``watchdog`` whether it wants to hear that it lives."""

    def __init__(self, address: str, *, watchdog: bool) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._watchdog = watchdog
        self._socket: socket.socket | None = None
        """Kept: the watchdog is fed also when no descriptor is left."""
        self._status = ""
        self.failed = 0
        """Messages that could not be sent."""

    @classmethod
    def of(cls, environment: Mapping[str, str], process_id: int | None = None) -> ServiceManager | None:
        """The manager that an environment names, ``None`` if there is none."""
        address = environment.get("NOTIFY_SOCKET", "")
        if not address.startswith(("/", "@")):
            return None
        own_id = os.getpid() if process_id is None else process_id
        meant = environment.get("WATCHDOG_PID", str(own_id)) == str(own_id)
        patience_us = environment.get("WATCHDOG_USEC", "")
        watched = meant and patience_us.isdecimal() and int(patience_us) > 0
        if watched and int(patience_us) < MIN_WATCHDOG_S * 1e6:
            LOG.warning("WatchdogSec of %g s: expected %g s or more", int(patience_us) * 1e-6, MIN_WATCHDOG_S)
        return cls(address, watchdog=watched)

    async def open(self) -> None:
        self._tell("READY=1")

    def on_second(self, state: DaemonState) -> None:
        lines = ["WATCHDOG=1"] if self._watchdog else []
        status = " ".join(str(state.health).split())
        if status != self._status:
            self._status = status
            lines.append(f"STATUS=agent {state.agent_id}: {status}")
        if lines:
            self._tell(*lines)

    async def close(self, state: DaemonState) -> None:
        self._tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, *lines: str) -> None:
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            self.failed += 1
            if self.failed == 1:
                address = self._address.replace("\0", "@")
                LOG.warning("service manager at %s: not reached: %s", address, error.strerror)
