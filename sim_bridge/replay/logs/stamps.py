"""Stamps of a recorder made into one clock that never goes back.

A computer's clock is set while it records, a bit flips, a log is made of two: the stamps jump. A jump counts
only once several stamps in a row agree on it; then the vehicles' own clocks tell a pause of the recorder (time
really passed) from a clock that was set.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import TypeVar

TOLERANCE_US = 3_000_000
"""Steps up to this, either way, are taken as they are, so that after a damaged stamp the way back is open too."""
OUTLIER_US = 50_000
"""Neighbours this close are merely out of order, or the recorder was busy."""
CONFIRM = 3
"""Consecutive stamps that must agree before a larger step is believed."""
CONFIRM_WITHOUT_EVIDENCE = 50
"""So many stamps that agree are believed even if none of their messages bears a boot time."""
LONGEST_PAUSE_US = 24 * 3600 * 1_000_000
MAX_DRIFT = 0.05


HALF_WINDOW = 2
"""Stamps looked at before and behind each one: two damaged ones in a row are still found out."""
T = TypeVar("T")


def without_outliers(
    stamped: Iterable[T], stamp_us: Callable[[T], int], restamped: Callable[[T, int], T], notes: Counter[str]
) -> Iterator[T]:
    """The same items; a stamp far from the median of five around it is replaced by that.

    Two items are held back for it. ``notes`` counts the replaced ones.
    """
    items: deque[T] = deque()
    stamps: deque[int] = deque(maxlen=2 * HALF_WINDOW + 1)
    for item in stamped:
        items.append(item)
        stamps.append(stamp_us(item))
        if len(items) > HALF_WINDOW:
            yield _judged(items.popleft(), stamps[-1 - HALF_WINDOW], stamps, restamped, notes)
    for left in range(len(items), 0, -1):
        yield _judged(items.popleft(), stamps[-left], stamps, restamped, notes)


def _judged(
    item: T, own_us: int, around_us: Iterable[int], restamped: Callable[[T, int], T], notes: Counter[str]
) -> T:
    ordered = sorted(around_us)
    median_us = ordered[len(ordered) // 2]
    if abs(own_us - median_us) <= OUTLIER_US or len(ordered) < 3:
        return item
    notes["stamps replaced"] += 1
    return restamped(item, median_us)


LOOK_AHEAD = 1000
"""Lines of a table; 20 s of the usual 50 Hz."""
COSTLY_LINES = 2
"""A stamp that would cost so many of those behind it is left out, which costs one."""


def rising(stamped: Iterable[tuple[float, T]], skipped: Counter[str]) -> Iterator[tuple[float, T]]:
    """The items of a table whose times in seconds rise; the others are left out and counted.

    A single stamp from the future must not cost the rest of the table: one is left out if several of the next
    `LOOK_AHEAD` lie between the last one taken and it. Unlike in `without_outliers` the pace of the stamps does not
    matter, as a table may have one per second, or gaps.
    """
    source = iter(stamped)
    held: deque[tuple[float, T]] = deque()
    ordered: list[float] = []
    last_s = -math.inf
    while True:
        for one in islice(source, LOOK_AHEAD + 1 - len(held)):
            held.append(one)
            insort(ordered, one[0])
        if not held:
            return
        t_s, item = held.popleft()
        del ordered[bisect_left(ordered, t_s)]
        if t_s <= last_s:
            skipped["time not rising"] += 1
        elif bisect_left(ordered, t_s) - bisect_right(ordered, last_s) >= COSTLY_LINES:
            skipped["time ahead of the lines behind it"] += 1
        else:
            last_s = t_s
            yield t_s, item


class StampRepair:
    """Stamps in microseconds to log time in seconds.

    Without ``zero_us`` log time 0 is the first stamp. ``confirm_blind`` is how many stamps must agree where no boot
    time tells a pause from a jump. ``notes`` counts what was repaired.
    """

    def __init__(
        self, notes: Counter[str], *, zero_us: int | None = None, confirm_blind: int = CONFIRM_WITHOUT_EVIDENCE
    ) -> None:
        self._notes = notes
        self._confirm_blind = confirm_blind
        self._zero_us = zero_us
        self._last_us: int | None = None
        self._shift_us = 0
        self._suspect_us = 0
        self._suspects = 0
        self._boot: dict[int, tuple[float, int]] = {}
        self._stamps_by_shift: Counter[int] = Counter()

    def place(self, stamp_us: int, system_id: int = 0, boot_s: float | None = None) -> float | None:
        """Log time of a stamp, never less than the one before; ``None`` while it is not believed.

        ``boot_s`` is the boot time that the stamped message of ``system_id`` bears, where it bears one.
        """
        if self._last_us is not None:
            t_us = stamp_us - (self._zero_us or 0) + self._shift_us
            if -TOLERANCE_US <= t_us - self._last_us <= TOLERANCE_US:
                return self._take(max(t_us, self._last_us), system_id, boot_s)
            expected_us = self._expected_us(system_id, boot_s)
            if expected_us is not None and t_us > self._last_us and abs(t_us - expected_us[0]) <= expected_us[1]:
                return self._take(t_us, system_id, boot_s)  # the vehicle's clock says the same
            return self._doubt(stamp_us, system_id, boot_s)
        if self._zero_us is None:
            self._zero_us = stamp_us
        return self._take(stamp_us - self._zero_us, system_id, boot_s)

    @property
    def shift_s(self) -> float:
        """What has been added to the stamps so far, for the jumps of the clock."""
        return self._shift_us * 1e-6

    @property
    def zero_stamp_s(self) -> float | None:
        """The stamp, in seconds, of log time 0 by the setting of the clock that held longest."""
        if not self._stamps_by_shift:
            return None
        shift_us = self._stamps_by_shift.most_common(1)[0][0]
        return ((self._zero_us or 0) - shift_us) * 1e-6

    def _take(self, t_us: int, system_id: int, boot_s: float | None) -> float:
        self._suspects = 0
        self._last_us = t_us
        self._stamps_by_shift[self._shift_us] += 1
        if boot_s is not None:
            self._boot[system_id] = (boot_s, t_us)
        return t_us * 1e-6

    def _doubt(self, stamp_us: int, system_id: int, boot_s: float | None) -> float | None:
        agrees = self._suspects and abs(stamp_us - self._suspect_us) <= TOLERANCE_US
        self._suspects = self._suspects + 1 if agrees else 1
        self._suspect_us = stamp_us
        evidence = boot_s is not None and system_id in self._boot
        if self._suspects < (CONFIRM if evidence else self._confirm_blind):
            return None
        return self._take(self._after_jump_us(stamp_us, system_id, boot_s), system_id, boot_s)

    def _expected_us(self, system_id: int, boot_s: float | None) -> tuple[int, int] | None:
        """Log time by the vehicle's clock, and how far that can be off; ``None`` if it does not tell."""
        if boot_s is None or system_id not in self._boot:
            return None
        last_boot_s, then_us = self._boot[system_id]
        advance_us = round((boot_s - last_boot_s) * 1e6)
        if advance_us < 0:  # it was rebooted
            return None
        return then_us + advance_us, TOLERANCE_US + round(MAX_DRIFT * advance_us)

    def _after_jump_us(self, stamp_us: int, system_id: int, boot_s: float | None) -> int:
        """Log time behind a jump that is believed; a set clock is shifted so that log time goes on."""
        assert self._last_us is not None
        t_us = stamp_us - (self._zero_us or 0) + self._shift_us
        expected_us = self._expected_us(system_id, boot_s)
        if expected_us is None and 0 < t_us - self._last_us <= LONGEST_PAUSE_US:
            self._notes["pauses of the recorder"] += 1
            return t_us
        self._notes["clock jumps"] += 1
        goes_on_us = self._last_us if expected_us is None else max(expected_us[0], self._last_us)
        self._shift_us += goes_on_us - t_us
        return goes_on_us
