"""How large the slow errors of a fleet's sensors are: the sizes of their priors, which follow the data.

A prior that is too small makes an estimate sure of what it does not know; one that is too large throws away what a
good sensor says (receivers without wander: 0.7 m instead of 0.14 m). So each size follows its sensor: the wander of
every receiver by `estimators.systematic.receiver_wander`, the others by the second moments that their estimates have
(expectation maximisation).
"""

from __future__ import annotations

import numpy as np

from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.members import MemberChange
from estimators.model.row_kernels import POSITION
from estimators.model.unknown_motion import TILTED_MPS2
from estimators.systematic import slow_errors
from estimators.systematic.receiver_wander import ReceiverWanders

COMMON_SHARE = 0.5
"""Of the variance of a receiver's wander, what all receivers under the same sky share."""
OWN_SHARE = 0.25
"""Of it, what is its own at least."""
PAIR_M = 0.3, 0.03, 0.6
"""Size of the bias of ranges: at the start, at least, at most."""
PAIR_OF_WANDER = 0.5
"""Where receivers wander, ranges cannot tell their bias from the places of their ends: it is taken to be so much of
the wander at least, but no more than at the start."""
ACCEL_MPS2 = 0.15, 0.02, 1.0
"""The same of the error of an acceleration."""
LOST_S = 1.0
"""Without fixes for longer, an autopilot's attitude is taken for that of an estimator without aiding."""
MEMORY_S = 3.0
"""Of the second moments."""


class SystematicSizes:
    """The sizes of one fleet's slow errors, as one agent learns them."""

    def __init__(self, agents: int, period_s: float) -> None:
        self._share = period_s / MEMORY_S
        self._wanders = ReceiverWanders(agents, period_s)
        self._pair_m = PAIR_M[0]
        self._accel_mps2 = np.full(agents, ACCEL_MPS2[0])
        self._lost_ticks = np.zeros(agents, np.int64)
        """Since the last fix that left the window."""
        self._most_ticks = round(LOST_S / period_s)
        self._made: Vector | None = None
        """What `sizes` gives until something is learned."""

    def learn(self, rows: RowTable, accel: Vector, accel_variance: Vector, errors: Vector, variance: Vector) -> None:
        """Take in a tick that leaves the window: its rows, its accelerations ``(3n,)`` and their variances.

        ``errors``, ``variance`` ``(q,)``: the slow errors as they are estimated now.
        """
        self._made = None
        self._wanders.weigh(rows, accel, accel_variance)
        self._lost_ticks += 1
        self._lost_ticks[rows["agent"][rows["kind"] == POSITION]] = 0
        agents, moments = len(self._accel_mps2), errors**2 + variance
        accelerations = moments[3 * agents : 6 * agents].reshape(agents, 3).mean(axis=1)
        mixed = (1.0 - self._share) * self._accel_mps2**2 + self._share * accelerations
        self._accel_mps2 = np.clip(np.sqrt(mixed), *ACCEL_MPS2[1:])
        if agents > 1:
            median = float(np.median(moments[slow_errors.pairs(agents)]))
            told_m = float(np.sqrt((1.0 - self._share) * self._pair_m**2 + self._share * median))
            hidden_m = min(PAIR_OF_WANDER * float(np.median(self._wanders.sizes_m()[:, :2])), PAIR_M[0])
            self._pair_m = min(max(told_m, hidden_m, PAIR_M[1]), PAIR_M[2])

    def sizes(self) -> Vector:
        """Standard deviations ``(q,)`` of the slow errors."""
        if self._made is None:
            self._made = self._make()
        return self._made.copy()

    def _make(self) -> Vector:
        wander = self._wanders.sizes_m() ** 2
        agents = len(wander)
        shared = COMMON_SHARE * np.median(wander, axis=0) if agents > 1 else np.zeros(3)
        out = np.empty(slow_errors.count(agents))
        out[: 3 * agents] = np.sqrt(np.maximum(wander - shared, OWN_SHARE * wander)).ravel()
        tilted = np.where(self._lost_ticks > self._most_ticks, TILTED_MPS2, 0.0)
        across = np.maximum(self._accel_mps2, tilted)
        out[3 * agents : 6 * agents] = np.stack((across, across, self._accel_mps2), axis=1).ravel()
        out[slow_errors.common(agents)] = np.sqrt(np.maximum(shared, 1e-6))
        out[slow_errors.pairs(agents)] = self._pair_m
        return out

    def white_factors(self) -> Matrix:
        """Standard deviation ``(n, 3)`` of the white noise of the fixes over what their receiver claims."""
        return self._wanders.white_factors()

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet."""
        self._made, known = None, change.stayed
        self._wanders.change_members(known, change.after.size)
        self._accel_mps2 = np.array(
            [self._accel_mps2[known[slot]] if slot in known else ACCEL_MPS2[0] for slot in range(change.after.size)]
        )
        lost = self._lost_ticks
        self._lost_ticks = np.array([lost[known[s]] if s in known else 0 for s in range(change.after.size)])
