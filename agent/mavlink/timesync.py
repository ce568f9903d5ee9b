"""The autopilot's boot clock against the host's monotonic clock.

TIMESYNC exchanges give the offset and, over the window, the drift; without them the smallest seen
difference of arrival and boot time serves (it hides the link's smallest latency). Sans-I/O.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

WINDOW_S = 10.0
MAX_RTT_S = 0.010
"""A slower exchange is not used, unless none is much faster: one over a slow radio is as good as its best."""
FAST_PERIOD_S, SLOW_PERIOD_S = 0.1, 1.0
FAST_FOR_S = 10.0
MAX_PENDING = 32
MAX_DRIFT = 0.05
GUESSES = 10
"""Of a boot time: each is `MAX_DRIFT` times as far off as the one before at most, the first by the clocks' offset."""
JUMP_S = 0.1
JUMPS_TO_RESET = 5
MIN_FIT_SPAN_S = 2.0
MIN_FIT_EXCHANGES = 4


@dataclass(frozen=True, slots=True)
class Exchange:
    """One TIMESYNC round trip: ``offset_s`` is host minus boot time, at ``boot_s``."""

    boot_s: float
    offset_s: float
    rtt_s: float


class BootClock:
    """Converts boot time to host time, both in seconds."""

    def __init__(self) -> None:
        self.rejected = 0
        """Replies not asked for, too slow or out of line."""
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after a reboot of the autopilot."""
        self._pending: deque[int] = deque(maxlen=MAX_PENDING)
        self._exchanges: deque[Exchange] = deque()
        self._envelope: deque[tuple[int, float]] = deque()
        self._fit: tuple[float, float, float] | None = None
        self._jumps = 0
        self._started_s: float | None = None
        self._next_s = 0.0

    def request(self, now_s: float, tag: int) -> int | None:
        """``ts1`` of the request due now, ``None`` if none is; ``tag`` (0..255) makes it ours."""
        if self._started_s is None:
            self._started_s = self._next_s = now_s
        if now_s < self._next_s:
            return None
        fast = now_s - self._started_s < FAST_FOR_S
        self._next_s = now_s + (FAST_PERIOD_S if fast else SLOW_PERIOD_S)
        ts1 = round(now_s * 1e6) * 1000 + tag
        self._pending.append(ts1)
        return ts1

    def on_reply(self, tc1_ns: int, ts1_ns: int, now_s: float) -> None:
        """Take in the answer to one of our requests."""
        if ts1_ns not in self._pending:
            self.rejected += 1
            return
        self._pending.remove(ts1_ns)
        sent_s = (ts1_ns // 1000) * 1e-6
        rtt_s = now_s - sent_s
        best = min((e.rtt_s for e in self._exchanges), default=rtt_s)
        if not 0 <= rtt_s <= max(MAX_RTT_S, 2 * best):
            self.rejected += 1
            return
        boot_s = tc1_ns * 1e-9
        exchange = Exchange(boot_s, (sent_s + now_s) / 2 - boot_s, rtt_s)
        if self._fit is not None and abs(exchange.offset_s - self._offset_s(boot_s)) > JUMP_S + rtt_s:
            self.rejected += 1
            self._jumps += 1
            if self._jumps >= JUMPS_TO_RESET:  # not an outlier: the other clock was set anew
                self._exchanges.clear()
                self._take(exchange)
            return
        self._take(exchange)

    def on_arrival(self, boot_s: float, now_s: float) -> None:
        """Note when a message stamped ``boot_s`` arrived: the fallback without TIMESYNC."""
        bucket, difference = int(now_s), now_s - boot_s
        if not self._envelope or self._envelope[-1][0] != bucket:
            self._envelope.append((bucket, difference))
        elif difference < self._envelope[-1][1]:
            self._envelope[-1] = (bucket, difference)
        while self._envelope[0][0] < bucket - WINDOW_S:
            self._envelope.popleft()

    def host_s(self, boot_s: float) -> float | None:
        """Host time of a boot time; ``None`` before anything was heard."""
        if self._fit is not None:
            return boot_s + self._offset_s(boot_s)
        if self._envelope:
            return boot_s + min(difference for _, difference in self._envelope)
        return None

    def boot_s(self, host_s: float) -> float | None:
        """Boot time of a host time; ``None`` before anything was heard."""
        boot_s = host_s
        for _ in range(GUESSES):
            at_s = self.host_s(boot_s)
            if at_s is None:
                return None
            boot_s += host_s - at_s
        return boot_s

    @property
    def synchronised(self) -> bool:
        """Whether TIMESYNC was answered (otherwise the fallback is in use)."""
        return self._fit is not None

    @property
    def rtt_s(self) -> float | None:
        """Smallest round trip of the window."""
        return min((e.rtt_s for e in self._exchanges), default=None)

    def _take(self, exchange: Exchange) -> None:
        self._jumps = 0
        self._exchanges.append(exchange)
        while self._exchanges[0].boot_s < exchange.boot_s - WINDOW_S:
            self._exchanges.popleft()
        # The queueing delay of an exchange is at most its excess round trip: the quicker half is the cleaner.
        quick = sorted(self._exchanges, key=lambda e: e.rtt_s)[: max(1, (len(self._exchanges) + 1) // 2)]
        boot = np.array([e.boot_s for e in quick])
        offset = np.array([e.offset_s for e in quick])
        if len(quick) >= MIN_FIT_EXCHANGES and np.ptp(boot) >= MIN_FIT_SPAN_S:
            centred = boot - boot.mean()
            drift = float(np.clip(centred @ offset / (centred @ centred), -MAX_DRIFT, MAX_DRIFT))
            self._fit = (float(boot.mean()), float(offset.mean()), drift)
        else:
            self._fit = (quick[0].boot_s, quick[0].offset_s, 0.0)

    def _offset_s(self, boot_s: float) -> float:
        assert self._fit is not None
        reference_s, offset_s, drift = self._fit
        return offset_s + drift * (boot_s - reference_s)
