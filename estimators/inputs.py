"""Accelerations of the fleet over the window's ticks: those that are known, and a guess for those that are not."""

from __future__ import annotations

import numpy as np

from estimators.measurements import Matrix, Vector

HISTORY_TICKS = 50
"""How far back accelerations are kept, to hold the last one and to learn how fast they change."""

CHANGES_NEEDED = 3
"""Known changes of an agent's acceleration before a held one is trusted more than none at all."""


class InputHistory:
    """Known accelerations per tick and agent; what arrives first counts.

    An unknown one is zero with ``other_variance`` per axis, or, with ``hold``, the agent's last known one times
    ``fade`` for every tick since (1: as it was; less: exponentially correlated acceleration, Singer 1970). Its
    variance then grows with the square of the ticks it is held: by the mean square error of that prediction over
    one tick that the agent's known accelerations show, and never beyond ``other_variance``. Everything follows
    from what is stored, so that the order of arrival does not matter.
    """

    def __init__(self, agents: int, other_variance: float, *, hold: bool, fade: float = 1.0) -> None:
        self._known: list[dict[int, tuple[Vector, Vector]]] = [{} for _ in range(agents)]
        self._other_variance = other_variance
        self._hold = hold
        self._fade = fade

    def insert(self, tick: int, slot: int, accel: Vector, variance: Vector) -> None:
        """Store an acceleration ``(3,)``, NED m/s2, over the tick that starts at ``tick``, and its variance."""
        self._known[slot].setdefault(tick, (accel.copy(), variance.copy()))

    def forget_before(self, tick: int) -> None:
        """Drop what is older than ``tick`` (with ``hold``, older than the history)."""
        limit = tick - (HISTORY_TICKS if self._hold else 0)
        for known in self._known:
            for old in [each for each in known if each < limit]:
                del known[old]

    def table(self, first: int, last: int) -> tuple[Matrix, Matrix]:
        """Accelerations ``(last - first, 3n)`` over the ticks from ``first`` on, and their variances."""
        ticks, n = last - first, len(self._known)
        accel = np.zeros((ticks, 3 * n))
        variance = np.full((ticks, 3 * n), self._other_variance)
        for slot, known in enumerate(self._known):
            columns = slice(3 * slot, 3 * slot + 3)
            missing = []
            for k in range(ticks):
                found = known.get(first + k)
                if found is None:
                    missing.append(k)
                else:
                    accel[k, columns], variance[k, columns] = found
            change = self._mean_square_change(slot) if self._hold and missing else None
            if change is None:
                continue
            for k in missing:
                held = self._held(slot, first + k, change)
                if held is not None:
                    accel[k, columns], variance[k, columns] = held
        return accel, variance

    def _held(self, slot: int, tick: int, change: float) -> tuple[Vector, Vector] | None:
        """The last acceleration known before ``tick``, with the variance of holding it.

        ``change``: mean square of what one tick changes.
        """
        known = self._known[slot]
        before = [each for each in known if each < tick]
        if not before:
            return None
        last = max(before)
        accel, variance = known[last]
        held = tick - last
        return accel * self._fade**held, np.minimum(variance + change * held**2, self._other_variance)

    def _mean_square_change(self, slot: int) -> float | None:
        """Mean square per axis of what a tick changes beyond the fading, the sensor's noise included.

        Summed in the order of time: that of arrival would show in the last bits.
        """
        known = self._known[slot]
        pairs = [tick for tick in sorted(known) if tick + 1 in known]
        changes = [known[tick + 1][0] - self._fade * known[tick][0] for tick in pairs]
        return float(np.mean(np.square(changes))) if len(changes) >= CHANGES_NEEDED else None
