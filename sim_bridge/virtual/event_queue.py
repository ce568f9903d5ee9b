"""Virtual time: what is to be done when, in one order that repeats."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable


class EventQueue:
    """What is to be done when; ``now_s`` is the virtual monotonic clock."""

    def __init__(self, start_s: float) -> None:
        self.now_s = start_s
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def at(self, time_s: float, act: Callable[[], None]) -> None:
        """Do something at a virtual time; what is due together is done in the order in which it was asked for."""
        heapq.heappush(self._events, (time_s, next(self._order), act))

    def run_until(self, last_s: float) -> None:
        """Do everything that is due up to a time, in order."""
        while self._events and self._events[0][0] <= last_s:
            time_s, _, act = heapq.heappop(self._events)
            self.now_s = max(self.now_s, time_s)
            act()

    def leap(self, to_s: float) -> None:
        """Set the clock forward; what was due in between is done at once, late, when the queue goes on."""
        self.now_s = max(self.now_s, to_s)
