"""Asking the autopilot for message rates, one at a time, and seeing that they come.

COMMAND_ACK does not say which message an interval was for, so only one request is open at a time. Sans-I/O.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from agent.mavlink.codec import mavlink

ACK_TIMEOUT_S = 0.5
ATTEMPTS = 3
MEASURE_S = 2.0
RATE_FLOOR = 0.6
"""A stream below this share of its wanted rate is asked for again: autopilots round rates to their loop's."""
REPEAT_S = 30.0
"""Another client may fight for the rates; ask again no more often than this."""
REPEAT_SILENT_S = (2.0, 4.0, 8.0)
"""One of which nothing comes is asked for again sooner at first: an autopilot that boots accepts what it forgets."""


@dataclass(slots=True)
class StreamState:
    """One requested stream; ``rate_hz`` is what arrived over the last two seconds, ``None`` before."""

    message_id: int
    wanted_hz: float
    attempts: int = 0
    settled_s: float | None = None
    result: int | None = None
    """MAV_RESULT of the last answer, ``None`` if there was none."""
    rate_hz: float | None = None
    counted: int = 0
    count_from_s: float = field(default=0.0)
    silent: bool = True
    """Whether nothing has come since it was asked for, or for as long as rates are measured."""
    repeats: int = 0
    """How often it was asked for again because it was silent."""

    @property
    def refused(self) -> bool:
        """Whether the autopilot answered that it does not send this message."""
        return self.result not in (None, mavlink.MAV_RESULT_ACCEPTED)

    @property
    def slow(self) -> bool:
        """Whether it comes at less than the accepted share of its rate."""
        return self.rate_hz is not None and self.rate_hz < RATE_FLOOR * self.wanted_hz


class StreamRates:
    """Requests ``(message id, Hz)`` in order, and repeats those that do not come."""

    def __init__(self, wanted: dict[int, float]) -> None:
        self.streams = {mid: StreamState(mid, hz) for mid, hz in wanted.items() if hz > 0}
        self._open: StreamState | None = None
        self._sent_s = 0.0

    def add(self, message_id: int, wanted_hz: float) -> None:
        """Ask for one more stream, unless it is asked for already."""
        if message_id not in self.streams:
            self.streams[message_id] = StreamState(message_id, wanted_hz)

    def restart(self, now_s: float) -> None:
        """Ask for everything anew, as after a reboot or a lost link."""
        self._open = None
        for stream in self.streams.values():
            stream.attempts, stream.settled_s, stream.result = 0, None, None
            stream.rate_hz, stream.counted, stream.count_from_s = None, 0, now_s
            stream.silent, stream.repeats = True, 0

    def on_message(self, message_id: int) -> None:
        """Count an arrival."""
        stream = self.streams.get(message_id)
        if stream is not None:
            stream.counted += 1
            stream.silent, stream.repeats = False, 0

    def on_ack(self, result: int, now_s: float) -> None:
        """Take the answer to the open request."""
        if self._open is not None:
            self._open.result = result
            self._settle(self._open, now_s)

    def poll(self, now_s: float) -> tuple[int, float] | None:
        """The request to send now: message id and interval in microseconds."""
        self._measure(now_s)
        if self._open is not None:
            if now_s - self._sent_s < ACK_TIMEOUT_S:
                return None
            if self._open.attempts >= ATTEMPTS:
                self._open.result = None
                self._settle(self._open, now_s)
        if self._open is None:
            due = [stream for stream in self.streams.values() if self._is_due(stream, now_s)]
            if not due:
                return None
            # who has waited longest, those first that were never asked for: a silent one may not hold up the others
            self._open = min(due, key=lambda each: -math.inf if each.settled_s is None else each.settled_s)
            self._open.repeats += self._open.settled_s is not None and self._open.silent
            self._open.attempts = 0
        self._open.attempts += 1
        self._sent_s = now_s
        return self._open.message_id, 1e6 / self._open.wanted_hz

    def refused(self, message_id: int) -> bool:
        """Whether the autopilot answered that it does not send this message."""
        stream = self.streams.get(message_id)
        return stream is not None and stream.refused

    def slow(self) -> list[StreamState]:
        """Streams that the autopilot sends at less than the accepted share of their rate, or not at all.

        Those that it refuses are not among them: something else was asked for in their place.
        """
        return [stream for stream in self.streams.values() if stream.slow and not stream.refused]

    def _settle(self, stream: StreamState, now_s: float) -> None:
        stream.settled_s = now_s
        stream.counted, stream.count_from_s, stream.rate_hz = 0, now_s, None
        stream.silent = True
        self._open = None

    def _is_due(self, stream: StreamState, now_s: float) -> bool:
        if stream.settled_s is None:
            return True
        early = stream.silent and not stream.refused and stream.repeats < len(REPEAT_SILENT_S)
        if early:
            # a slow stream has not had the time to come yet
            return now_s - stream.settled_s >= max(REPEAT_SILENT_S[stream.repeats], 2 / stream.wanted_hz)
        return stream.slow and now_s - stream.settled_s >= REPEAT_S

    def _measure(self, now_s: float) -> None:
        for stream in self.streams.values():
            elapsed_s = now_s - stream.count_from_s
            # Streams of 1 Hz and less need longer for a count that means anything.
            if elapsed_s >= max(MEASURE_S, 4 / stream.wanted_hz):
                stream.rate_hz = stream.counted / elapsed_s
                stream.silent = stream.counted == 0
                stream.counted, stream.count_from_s = 0, now_s
