"""A module's own clock on the host's: when a module measured, of when it says so and when that arrived.

What a module sends takes its time, never less than on an idle line. So the least difference of arrival and stamp is
the offset of the two clocks, up to that least time; what arrives later was only delayed. The offset is of the last
`WINDOW_S` to twice that, in which the clocks drift apart by less than a millisecond.
"""

from __future__ import annotations

import math

WINDOW_S = 5.0
MAX_JUMP_S = 1.0
"""A stamp further off is no delay, but a module that began anew, or no stamp."""
CONFIRM_S = 0.25
AGREES_S = 0.05


class ModuleClock:
    """Offset of one module's clock, from its readings; sans-I/O.

    A clock counts only once two stamps at least `CONFIRM_S` apart agree, at the first and after a jump. So no frame
    whose stamp is damaged is taken for a module that has started anew.
    """

    def __init__(self, wrap_s: float | None = None) -> None:
        self._wrap_s = wrap_s
        self._least_s = self._now_least_s = math.inf
        """Least difference in the window before this one, and in this one."""
        self._window_from_s = -math.inf
        self._doubted: tuple[float, float] | None = None
        """Arrival and difference of a stamp that did not agree."""
        self.jumps = 0

    def taken_s(self, clock_s: float, arrival_s: float) -> float | None:
        """When a reading was taken, on the host's clock; ``None`` while that is not known."""
        offset_s = self._offset()
        difference_s = arrival_s - clock_s
        if math.isfinite(offset_s):
            difference_s = self._unwrapped(difference_s, offset_s)
            if abs(difference_s - offset_s) <= MAX_JUMP_S:
                self._doubted = None
                self._note(difference_s, arrival_s)
                return arrival_s - difference_s + self._offset()
        return self._doubt(difference_s, arrival_s)

    def _offset(self) -> float:
        return min(self._least_s, self._now_least_s)

    def _unwrapped(self, difference_s: float, near_s: float) -> float:
        if self._wrap_s is None:
            return difference_s
        return difference_s - self._wrap_s * round((difference_s - near_s) / self._wrap_s)

    def _note(self, difference_s: float, arrival_s: float) -> None:
        age_s = arrival_s - self._window_from_s
        if age_s >= WINDOW_S:
            self._least_s = self._now_least_s if age_s < 2.0 * WINDOW_S else math.inf
            self._now_least_s, self._window_from_s = math.inf, arrival_s
        self._now_least_s = min(self._now_least_s, difference_s)

    def _doubt(self, difference_s: float, arrival_s: float) -> float | None:
        if self._doubted is not None:
            since_s, doubted_s = self._doubted
            difference_s = self._unwrapped(difference_s, doubted_s)
            if abs(difference_s - doubted_s) <= AGREES_S:
                if arrival_s - since_s < CONFIRM_S:
                    return None
                self._least_s = self._now_least_s = math.inf
                self._window_from_s, self._doubted = arrival_s, None
                self.jumps += 1
                self._now_least_s = min(difference_s, doubted_s)
                return arrival_s - difference_s + self._now_least_s
        self._doubted = arrival_s, difference_s
        return None
