"""What an agent keeps of its run: every estimate, appended as it is made, readable after any end.

A file is one line of JSON (what the run was) and then fixed-size binary entries. A process that is killed
leaves at most one entry half written, which reading leaves out.

An entry holds the covariance of the whole fleet, or, of a fleet larger than a joint state, that of those who were
estimated together and the variances of all: so that a log does not grow with the square of the fleet.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.fleet.neighbourhood import is_limited
from agent.outputs import EstimateReady
from estimators.model.layout import STATES_PER_AGENT, Layout, states_of
from estimators.model.measurements import Matrix

FORMAT, FORMAT_JOINT = "fleetloc-estimates/1", "fleetloc-estimates/2"
"""With the covariance of the whole fleet, and with that of a joint state."""
SUFFIX = ".estimates"
FLUSH_EVERY = 10
MAX_AGE_TICKS = 2**31 - 1
CHUNK_NUMBERS = 1_000_000
"""Size of the largest table that is held at a time where a record is read piece by piece, in numbers."""


class EstimateLogHeader(msgspec.Struct, frozen=True, kw_only=True):
    """First line of a file."""

    format: str = FORMAT
    fleet: str
    agent: int
    agents: tuple[int, ...]
    """Ids in the order of the blocks of the state."""
    period_s: float
    epoch_unix_s: float
    joint: int | None = None
    """Most drones of which an entry holds the covariance; absent: all."""


def header_of(config: FleetConfig, agent_id: int) -> EstimateLogHeader:
    """The first line of an agent's log."""
    joint = config.fleet.joint_bodies if is_limited(config) else None
    return EstimateLogHeader(
        format=FORMAT if joint is None else FORMAT_JOINT,
        fleet=config.fleet.name,
        agent=agent_id,
        agents=config.bodies,
        period_s=config.fleet.period_s,
        epoch_unix_s=config.fleet.epoch_unix_s,
        joint=joint,
    )


