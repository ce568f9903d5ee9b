"""How large the slow errors of a fleet's sensors are: the sizes of their priors, which follow the data.

A prior that is too small makes an estimate sure of what it does not know; one that is too large throws away what a
good sensor says (receivers without wander: 0.7 m instead of 0.14 m). So each size follows its sensor: the wander of
every receiver by `estimators.systematic.receiver_wander`, the others by the second moments that their estimates have
(expectation maximisation).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry
from estimators.model.layout import Layout
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
TARGET_SENSOR_M = 0.5
"""Of the bias of all ranges to a body that is no vehicle: of another sensor, of which the fleet's tell nothing."""
TARGET_PAIR_M = 0.1
"""Of what the bias of the ranges of one drone to it differs from that."""
DRIFT_M, SCALE = 10.0, 0.04
"""Of a barometer: 10 m cover where it is put at first, and are, with its time constant, 0.4 m in a minute and 3 m in
an hour; 4 % of the height are 12 K."""
MEMORY_S = 3.0
"""Of the second moments."""


class SystematicSizes:
    """The sizes of one fleet's slow errors, as one agent learns them."""

    def __init__(self, layout: Layout, period_s: float) -> None:
        agents = layout.size
        self._share = period_s / MEMORY_S
        self._wanders = ReceiverWanders(agents, period_s)
        self._pair_m = PAIR_M[0]
        self._is_vehicle, self._of_target = layout.is_vehicle, _pairs_with_others(layout)
        self._accel_mps2: Vector = np.full(agents, ACCEL_MPS2[0])
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
        moments, agents = errors**2 + variance, len(self._accel_mps2)
        if self._of_target.all():
            agents_pairs = np.array([self._pair_m**2])
        else:
            agents_pairs = moments[slow_errors.pairs(agents)][~self._of_target]
        moments = np.concatenate((moments[: slow_errors.pairs(agents).start], agents_pairs))
        self._pair_m = _follow(moments, self._share, self._wanders.sizes_m(), self._pair_m, self._accel_mps2)

    def sizes(self) -> Vector:
        """Standard deviations ``(q,)`` of the slow errors."""
        if self._made is None:
            self._made = self._make()
        return self._made.copy()

    def _make(self) -> Vector:
        agents = len(self._accel_mps2)
        out = np.empty(slow_errors.count(agents))
        tilted = np.where(self._lost_ticks > self._most_ticks, TILTED_MPS2, 0.0)
        _fill(self._wanders.sizes_m(), self._accel_mps2, tilted, self._pair_m, out)
        out[slow_errors.pairs(agents)][self._of_target] = TARGET_PAIR_M
        out[slow_errors.drifts(agents)] = np.where(self._is_vehicle, DRIFT_M, TARGET_SENSOR_M)
        out[slow_errors.scales(agents)] = SCALE
        return out

    def white_factors(self) -> Matrix:
        """Standard deviation ``(n, 3)`` of the white noise of the fixes over what their receiver claims."""
        return self._wanders.white_factors()

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet."""
        self._made, known = None, change.stayed
        self._is_vehicle, self._of_target = change.after.is_vehicle, _pairs_with_others(change.after)
        self._wanders.change_members(known, change.after.size)
        self._accel_mps2 = np.array(
            [self._accel_mps2[known[slot]] if slot in known else ACCEL_MPS2[0] for slot in range(change.after.size)]
        )
        lost = self._lost_ticks
        self._lost_ticks = np.array([lost[known[s]] if s in known else 0 for s in range(change.after.size)])


def _pairs_with_others(layout: Layout) -> NDArray[np.bool_]:
    """Which pairs of bodies have one that is no vehicle."""
    one, other = np.triu_indices(layout.size, 1)
    return np.asarray(~(layout.is_vehicle[one] & layout.is_vehicle[other]))


@entry("float64(float64[::1], float64, float64[:, ::1], float64, float64[::1])")
def _follow(moments: Vector, share: float, wander: Matrix, pair_m: float, accel_mps2: Vector) -> float:
    """The size of the bias of ranges, and accel_mps2 ``(n,)`` <- those of accelerations, a tick later.

    ``moments`` ``(q,)`` second ones of the estimates, of which each size takes a ``share``.
    """
    agents = accel_mps2.shape[0]
    for a in range(agents):
        total = 0.0
        for i in range(3):
            total += moments[3 * (agents + a) + i] / 3.0
        size = np.sqrt((1.0 - share) * accel_mps2[a] ** 2 + share * total)
        accel_mps2[a] = min(max(size, ACCEL_MPS2[1]), ACCEL_MPS2[2])
    if agents < 2:
        return pair_m
    told = np.sqrt((1.0 - share) * pair_m**2 + share * np.median(moments[6 * agents + 3 :]))
    hidden = min(PAIR_OF_WANDER * np.median(wander[:, :2].copy()), PAIR_M[0])
    return float(min(max(told, hidden, PAIR_M[1]), PAIR_M[2]))


@entry("void(float64[:, ::1], float64[::1], float64[::1], float64, float64[::1])")
def _fill(wander: Matrix, accel_mps2: Vector, tilted: Vector, pair_m: float, out: Vector) -> None:
    """out ``(q,)`` <- sizes of all errors; ``tilted`` ``(n,)``: of horizontal accelerations at least, m/s2."""
    agents = wander.shape[0]
    for i in range(3):
        shared = COMMON_SHARE * np.median(wander[:, i] ** 2) if agents > 1 else 0.0
        for a in range(agents):
            square = wander[a, i] ** 2
            out[3 * a + i] = np.sqrt(max(square - shared, OWN_SHARE * square))
            out[3 * (agents + a) + i] = accel_mps2[a] if i == 2 else max(accel_mps2[a], tilted[a])
        out[6 * agents + i] = np.sqrt(max(shared, 1e-6))
    out[6 * agents + 3 :] = pair_m
