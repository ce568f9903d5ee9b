"""What a daemon keeps of its run in its record's folder: estimates, flight log, and at the end its counters."""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from agent.config.reading import dump
from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.log.disk import DiskLimit, free_bytes, too_little_left
from agent.log.estimate_log import SUFFIX, EstimateLogWriter, header_of, write_summary
from agent.log.estimate_mcap import agent_key
from agent.log.flight_format import FlightStart, trust_text
from agent.log.flight_log import FlightLog
from agent.outputs import EstimateReady
from agent.watch.observers import DaemonState, Observer
from transport.link.off_loop import off_loop
from transport.security.auth import Trust

MB = 1e6
ESTIMATES_MB = 200.0
"""Size at which an agent's estimates stop growing, some 20 minutes of ten drones at 10 Hz; the daemon goes on."""
SOFTWARE = ("fleetloc", "numpy", "numba")
"""What the last digits of an estimate depend on."""


class RunLogs(Observer):
    """The files ``agent_001.*`` of one run; ``flight`` is the journal of a flight log, if one is wanted."""

    def __init__(
        self,
        config: FleetConfig,
        agent_id: int,
        directory: Path,
        trust: Trust,
        *,
        unix_s: float,
        host_s: float,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        """Make the files anew; raises `LogFileError`. The times are those that the agent's clock began with."""
        settings = config.record
        self._directory, self._free = directory, free
        self._require_room()
        self._epoch_unix_s = config.fleet.epoch_unix_s
        stem = directory / agent_key(agent_id)
        path = stem.with_suffix(SUFFIX)
        self._estimates = EstimateLogWriter(path, header_of(config, agent_id), int(ESTIMATES_MB * MB))
        self.flight: FlightLog | None = None
        if settings.flight:
            limit = DiskLimit(directory, int(settings.flight_max_mb * MB), free=free)
            start = flight_start(config, agent_id, trust, unix_s, host_s)
            try:
                self.flight = FlightLog(stem, config, start, limit)
            except LogFileError:
                self._estimates.close()
                raise

    def _require_room(self) -> None:
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            full = too_little_left(self._directory, self._free)
        except OSError as error:
            raise LogFileError(f"record {self._directory}: cannot be written: {error.strerror}") from error
        if full:
            raise LogFileError(f"record {self._directory}: cannot be written: {full}")

    @property
    def trouble(self) -> str:
        """Why what should be recorded is not, empty if it is; a flight log as large as it may be is none."""
        return self._estimates.trouble or ("" if self.flight is None else self.flight.trouble)

    def counters(self) -> dict[str, int]:
        """What was not written, and how far the flight log is."""
        flight = {} if self.flight is None else dict(self.flight.counters)
        return {"record estimates skipped": self._estimates.skipped} | flight

    def on_estimate(self, ready: EstimateReady, published_s: float, tick_time_s: float) -> None:
        self._estimates.write(ready, published_s, tick_time_s)
        if self.flight is not None:
            self.flight.on_estimate(ready, published_s, published_s + self._epoch_unix_s)

    def on_second(self, state: DaemonState) -> None:
        try:
            full = too_little_left(self._directory, self._free)
        except OSError as error:
            full = error.strerror or str(error)
        if full:
            self._estimates.end(full)
        if self.flight is not None:
            self.flight.hand_over()

    async def close(self, state: DaemonState) -> None:
        """Write everything out, and the counters beside it; raises `LogFileError` if those cannot be written."""
        self._estimates.close()
        if self.flight is not None:
            await off_loop(self.flight.close)
        write_summary(self._estimates.path.with_suffix(".json"), state.as_dict())


def flight_start(config: FleetConfig, agent_id: int, trust: Trust, unix_s: float, host_s: float) -> FlightStart:
    """The begin of a flight log."""
    versions = [f"{name} {_version(name)}" for name in SOFTWARE]
    return FlightStart(
        agent=agent_id,
        config=dump(config),
        trust=trust_text(trust),
        unix_s=unix_s,
        host_s=host_s,
        software=", ".join([*versions, f"Python {platform.python_version()}", platform.machine()]),
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # run from the sources
        return "unknown"
