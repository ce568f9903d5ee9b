"""How far a receiver's fixes wander: a bank of filters over one receiver's own fixes, velocities and accelerations.

Fixes that claim 0.4 m may be white noise of 0.4 m, or wander by metres over a minute: from the fixes of a second
nobody can tell. Over several, the drone's own velocity and acceleration can. Each filter of the bank follows one axis
with its own hypothesis of the wander's size and of the white noise,

    state  p, v, e (error of the acceleration), w (wander, Gauss-Markov),    fix = p + w + white noise,

and the likelihood of what was measured weighs the hypotheses (multiple-model adaptive estimation, D. T. Magill,
1965). Horizontal axes have one size, the vertical one its own. What a receiver claims is its whole error: where its
white noise is less, the rest is wander.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.row_kernels import HEIGHT, POSITION, VELOCITY, IntArray
from estimators.systematic.slow_errors import ACCELERATION_S, WANDER_S

WANDERS_M = np.array([0.02, 0.15, 0.4, 0.8, 1.6, 4.0])
"""Standard deviations of the wander per axis."""
PRIOR = np.array([0.32, 0.25, 0.2, 0.14, 0.07, 0.02])
"""Probability of each before any evidence."""
EXPECTED_M2 = float(PRIOR @ WANDERS_M**2)
"""Mean square of the wander before any evidence."""
WHITES = np.array([0.35, 0.6, 1.0, 2.0])
"""What the white noise of the fixes is, of what the receiver claims."""
HYPOTHESES_M, FACTORS = np.tile(WANDERS_M, len(WHITES)), np.repeat(WHITES, len(WANDERS_M))
"""All pairs of the two."""
PRIOR_NATS = np.tile(np.log(PRIOR), len(WHITES))
MEMORY_FIXES = 300.0
"""Fixes that are remembered, some minute of them."""
TRUST_NATS = 2.0
"""Log odds that a receiver whose white noise is all that it claims does not wander, once it has been watched."""
WATCHED_FIXES = 40.0
"""So many fixes tell a wander: of fewer, any is as likely as another. Until then, where there is a barometer, none in
height is taken for smaller than was expected: barometers hold for long what was believed at first."""
CLAIM_SHARE = 0.05
"""Of a new fix in the average of what a receiver claims."""
VERTICAL = 1.0, 2.5
"""The vertical wander, which no velocity tells, against the horizontal one, at least and at most: receivers see half
a sky."""
HELD_VERTICAL = 1.5
"""At least, where a barometer holds for long what was believed at first."""
OUTLIER_SQUARE = 25.0
"""A normalised innovation beyond this says nothing of a wander."""
MOST_OUTLIERS = 15
"""So many fixes in a row that no hypothesis explains: the receiver is somewhere else, the filters start anew."""
ACCEL_ERROR_MPS2 = 0.3


class ReceiverWanders:
    """The banks of all receivers of a fleet of ``agents``."""

    def __init__(self, agents: int, period_s: float) -> None:
        self._period_s = period_s
        self._make(agents)

    def _make(self, agents: int) -> None:
        models = len(HYPOTHESES_M)
        self._means = np.zeros((agents, 3, models, 4))
        self._covariances = np.zeros((agents, 3, models, 4, 4))
        self._nats = np.zeros((agents, 2, models))
        self._outliers = np.full(agents, -1, np.int64)
        self._fixes = np.zeros(agents, np.int64)
        self._claims_m = np.zeros((agents, 2))
        self._heights = np.zeros(agents, np.int64)
        """1: it has a barometer."""
        self._known: tuple[Matrix, Matrix] | None = None

    def weigh(self, rows: RowTable, accel: Vector, accel_variance: Vector) -> None:
        """Take in the rows of one tick, and the accelerations ``(3n,)`` from it to the next."""
        self._known = None
        _weigh(np.ascontiguousarray(rows), accel, accel_variance, self._period_s, *self._arrays())

    def _arrays(self) -> tuple[Matrix, Matrix, Matrix, IntArray, IntArray, Matrix, IntArray]:
        """All that is kept of each receiver."""
        banks = self._means, self._covariances, self._nats
        return *banks, self._outliers, self._fixes, self._claims_m, self._heights

    def sizes_m(self) -> Matrix:
        """Root mean square ``(n, 3)`` of the wander over the hypotheses, per axis."""
        return self._told()[0].copy()

    def white_factors(self) -> Matrix:
        """Root mean square ``(n, 3)``, per axis, of the white noise of the fixes over what their receiver claims."""
        return self._told()[1].copy()

    def _told(self) -> tuple[Matrix, Matrix]:
        """Sizes and factors, computed once a tick."""
        if self._known is None:
            self._known = np.empty((len(self._nats), 3)), np.empty((len(self._nats), 3))
            _tell(self._nats, self._fixes, self._claims_m, self._heights, *self._known)
        return self._known

    def change_members(self, stayed: Mapping[int, int], agents: int) -> None:
        """Go on with another fleet; ``stayed``: by new slot, the old one."""
        before = self._arrays()
        self._make(agents)
        for slot, old in stayed.items():
            for new_array, old_array in zip(self._arrays(), before, strict=True):
                new_array[slot] = old_array[old]


@entry("void(float64[:, :, ::1], int64[::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1])")
def _tell(
    nats: Matrix, fixes: IntArray, claims: Matrix, heights: IntArray, sizes: Matrix, factors: Matrix
) -> None:
    """sizes, factors ``(n, 3)`` <- what the hypotheses make of the wander and of the white noise."""
    agents, models = nats.shape[0], nats.shape[2]
    weights, size, unused = np.empty(models), np.empty((agents, 2)), np.empty((agents, 2))
    for a in range(agents):
        watched = min(fixes[a] / WATCHED_FIXES, 1.0)
        for group in range(2):
            for h in range(models):
                trusted = HYPOTHESES_M[h] == HYPOTHESES_M[0] and FACTORS[h] >= 1.0
                weights[h] = nats[a, group, h] + PRIOR_NATS[h] + (TRUST_NATS * watched if trusted else 0.0)
            highest, total, wander, white = weights.max(), 0.0, 0.0, 0.0
            for h in range(models):
                weight = np.exp(weights[h] - highest)
                total += weight
                wander += weight * HYPOTHESES_M[h] ** 2
                white += weight * FACTORS[h] ** 2
            least = (1.0 - watched) * EXPECTED_M2 if group == 1 and heights[a] else 0.0
            size[a, group] = np.sqrt(max(wander / total, least))
            unused[a, group] = claims[a, group] * np.sqrt(max(1.0 - white / total, 0.0))
            for axis in range(2 * group, 2 + group):
                factors[a, axis] = np.sqrt(white / total)
    usual = np.median(size[:, 0].copy()), np.median(size[:, 1].copy())
    for a in range(agents):
        across = max(size[a, 0], unused[a, 0], usual[0])
        down = max(size[a, 1], unused[a, 1], usual[1])
        sizes[a, 0], sizes[a, 1] = across, across
        least = HELD_VERTICAL if heights[a] else VERTICAL[0]
        sizes[a, 2] = min(max(down, least * across), VERTICAL[1] * across)


@entry(
    "void(ROW[::1], float64[::1], float64[::1], float64, float64[:, :, :, ::1], float64[:, :, :, :, ::1],"
    " float64[:, :, ::1], int64[::1], int64[::1], float64[:, ::1], int64[::1])",
    ROW=ROW,
)
def _weigh(
    rows: RowTable,
    accel: Vector,
    accel_variance: Vector,
    dt: float,
    means: Matrix,
    covariances: Matrix,
    nats: Matrix,
    outliers: IntArray,
    fixes: IntArray,
    claims: Matrix,
    heights: IntArray,
) -> None:
    agents, models = means.shape[0], means.shape[2]
    forget = 1.0 - 1.0 / MEMORY_FIXES
    fixed = np.zeros(agents, np.int64)  # 1: a fix, 2: one that some hypothesis explains
    for r in range(rows.shape[0]):
        row = rows[r]
        if row["kind"] == HEIGHT and row["x"] == 1.0:
            heights[row["agent"]] = 1
        if (row["kind"] != POSITION and row["kind"] != VELOCITY) or np.isfinite(row["half_width"]):
            continue
        axis = _axis(row)
        if axis < 0:
            continue
        a, place = row["agent"], row["kind"] == POSITION
        if outliers[a] < 0 or (outliers[a] == 0 and covariances[a, axis, 0, 0, 0] == 0.0):
            if place:
                _begin(row["value"], row["variance"], means[a, axis], covariances[a, axis])
                outliers[a] = 0
            continue
        if covariances[a, axis, 0, 0, 0] == 0.0:
            continue
        seen = np.zeros(4)
        seen[0], seen[1], seen[3] = (1.0, row["offset_s"], 1.0) if place else (0.0, 1.0, 0.0)
        explained = _correct(row, seen, place, means[a, axis], covariances[a, axis], nats[a, 0 if axis < 2 else 1])
        if place:
            claim, group = np.sqrt(row["variance"]), 0 if axis < 2 else 1
            claims[a, group] += CLAIM_SHARE * (claim - claims[a, group]) if claims[a, group] > 0.0 else claim
            fixed[a] = max(fixed[a], 2 if explained else 1)
    for a in range(agents):
        if fixed[a] > 0:
            fixes[a] += 1
            outliers[a] = outliers[a] + 1 if fixed[a] == 1 else 0
            for group in range(2):
                for h in range(models):
                    nats[a, group, h] *= forget
            if outliers[a] > MOST_OUTLIERS:
                outliers[a] = -1
                covariances[a] = 0.0
        for axis in range(3):
            for h in range(models):
                if covariances[a, axis, h, 0, 0] > 0.0:
                    push, noise = accel[3 * a + axis], accel_variance[3 * a + axis]
                    _predict(means[a, axis, h], covariances[a, axis, h], push, noise, HYPOTHESES_M[h], dt)


@kernel
def _axis(row: np.void) -> int:
    """The NED axis that a row is along; -1 for another direction."""
    if row["x"] == 1.0:
        return 0
    if row["y"] == 1.0:
        return 1
    return 2 if row["z"] == 1.0 else -1


@kernel
def _begin(value: float, variance: float, mean: Matrix, covariance: Matrix) -> None:
    """Start one axis of one receiver at a fix."""
    for h in range(mean.shape[0]):
        size = HYPOTHESES_M[h] ** 2
        mean[h] = 0.0
        mean[h, 0] = value
        covariance[h] = 0.0
        covariance[h, 0, 0] = variance + size
        covariance[h, 0, 3] = -size
        covariance[h, 3, 0] = -size
        covariance[h, 3, 3] = size
        covariance[h, 1, 1] = 100.0
        covariance[h, 2, 2] = ACCEL_ERROR_MPS2**2


@kernel
def _correct(row: np.void, seen: Vector, place: bool, mean: Matrix, covariance: Matrix, nats: Vector) -> bool:
    """Correct all hypotheses of one axis by a row; whether any explains it."""
    explained = False
    column = np.empty(4)
    for h in range(mean.shape[0]):
        variance = row["variance"] * (FACTORS[h] ** 2 if place else 1.0)
        innovation = row["value"]
        for i in range(4):
            innovation -= seen[i] * mean[h, i]
            column[i] = 0.0
            for j in range(4):
                column[i] += covariance[h, i, j] * seen[j]
        for i in range(4):
            variance += seen[i] * column[i]
        square = innovation * innovation / variance
        nats[h] -= 0.5 * (np.log(variance) + min(square, OUTLIER_SQUARE))
        if square > OUTLIER_SQUARE:
            continue
        explained = True
        for i in range(4):
            mean[h, i] += column[i] / variance * innovation
            for j in range(4):
                covariance[h, i, j] -= column[i] * column[j] / variance
    return explained


@kernel
def _predict(mean: Vector, covariance: Matrix, push: float, noise: float, size: float, dt: float) -> None:
    """One axis of one hypothesis one tick on."""
    keep_e, keep_w = np.exp(-dt / ACCELERATION_S), np.exp(-dt / WANDER_S)
    half = 0.5 * dt * dt
    mean[0] += dt * mean[1] - half * mean[2] + half * push
    mean[1] += dt * (push - mean[2])
    mean[2] *= keep_e
    mean[3] *= keep_w
    for j in range(4):  # rows, then columns
        covariance[0, j] += dt * covariance[1, j] - half * covariance[2, j]
        covariance[1, j] -= dt * covariance[2, j]
        covariance[2, j] *= keep_e
        covariance[3, j] *= keep_w
    for i in range(4):
        covariance[i, 0] += dt * covariance[i, 1] - half * covariance[i, 2]
        covariance[i, 1] -= dt * covariance[i, 2]
        covariance[i, 2] *= keep_e
        covariance[i, 3] *= keep_w
    covariance[0, 0] += half * half * noise
    covariance[0, 1] += half * dt * noise
    covariance[1, 0] += half * dt * noise
    covariance[1, 1] += dt * dt * noise
    covariance[2, 2] += (1.0 - keep_e * keep_e) * ACCEL_ERROR_MPS2**2
    covariance[3, 3] += (1.0 - keep_w * keep_w) * size * size
