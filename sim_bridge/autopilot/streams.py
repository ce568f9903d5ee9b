"""The rates at which an autopilot sends its messages, and which of them are due."""

from __future__ import annotations

import math

from agent.mavlink.dialect import mavlink
from sim_bridge.autopilot.flavours import Flavour

TOLERANCE_S = 1e-6
EVENT_DRIVEN = frozenset({mavlink.MAVLINK_MSG_ID_GPS_RAW_INT})
"""Sent when their sensor has something new; the interval only thins them out."""


class StreamTable:
    """Interval and next time of every message an autopilot can stream."""

    def __init__(self, flavour: Flavour, rate_limits_hz: dict[int, float]) -> None:
        """``rate_limits_hz``: the sensors' own rates; a message carries a new sample, so none is faster."""
        self._flavour = flavour
        self._limits_hz = rate_limits_hz
        self._interval_s: dict[int, float] = {}
        self._next_s: dict[int, float] = {}
        self._earliest_s = -math.inf
        self.reset()

    def reset(self) -> None:
        """Back to the default rates, as after a boot."""
        self._interval_s.clear()
        self._next_s.clear()
        for message_id, rate_hz in self._flavour.default_rates_hz.items():
            if rate_hz > 0.0:
                self._start(message_id, 1.0 / rate_hz)
        self._earliest_s = -math.inf

    def set_interval(self, message_id: int, interval_us: float) -> int:
        """What SET_MESSAGE_INTERVAL does; the MAV_RESULT. ``interval_us`` 0 = default rate, -1 = off."""
        default_hz = self._flavour.default_rates_hz.get(message_id)
        if default_hz is None:
            return self._flavour.refuse_stream
        if not math.isfinite(interval_us) or interval_us < -1.0:
            return int(mavlink.MAV_RESULT_DENIED)
        if interval_us == 0.0:
            interval_us = 1e6 / default_hz if default_hz > 0.0 else -1.0
        self._next_s.pop(message_id, None)
        if interval_us > 0.0:
            quantum_us = self._flavour.interval_quantum_us
            whole_us = max(round(interval_us / quantum_us), 1) * quantum_us
            self._start(message_id, max(1e-6 * whole_us, 1.0 / self._flavour.max_rate_hz))
        else:
            self._interval_s.pop(message_id, None)
        self._earliest_s = -math.inf
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _start(self, message_id: int, interval_s: float) -> None:
        limit_hz = self._limits_hz.get(message_id)
        self._interval_s[message_id] = interval_s if limit_hz is None else max(interval_s, 1.0 / limit_hz)

    def interval_us(self, message_id: int) -> int:
        """What MESSAGE_INTERVAL says: microseconds, -1 = off, 0 = not available."""
        if message_id not in self._flavour.default_rates_hz:
            return 0
        interval_s = self._interval_s.get(message_id)
        return -1 if interval_s is None else round(1e6 * interval_s)

    def due(self, now: float) -> list[int]:
        """Message ids whose time has come; each keeps its own grid, late ones are not sent twice."""
        if now + TOLERANCE_S < self._earliest_s:
            return []
        ids = []
        for message_id, interval_s in self._interval_s.items():
            if message_id in EVENT_DRIVEN:
                continue
            next_s = self._next_s.get(message_id, now)
            if now + TOLERANCE_S >= next_s:
                ids.append(message_id)
                next_s = max(next_s + interval_s, now)
            self._next_s[message_id] = next_s
        clocked = (next_s for message_id, next_s in self._next_s.items() if message_id not in EVENT_DRIVEN)
        self._earliest_s = min(clocked, default=math.inf)
        return ids

    def take(self, message_id: int, now: float) -> bool:
        """Whether an event-driven message may go out now that it has something new to say."""
        interval_s = self._interval_s.get(message_id)
        if interval_s is None:
            return False
        next_s = self._next_s.get(message_id, now)
        slack_s = 0.5 / self._limits_hz[message_id] - TOLERANCE_S
        if now + slack_s < next_s:
            return False
        self._next_s[message_id] = max(next_s + interval_s, now)
        return True
