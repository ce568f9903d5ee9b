"""UTC of fixes on the clock of whoever takes them in, though the two may differ.

A companion without network or a ground station has a clock of its own; a receiver may have lost 1024 weeks. What the
stamps say of the time between fixes is right all the same. They are shifted by what the quickest of them were late,
as is the boot clock where nobody answers TIMESYNC: all samples are then late by the link's least latency.
"""

from __future__ import annotations

from collections import deque

ROLLOVER_S = 1024 * 604_800.0
"""The week in GPS signals has ten bits: a receiver that misses its turn is this much behind."""
EARLIEST_S, LATEST_S = -0.2, 0.5
"""How late the quickest fixes are where the clocks agree: a receiver takes 0.1 s, the link little."""
STEP_S = 2.0
"""Fixes that are later, or earlier, by more than this than those before come of a clock that was set."""
CONFIRM = 3
"""So many in a row that agree show what the difference is."""
WINDOW = 50
QUICKEST = 0.1
"""Share of the fixes that are quicker than what counts as the quickest: single wrong stamps are among them."""


def unrolled(unix_s: float, near_unix_s: float) -> float:
    """UTC of a receiver with the turns of its week that bring it nearest to a time that is about right."""
    return unix_s + ROLLOVER_S * round((near_unix_s - unix_s) / ROLLOVER_S)


def quickest_s(late_s: list[float]) -> float:
    """How late the quickest fixes were, of how late each was."""
    return sorted(late_s)[int(QUICKEST * len(late_s))]


def clocks_agree(late_s: float) -> bool:
    """Whether the quickest fixes may be this late because they took so long."""
    return EARLIEST_S <= late_s <= LATEST_S


class UtcStamps:
    """The fixes of one receiver, in the order of their arrival."""

    def __init__(self) -> None:
        self._late_s: deque[float] = deque(maxlen=WINDOW)
        self._apart_s: list[float] = []
        """How late the last ones were, if all of them are a step away from those before."""

    def shift_s(self, unix_s: float, arrival_unix_s: float) -> float | None:
        """What to add to a stamp: 0 if the clocks agree; ``None``, as yet unknown: arrival is all there is."""
        late_s = arrival_unix_s - unix_s
        if self._late_s and abs(late_s - quickest_s(list(self._late_s))) > STEP_S:
            self._apart_s = [each for each in self._apart_s if abs(each - late_s) <= STEP_S] + [late_s]
            if len(self._apart_s) >= CONFIRM:
                self._late_s.clear()
                self._late_s.extend(self._apart_s)
        else:
            self._apart_s = []
            self._late_s.append(late_s)
        quick_s = quickest_s(list(self._late_s))
        if clocks_agree(quick_s):
            return 0.0
        return quick_s if len(self._late_s) >= CONFIRM else None
