"""Consensus without dilution: take from a neighbour only what it knows better.

A convex combination of information pairs dilutes an agent's own block by neighbours that know it less. When
records are shared, neighbours mostly hold the same information, and what is lost to one of them is the rows of
some agents. So for those agents, D, whose marginal the neighbour knows better, its conditional density of D given
the other agents S takes the place of the own one:

    p(x_S, x_D) = p_own(x_S) p_neighbour(x_D | x_S)

The own marginal on S is untouched, and no datum enters it a second time.

A neighbour may be wrong, and what is inherited stays. So a pair is inherited only if it speaks of the same fleet as
the own one: every agent's marginal has to agree with the own marginal, within both covariances, and may not claim
what no measurements allow.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import isnan

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_solve, cholesky_upper, factor_upper, inverse_from_cholesky
from estimators.consensus.information import fits
from estimators.estimator import Payload
from estimators.model.gaussian import Pair, symmetrised
from estimators.model.layout import STATES_PER_AGENT, BodyKind, Layout
from estimators.model.measurements import Matrix, Vector
from estimators.model.members import MemberChange

WORTHWHILE_NATS = 0.2
"""Difference in log determinant of a 6x6 marginal covariance from which on a neighbour knows an agent better."""

DISAGREEING_SQUARE = 45.0
"""Squared Mahalanobis distance between two marginals of one agent, six dimensions, that no chance explains: fewer
than one pair in ten million. Both hold mostly the same measurements, so that the sum of their covariances is more
than that of their difference."""
FLOOR = 0.01
"""Least standard deviation, in m along any direction and in m/s, that a pair may claim: an antenna's phase centre is
not known to a centimetre in flight, and such a velocity would say where it is a second later. Of a body that is said
to stand still everybody knows that."""
KNOWN_M = 0.5
"""An agent whose own position is known so well, along every direction, holds what says so itself."""
OVERCLAIMED_NATS = 8.0
"""Then nobody knows it so much better: difference in log determinant of the covariance of the own position, four
times along every axis. A neighbour has the same measurements and perhaps a few ranges more."""


class Inheritance:
    """One agent's rounds of it, over a layout's bodies; ``slot`` is the own place, which nobody knows better."""

    def __init__(self, layout: Layout, slot: int) -> None:
        self.refused = 0
        """Neighbours' pairs of the right tick that could not be fused, or did not fit the own one."""
        self.disbelieved: tuple[int, ...] = ()
        """Slots of those whose pairs did not fit the own one in the latest round."""
        self._slot, self._stands = slot, _stands(layout)
        self._tick = 0
        self._pair: Pair = (np.zeros((0, 0)), np.zeros(0))

    def begin(self, tick: int, pair: Pair) -> None:
        """Begin the rounds of a tick with the own pair, of the state at ``tick``."""
        self._tick, self._pair = tick, pair

    def outgoing(self) -> Payload:
        """What neighbours get after the rounds so far; there are no weights, so no rank and no degree."""
        return Payload(self._tick, *self._pair, rank=0)

    def mix(self, received: Mapping[int, Payload], *, fuse: bool = True) -> Collection[int]:
        """One round with what neighbours sent, by slot; gives from whom something was inherited.

        Pairs of another tick are not used. With ``fuse`` false the own pair stays what it is.
        """
        timely = {slot: pair for slot, pair in received.items() if pair.tick == self._tick}
        usable, better, self.disbelieved = survey(self._pair, timely, self._slot, self._stands)
        self.refused += len(timely) - len(usable)
        heard: list[int] = []
        if not better or not fuse:
            return heard
        for slot, pair in usable.items():
            mixed = inherit(self._pair, (pair.information, pair.vector), self._slot)
            if mixed is not self._pair:
                heard.append(slot)
            self._pair = mixed
        return heard

    def pair(self) -> Pair:
        """The pair that the rounds made."""
        return self._pair

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet."""
        self._slot, self._stands = change.own, _stands(change.after)


def _stands(layout: Layout) -> NDArray[np.bool_]:
    """``(n,)`` which bodies are said to stand still."""
    return np.array([kind is BodyKind.ANCHOR for kind in layout.kinds])


def survey(
    own: Pair,
    pairs: Mapping[int, Payload],
    slot: int,
    stands: NDArray[np.bool_],
    threshold: float = WORTHWHILE_NATS,
) -> tuple[dict[int, Payload], bool, tuple[int, ...]]:
    """Of neighbours' pairs, by slot: those to be fused, whether one of them knows an agent better, and who is wrong.

    The best informed first, whatever its place: what is made of them does not depend on the agents' order. ``own`` is
    the own pair, of the same tick; ``slot`` the own place, which nobody knows better; ``stands`` ``(n,)`` which
    bodies are said to stand still. Wrong are sound pairs that do not fit the own one, or claim what nobody can know.
    """
    n = len(own[1])
    fitting = [each for each, pair in pairs.items() if fits(pair, n)]
    informations, vectors = np.empty((len(fitting), n, n)), np.empty((len(fitting), n))
    for place, each in enumerate(fitting):
        informations[place], vectors[place] = pairs[each].information, pairs[each].vector
    log_dets, believed = np.empty(len(fitting)), np.empty(len(fitting), np.bool_)
    information, vector = np.ascontiguousarray(own[0]), np.ascontiguousarray(own[1])
    better = _compare(information, vector, informations, vectors, slot, stands, threshold, log_dets, believed)
    known = {
        each: known
        for each, known, fit in zip(fitting, log_dets.tolist(), believed, strict=True)
        if fit and not isnan(known)
    }
    wrong = tuple(each for each, fit in zip(fitting, believed, strict=True) if not fit)
    return {each: pairs[each] for each in sorted(known, key=known.__getitem__, reverse=True)}, better, wrong


@entry(
    "boolean(float64[:, ::1], float64[::1], float64[:, :, ::1], float64[:, ::1], int64, boolean[::1], float64,"
    " float64[::1], boolean[::1])"
)
def _compare(
    own: Matrix,
    own_vector: Vector,
    informations: NDArray[np.float64],
    vectors: Matrix,
    slot: int,
    stands: NDArray[np.bool_],
    threshold: float,
    log_dets: Vector,
    believed: NDArray[np.bool_],
) -> bool:
    """Whether one of the pairs that are believed knows another agent than ``slot`` better than ``own``.

    ``log_dets`` ``(J,)`` gets the informations' log determinants, NaN for a pair that cannot be fused; ``believed``
    ``(J,)`` is false for a sound pair that does not fit the own one.
    """
    n = own.shape[0]
    agents = n // STATES_PER_AGENT
    own_covariance, covariance, root = np.empty((n, n)), np.empty((n, n)), own.copy()
    uncertainty, own_mean = np.full(agents, -np.inf), np.zeros(n)
    sound = factor_upper(root)
    if sound:
        inverse_from_cholesky(root, own_covariance)
        own_mean[:] = np.dot(own_covariance, own_vector)
        for k in range(agents):
            uncertainty[k] = -np.inf if k == slot else _log_det(own_covariance, k)
    better = False
    for p in range(log_dets.shape[0]):
        log_dets[p], believed[p] = np.nan, True
        root[:, :] = informations[p]
        if not np.isfinite(vectors[p]).all() or not factor_upper(root):
            continue
        log_dets[p] = 0.0
        for i in range(n):
            log_dets[p] += 2.0 * np.log(root[i, i])
        inverse_from_cholesky(root, covariance)
        if sound:
            away = np.dot(covariance, vectors[p]) - own_mean
            believed[p] = _credible(covariance, slot, stands, own_covariance)
            for k in range(agents):
                believed[p] = believed[p] and _agrees(own_covariance, covariance, away, k)
        for k in range(agents):
            better = better or (believed[p] and uncertainty[k] - _log_det(covariance, k) > threshold)
    return better


@kernel
def _agrees(own: Matrix, other: Matrix, away: Vector, slot: int) -> bool:
    """Whether two marginals of an agent, whose means differ by ``away`` ``(6n,)``, are within both covariances."""
    at = STATES_PER_AGENT * slot
    root, whitened = np.empty((STATES_PER_AGENT, STATES_PER_AGENT)), away[at : at + STATES_PER_AGENT].copy()
    for i in range(STATES_PER_AGENT):
        for j in range(STATES_PER_AGENT):
            root[i, j] = own[at + i, at + j] + other[at + i, at + j]
    if not factor_upper(root):
        return False
    difference = whitened.copy()
    cholesky_solve(root, whitened)
    return float(np.dot(difference, whitened)) <= DISAGREEING_SQUARE


@kernel
def _credible(covariance: Matrix, slot: int, stands: NDArray[np.bool_], own: Matrix) -> bool:
    """Whether a pair's covariance claims what can be known: of anybody, and of the place of ``slot``, the own one."""
    room = np.empty((3, 3))
    for first in range(0, covariance.shape[0], 3):
        if first % STATES_PER_AGENT > 0 and stands[first // STATES_PER_AGENT]:
            continue
        for i in range(3):
            for j in range(3):
                room[i, j] = covariance[first + i, first + j]
            room[i, i] -= FLOOR * FLOOR
        if not cholesky_upper(room):
            return False
    at = STATES_PER_AGENT * slot
    for i in range(3):
        for j in range(3):
            room[i, j] = -own[at + i, at + j]
        room[i, i] += KNOWN_M * KNOWN_M
    if not cholesky_upper(room):
        return True
    return _position_log_det(own, at) - _position_log_det(covariance, at) <= OVERCLAIMED_NATS


@kernel
def _position_log_det(covariance: Matrix, at: int) -> float:
    """Log determinant of the three states from ``at``; NaN where their covariance is not positive definite."""
    root = covariance[at : at + 3, at : at + 3].copy()
    if not cholesky_upper(root):
        return np.nan
    return 2.0 * float(np.log(root[0, 0]) + np.log(root[1, 1]) + np.log(root[2, 2]))


def inherit(
    own: Pair, other: Pair, slot: int, threshold: float = WORTHWHILE_NATS
) -> Pair:
    """The own information pair, with the agents that ``other`` knows better taken from there.

    ``slot`` is the own place, which is never taken. Pairs as in `estimators.estimator.Payload`.
    Nothing is taken where one of them turns out not to be positive definite.
    """
    better = np.empty(len(own[1]) // STATES_PER_AGENT, np.bool_)
    sound = _find_better(np.ascontiguousarray(own[0]), np.ascontiguousarray(other[0]), threshold, better)
    better[slot] = False
    if not sound or not better.any():
        return own
    return _transplant(own, other, symmetrised(np.linalg.inv(own[0])), np.repeat(better, STATES_PER_AGENT))


@entry("boolean(float64[:, ::1], float64[:, ::1], float64, boolean[::1])")
def _find_better(
    own: Matrix, other: Matrix, threshold: float, better: NDArray[np.bool_]
) -> bool:
    """Which agents' marginals the other information matrix knows better; False where one is not positive definite."""
    n = own.shape[0]
    covariance, other_covariance = np.empty((n, n)), np.empty((n, n))
    for information, inverse in ((own, covariance), (other, other_covariance)):
        root = information.copy()
        if not factor_upper(root):
            return False
        inverse_from_cholesky(root, inverse)
    for k in range(better.shape[0]):
        gained = _log_det(covariance, k) - _log_det(other_covariance, k)
        if np.isnan(gained):
            return False
        better[k] = gained > threshold
    return True


@kernel
def _log_det(covariance: Matrix, slot: int) -> float:
    """Log determinant of an agent's block; NaN where it is not positive definite."""
    at = STATES_PER_AGENT * slot
    root = covariance[at : at + STATES_PER_AGENT, at : at + STATES_PER_AGENT].copy()
    if not cholesky_upper(root):
        return np.nan
    total = 0.0
    for i in range(STATES_PER_AGENT):
        total += np.log(root[i, i])
    return 2.0 * total


def _transplant(
    own: Pair,
    other: Pair,
    covariance: Matrix,
    taken: NDArray[np.bool_],
) -> Pair:
    """Own marginal of the states not ``taken`` times the other's conditional of those taken."""
    kept = ~taken
    marginal = np.linalg.inv(covariance[np.ix_(kept, kept)])
    conditional, cross = other[0][np.ix_(taken, taken)], other[0][np.ix_(taken, kept)]
    regression = np.linalg.solve(conditional, cross)  # E[x_D | x_S] = a - regression x_S
    information, vector = np.empty_like(own[0]), np.empty_like(own[1])
    information[np.ix_(taken, taken)] = conditional
    information[np.ix_(taken, kept)] = cross
    information[np.ix_(kept, taken)] = cross.T
    information[np.ix_(kept, kept)] = marginal + cross.T @ regression
    vector[taken] = other[1][taken]
    vector[kept] = marginal @ (covariance @ own[1])[kept] + regression.T @ other[1][taken]
    return 0.5 * (information + information.T), vector
