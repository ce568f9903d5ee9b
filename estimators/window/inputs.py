"""Accelerations of the fleet over the window's ticks: those that are known, and a guess for those that are not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, kernel
from estimators.model.measurements import INPUT, InputTable, Matrix, Vector, empty_inputs
from estimators.model.members import MemberChange
from estimators.model.row_kernels import IntArray

HISTORY_TICKS = 50
"""How far back accelerations are kept, to hold the last one and to learn how fast they change."""

CHANGES_NEEDED = 3
"""Known changes of an agent's acceleration before a held one is trusted more than none at all."""


class InputHistory:
    """Known accelerations per tick and agent; what arrives first counts.

    An unknown one is zero with its body's ``other_variance`` ``(n,)`` per axis, or, with ``hold``, the agent's last
    known one times ``fade`` for every tick since (1: as it was; less: exponentially correlated acceleration, Singer
    1970). Its
    variance then grows with the square of the ticks it is held: by the mean square error of that prediction over
    one tick that the agent's known accelerations show, and never beyond ``other_variance``. Everything follows
    from what is stored, so that the order of arrival does not matter.
    """

    def __init__(self, other_variance: Vector, *, hold: bool, fade: float = 1.0) -> None:
        self._known: InputTable = empty_inputs()
        """By tick, then agent."""
        self._agents = len(other_variance)
        self._other_variance = other_variance
        self._hold = hold
        self._fade = fade

    def insert(self, inputs: InputTable, first: int) -> tuple[int, int]:
        """Store accelerations; gives how many were refused, and how many dropped: those before ``first``."""
        if not len(inputs):
            return 0, 0
        table = np.empty(len(self._known) + len(inputs), INPUT)
        new = np.ascontiguousarray(inputs, INPUT)
        count, refused, dropped = _take_in(table, self._known, new, self._agents, first)
        self._known = table[:count]
        return refused, dropped

    def forget_before(self, tick: int) -> None:
        """Drop what is older than ``tick`` (with ``hold``, older than the history)."""
        limit = tick - (HISTORY_TICKS if self._hold else 0)
        if len(self._known) and self._known["tick"][0] < limit:
            self._known = self._known[np.searchsorted(self._known["tick"], limit) :]

    def change_members(self, change: MemberChange, other_variance: Vector) -> None:
        """Go on with another fleet: what is known of an agent's motion goes to its new slot.

        ``other_variance`` is that of the new fleet.
        """
        parts = [self._known[self._known["agent"] == before] for before in change.known.values()]
        for slot, part in zip(change.known, parts, strict=True):
            part["agent"] = slot
        table = np.concatenate([empty_inputs(), *parts])
        self._known = np.ascontiguousarray(table[np.lexsort((table["agent"], table["tick"]))], INPUT)
        self._agents, self._other_variance = change.after.size, other_variance

    def table(self, first: int, last: int) -> tuple[Matrix, Matrix]:
        """Accelerations ``(last - first, 3n)`` over the ticks from ``first`` on, and their variances."""
        shape = last - first, 3 * self._agents
        accel, variance = np.empty(shape), np.empty(shape)
        _fill(self._known, first, self._other_variance, self._hold, self._fade, accel, variance)
        return accel, variance


@entry("UniTuple(int64, 3)(INPUT[::1], INPUT[::1], INPUT[::1], int64, int64)", INPUT=INPUT)
def _take_in(
    table: InputTable, known: InputTable, inputs: InputTable, agents: int, first: int
) -> tuple[int, int, int]:
    """``table`` <- what is ``known``, sorted, and the inputs, of equal ones the earliest.

    Gives the number of them, how many inputs no estimator could use, and how many were of ticks before ``first``.
    """
    count, refused, dropped = known.shape[0], 0, 0
    for i in range(count):
        table[i] = known[i]
    for r in range(inputs.shape[0]):
        tick, agent = inputs[r]["tick"], inputs[r]["agent"]
        usable = 0 <= agent < agents
        for axis in range(3):
            variance = inputs[r]["variance"][axis]
            usable = usable and np.isfinite(inputs[r]["accel"][axis]) and np.isfinite(variance) and variance > 0.0
        if not usable:
            refused += 1
            continue
        if tick < first:
            dropped += 1
            continue
        at = count
        while at > 0 and (table[at - 1]["tick"], table[at - 1]["agent"]) > (tick, agent):
            at -= 1
        if at > 0 and table[at - 1]["tick"] == tick and table[at - 1]["agent"] == agent:
            continue  # known already
        for i in range(count, at, -1):
            table[i] = table[i - 1]
        table[at] = inputs[r]
        count += 1
    return count, refused, dropped


@entry(
    "void(INPUT[::1], int64, float64[::1], boolean, float64, float64[:, ::1], float64[:, ::1])",
    INPUT=INPUT,
)
def _fill(
    known: InputTable, first: int, other_variance: Vector, hold: bool, fade: float, accel: Matrix, variance: Matrix
) -> None:
    """`InputHistory.table`, both ``(ticks, 3n)``, from what is ``known``, sorted by tick."""
    ticks, agents = accel.shape[0], accel.shape[1] // 3
    missing = np.ones((agents, ticks), np.bool_)
    accel[:, :] = 0.0
    for agent in range(agents):
        variance[:, 3 * agent : 3 * agent + 3] = other_variance[agent]
    for r in range(known.shape[0]):
        k, agent = known[r]["tick"] - first, known[r]["agent"]
        if 0 <= k < ticks:
            missing[agent, k] = False
            for axis in range(3):
                accel[k, 3 * agent + axis] = known[r]["accel"][axis]
                variance[k, 3 * agent + axis] = known[r]["variance"][axis]
    if hold:
        for agent in range(agents):
            if missing[agent].any():
                _hold_last(known, agent, missing[agent], first, other_variance[agent], fade, accel, variance)


@kernel
def _hold_last(
    known: InputTable,
    agent: int,
    missing: NDArray[np.bool_],
    first: int,
    other_variance: float,
    fade: float,
    accel: Matrix,
    variance: Matrix,
) -> None:
    """Fill the ``missing`` ticks of an agent with its last acceleration before, and the variance of holding it."""
    own = np.flatnonzero(known["agent"] == agent)
    change = _mean_square_change(known, own, fade)
    if np.isnan(change):
        return
    for k in np.flatnonzero(missing):
        earlier = 0
        while earlier < own.shape[0] and known[own[earlier]]["tick"] < first + k:
            earlier += 1
        if earlier == 0:
            continue
        last = known[own[earlier - 1]]
        held = float(first + k - last["tick"])
        for axis in range(3):
            grown = last["variance"][axis] + change * held**2
            accel[k, 3 * agent + axis] = last["accel"][axis] * fade**held
            variance[k, 3 * agent + axis] = min(grown, other_variance)


@kernel
def _mean_square_change(known: InputTable, own: IntArray, fade: float) -> float:
    """Mean square per axis of what a tick changes beyond the fading, the sensor's noise included.

    ``own``: places of one agent's accelerations, in the order of time. NaN where too few changes are known.
    """
    total, changes = 0.0, 0
    for i in range(own.shape[0] - 1):
        before, after = known[own[i]], known[own[i + 1]]
        if after["tick"] == before["tick"] + 1:
            changes += 1
            for axis in range(3):
                total += (after["accel"][axis] - fade * before["accel"][axis]) ** 2
    return total / (3 * changes) if changes >= CHANGES_NEEDED else np.nan
