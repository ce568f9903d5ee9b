"""The flight log of a daemon: what it received (.tlog) and everything else that went in and came out (.mcap).

The daemon's loop only appends to a list; a thread encodes, compresses and writes. A record is a beginning of the
flight without gaps, or it could not be repeated: where it cannot go on (size, disk full, disk failing or too
slow) it ends, says so once, and the daemon flies on.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections import Counter
from pathlib import Path

import msgspec

from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.inputs import Input, MavlinkIn
from agent.log.disk import DiskLimit
from agent.log.estimate_mcap import SUFFIX, EstimateChannels, McapFile
from agent.log.flight_format import CLOSED, END, NAMES, START, FlightStart, input_schema, input_topic, lay
from agent.log.tlog import SUFFIX as TLOG_SUFFIX
from agent.log.tlog import TlogWriter
from agent.outputs import EstimateReady

LOG = logging.getLogger("fleetloc.agent")
FLUSH_PERIOD_S = 1.0
MAX_WAITING_BATCHES = 600
"""A batch is handed over with every estimate: at 10 Hz the disk may be a minute behind."""
CLOSE_TIMEOUT_S = 5.0


class _Sent(msgspec.Struct, frozen=True):
    frames: list[bytes]


class _Estimate(msgspec.Struct, frozen=True):
    ready: EstimateReady
    published_s: float
    inputs: int


_Entry = tuple[Input | _Sent | _Estimate, float]
"""What and its UTC instant."""


class FlightLog:
    """A `Journal` on disk. ``counters`` has what was taken down and what not; ``ended`` why it ended, else empty."""

    def __init__(
        self, stem: Path, config: FleetConfig, start: FlightStart, limit: DiskLimit, *, threaded: bool = True
    ) -> None:
        """Make ``stem`` .tlog and .mcap anew; raises `LogFileError` if that cannot be done.

        Without a thread, everything is written as it is handed over.
        """
        self._files = _Files(stem, config, start)
        self._limit = limit
        self._who = f"agent {start.agent}: flight log {stem}{SUFFIX}"
        self._batch: list[_Entry] = []
        self._inputs = 0
        self._closing = False
        self.ended = ""
        self.trouble = ""
        """The same where that is not as wanted: the disk is full, fails or is too slow."""
        self.counters: Counter[str] = Counter()
        self._waiting: queue.SimpleQueue[list[_Entry] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if threaded:
            try:
                self._thread = self._start_thread()
            except RuntimeError as error:  # the system has no more
                self._files.close("no thread to write it")
                raise LogFileError(f"record {stem}{SUFFIX}: no thread to write it: {error}") from error

    def _start_thread(self) -> threading.Thread:
        thread = threading.Thread(target=self._work, name="flight log", daemon=True)
        thread.start()
        return thread

    # --- on the daemon's loop -------------------------------------------------------------------------------

    def note(self, event: Input, unix_s: float) -> None:
        """Take down an input."""
        self._inputs += 1
        self._batch.append((event, unix_s))

    def note_sent(self, frames: list[bytes], unix_s: float) -> None:
        """Take down frames that were sent to the autopilot."""
        self._batch.append((_Sent(frames), unix_s))

    def on_estimate(self, ready: EstimateReady, published_s: float, unix_s: float) -> None:
        """Take down an estimate, and hand over what has been taken down since the last."""
        self._batch.append((_Estimate(ready, published_s, self._inputs), unix_s))
        self.hand_over()

    def hand_over(self) -> None:
        """Give what was taken down to the thread that writes."""
        batch, self._batch = self._batch, []
        if self.ended:
            self.counters["record dropped"] += len(batch)
        elif self._thread is None:
            self._write(batch)
        elif self._waiting.qsize() >= MAX_WAITING_BATCHES:
            self._end(f"the disk is too slow: {MAX_WAITING_BATCHES} batches wait")
            self.counters["record dropped"] += len(batch)
        else:
            self._waiting.put(batch)

    def close(self) -> None:
        """Write what is left, the index, and close the files; never raises for the disk."""
        self.hand_over()
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join(CLOSE_TIMEOUT_S)
            if self._thread.is_alive():
                self._end(f"the disk is stuck: not written within {CLOSE_TIMEOUT_S:g} s")
                return
            self._thread = None
        if not self._closing:
            self._finish(CLOSED)

    # --- on the thread, if there is one ---------------------------------------------------------------------

    def _work(self) -> None:
        while (batch := self._waiting.get()) is not None:
            self._write(batch)

    def _write(self, batch: list[_Entry]) -> None:
        if self.ended:  # while this batch was waiting
            self.counters["record dropped"] += len(batch)
            self._finish(self.ended)
            return
        as_wanted = self._limit.is_reached_by(self._files.size_bytes)
        try:
            reason = self._limit.reached(self._files.size_bytes)
            if not reason:
                self._files.write(batch)
                self.counters["record entries"] += len(batch)
                return
        except OSError as error:
            reason = f"the disk fails: {error.strerror or error}"
        self.counters["record dropped"] += len(batch)
        self._end(reason, as_wanted=as_wanted)
        self._finish(reason)

    def _end(self, reason: str, *, as_wanted: bool = False) -> None:
        if not self.ended:
            self.ended, self.trouble = reason, "" if as_wanted else reason
            self.counters["record ended early"] += 1
            LOG.log(
                logging.WARNING if as_wanted else logging.ERROR,
                "%s ends here: %s; flying on without",
                self._who,
                reason,
            )

    def _finish(self, reason: str) -> None:
        if self._closing:
            return
        self._closing = True
        try:
            self._files.close(reason)
        except OSError as error:
            self._end(f"the disk fails: {error.strerror or error}")


class _Files:
    """The two files; raises `OSError` wherever the disk does."""

    def __init__(self, stem: Path, config: FleetConfig, start: FlightStart) -> None:
        self._agent_id = start.agent
        try:
            stem.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.ExitStack() as opened:
                tlog = opened.enter_context(stem.with_name(stem.name + TLOG_SUFFIX).open("wb"))
                mcap = opened.enter_context(stem.with_name(stem.name + SUFFIX).open("wb"))
                self._tlog, self._mcap = TlogWriter(tlog), McapFile(mcap)
                self._mcap.metadata(START, start.texts())
                opened.pop_all()
        except OSError as error:
            raise LogFileError(f"record {stem}{SUFFIX}: cannot be written: {error.strerror or error}") from error
        fleet = config.fleet
        self._estimates = EstimateChannels(self._mcap, config.bodies, fleet.period_s, fleet.epoch_unix_s)
        self._schemas = {kind: input_schema(kind) for kind in NAMES}
        self._sequence = 0
        self._waiting_bytes = 0
        self._flushed_s = float("-inf")

    @property
    def size_bytes(self) -> int:
        """Of both."""
        return self._tlog.size_bytes + self._mcap.size_bytes

    def write(self, batch: list[_Entry]) -> None:
        for entry, unix_s in batch:
            if isinstance(entry, _Estimate):
                self._estimates.write(self._agent_id, entry.ready, entry.published_s, entry.inputs)
            elif isinstance(entry, _Sent):
                self._log_frames(entry.frames, unix_s)
            else:
                self._lay(entry, unix_s)
            if abs(unix_s - self._flushed_s) >= FLUSH_PERIOD_S:
                self._flushed_s = unix_s
                self._tlog.flush()  # first: what the .mcap speaks of is there then
                self._mcap.flush()

    def close(self, reason: str) -> None:
        with contextlib.ExitStack() as ends:  # one that fails keeps no other from being done
            ends.callback(self._mcap.close)
            ends.callback(self._mcap.metadata, END, {"reason": reason})
            ends.callback(self._tlog.close)

    def _lay(self, event: Input, unix_s: float) -> None:
        offset = self._tlog.size_bytes
        if isinstance(event, MavlinkIn):
            self._log_frames(event.frames, unix_s)
        laid, self._waiting_bytes = lay(event, offset, self._waiting_bytes)
        self._sequence += 1
        name = NAMES[type(laid)]
        channel = self._mcap.channel(
            input_topic(self._agent_id, name), f"fleetloc.input.{name}", self._schemas[type(laid)]
        )
        self._mcap.add(channel, round(unix_s * 1e9), msgspec.json.encode(laid), self._sequence & 0xFFFFFFFF)

    def _log_frames(self, frames: tuple[bytes, ...] | list[bytes], unix_s: float) -> None:
        for frame in frames:
            self._tlog.write(frame, unix_s)