def entry_dtype(agents: int, joint: int | None = None) -> np.dtype[Any]:
    """One entry: the estimate of a tick, NED m and m/s, and when it was ready.

    With ``joint`` the covariance of so many: ``members`` are their slots, then -1, and ``variance`` that of all.
    """
    dimension = STATES_PER_AGENT * agents
    held = dimension if joint is None else STATES_PER_AGENT * joint
    beyond = [] if joint is None else [("members", "<i2", (joint,)), ("variance", "<f8", (dimension,))]
    return np.dtype(
        [
            ("tick", "<i8"),
            ("t_s", "<f8"),  # fleet time of the estimate
            ("published_s", "<f8"),  # fleet time at which it was out
            ("tick_time_s", "<f8"),  # what the tick took to compute
            ("status", "i1"),
            ("on_time", "?"),  # out within one period of the tick's end
            ("age_ticks", "<i4", agents),
            ("mean", "<f8", dimension),
            ("covariance", "<f8", held * (held + 1) // 2),  # upper triangle by rows
            *beyond,
        ]
    )


class EstimateLogWriter:
    """Appends estimates to a file until it is full; then the agent goes on without."""

    def __init__(self, path: Path, header: EstimateLogHeader, max_bytes: int) -> None:
        """Make the file anew; raises `LogFileError` if that cannot be done."""
        self.path = path
        self.written = 0
        """Entries written."""
        self.skipped = 0
        """Entries not written: the file is full or the disk fails."""
        self.trouble = ""
        """Why the disk did not take the latest of them."""
        self._dtype = entry_dtype(len(header.agents), header.joint)
        self._layout, self._joint = Layout(header.agents), header.joint
        self._triangle = np.triu_indices(self._layout.dimension)
        self._period_s = header.period_s
        self._left_bytes = max_bytes
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
            self._file.write(msgspec.json.encode(header) + b"\n")
            self._file.flush()  # whoever reads a log that has just begun finds one without estimates
        except OSError as error:
            raise LogFileError(f"record {path}: cannot be written: {error.strerror}") from error

    def write(self, ready: EstimateReady, published_s: float, tick_time_s: float) -> None:
        """Append one estimate."""
        if self._left_bytes < self._dtype.itemsize:
            self.skipped += 1
            return
        estimate = ready.estimate
        entry = np.zeros((), self._dtype)
        entry["tick"], entry["t_s"] = estimate.tick, ready.t_s
        entry["published_s"], entry["tick_time_s"] = published_s, tick_time_s
        entry["status"] = int(estimate.status)
        entry["on_time"] = published_s <= ready.t_s + 2 * self._period_s
        entry["age_ticks"] = np.minimum(estimate.age_ticks, MAX_AGE_TICKS)
        entry["mean"] = estimate.mean
        if self._joint is None:
            entry["covariance"] = estimate.covariance[self._triangle]
        else:
            self._put_joint(entry, estimate.covariance, ready.joint or ())
        try:
            self._file.write(entry.tobytes())
            self._left_bytes -= self._dtype.itemsize
            self.written += 1
            if self.written <= FLUSH_EVERY or self.written % FLUSH_EVERY == 0 or self.trouble:
                self._file.flush()
                self.trouble = ""
        except OSError as error:  # a full disk must not ground the fleet
            self.skipped += 1
            self.trouble = error.strerror or str(error)

    def end(self, reason: str) -> None:
        """Take no more: what is left of the disk belongs to others; ``reason`` says why."""
        self._left_bytes, self.trouble = 0, reason

    def _put_joint(self, entry: NDArray[np.void], covariance: Matrix, joint: Sequence[int]) -> None:
        slots = [self._layout.slot(agent) for agent in joint]
        at = states_of(slots)
        rows, columns = np.triu_indices(len(at))
        entry["members"] = -1
        entry["members"][: len(slots)] = slots
        entry["covariance"][: len(rows)] = covariance[at[rows], at[columns]]
        entry["variance"] = covariance.diagonal()

    def close(self) -> None:
        """Write out what is buffered."""
        try:
            self._file.close()
        except OSError:
            self.skipped += 1


def read_entries(path: Path) -> tuple[EstimateLogHeader, NDArray[np.void]]:
    """Header and entries of a file; raises `LogFileError` naming the file and what is wrong."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise LogFileError(f"record {path}: cannot be read: {error.strerror}") from error
    line, newline, content = raw.partition(b"\n")
    header = _header(path, line + newline)
    dtype = entry_dtype(len(header.agents), header.joint)
    whole = len(content) // dtype.itemsize
    return header, np.frombuffer(content, dtype, whole)


def header_in(path: Path) -> EstimateLogHeader:
    """The header of a file; raises `LogFileError` naming the file and what is wrong."""
    try:
        with path.open("rb") as file:
            return _header(path, file.readline())
    except OSError as error:
        raise LogFileError(f"record {path}: cannot be read: {error.strerror}") from error


def _header(path: Path, line: bytes) -> EstimateLogHeader:
    try:
        header = msgspec.json.decode(line, type=EstimateLogHeader)
    except msgspec.DecodeError as error:
        raise LogFileError(f"record {path}: expected a first line of {FORMAT}: {error}") from error
    expected = FORMAT if header.joint is None else FORMAT_JOINT
    if header.format != expected or not line.endswith(b"\n"):
        raise LogFileError(f"record {path}: expected {expected}, found {header.format!r}")
    return header


def record_chunks(path: Path, agents: int) -> Iterator[NDArray[np.void]]:
    """The entries of a record, so many at a time that their covariances stay within `CHUNK_NUMBERS`."""
    count = max(CHUNK_NUMBERS // Layout(tuple(range(agents))).dimension ** 2, 16)
    with path.open("rb") as file:
        header = msgspec.json.decode(file.readline(), type=EstimateLogHeader)
        dtype = entry_dtype(agents, header.joint)
        while len(chunk := np.fromfile(file, dtype, count)):
            yield chunk


def covariance_of(entry: NDArray[np.void] | np.void, agents: int) -> Matrix:
    """The full covariance ``(6n, 6n)`` of one entry; between those not estimated together it is zero."""
    dimension = STATES_PER_AGENT * agents
    packed = entry["covariance"]
    if "members" not in (entry.dtype.names or ()):
        return _unpacked(packed, dimension)
    at = states_of(entry["members"][entry["members"] >= 0].tolist())
    matrix = np.zeros((dimension, dimension))
    np.fill_diagonal(matrix, entry["variance"])
    matrix[np.ix_(at, at)] = _unpacked(packed[: len(at) * (len(at) + 1) // 2], len(at))
    return matrix


def _unpacked(triangle: NDArray[np.float64], dimension: int) -> Matrix:
    matrix = np.zeros((dimension, dimension))
    matrix[np.triu_indices(dimension)] = triangle
    return np.asarray(matrix + np.triu(matrix, 1).T)


def variances_of(entries: NDArray[np.void], agents: int) -> NDArray[np.float64]:
    """The variances ``(K, 6n)`` of entries."""
    if "members" in (entries.dtype.names or ()):
        return np.asarray(entries["variance"])
    rows, columns = np.triu_indices(STATES_PER_AGENT * agents)
    return np.asarray(entries["covariance"][:, rows == columns])


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """The counters of a finished run beside its record; raises `LogFileError`."""
    try:
        path.write_text(json.dumps(summary, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    except OSError as error:
        raise LogFileError(f"summary {path}: cannot be written: {error.strerror}") from error
