"""What receivers wander by and pairs of ranges are biased by, as long as nobody is off: a Kalman filter.

Of what is left over between ranges and fixes (`baselines`). Errors that change within a minute are states, so what is
new in half a second is held against all that came before, and is white. What somebody's fault would have added to
it, and to the states, is linear in the fault (`fault_odds`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimators.integrity.exclusion.baselines import BIN_S, NEAREST_M, Bin, LeftOver, Pair
from estimators.model.measurements import Matrix, Vector

WANDER_M = (0.75, 0.75, 1.1)
"""1-sigma of what a receiver's error wanders by itself, north, east, down; what all share is not seen."""
WANDER_S = 60.0
PAIR_BIAS_M = 0.4
PAIR_BIAS_S = 600.0
"""A pair's bias changes with temperature and attitude, not in flight seconds."""
ABSURD_SQUARE = 100.0
"""Normalised square of what is new, on average, beyond which nothing is learnt from it: a jump of ten metres
spoils neither what is known nor the directions that it is linearised along."""
RANGE_FLOOR_M = 0.1
"""Of a bin's median: ranges close in time err alike."""


@dataclass(frozen=True, slots=True)
class Fresh:
    """What is new in a bin, whitened; ``r`` rows, ``N`` states."""

    pairs: tuple[Pair, ...]
    directions: Matrix
    """``(r, 3)``: from the second of a pair to the first."""
    distances_m: Vector
    """``(r,)``: between them, by their fixes less what is known of both."""
    expected_m: Vector
    """``(r,)``: the ranges that follow from those, and from what is known of the pairs."""
    residual_m: Vector
    """``(r,)``: what is new, not whitened."""
    blocked_nats: Vector
    """``(r,)``: what the scatter of a pair's ranges says for a path without a line of sight."""
    whiten: Matrix
    """``(r, r)``."""
    value: Vector
    """``(r,)``, whitened."""
    rows: Matrix
    """``(r, N)``: of the states, whitened."""

    @property
    def square(self) -> float:
        """Normalised square, on average: 1 while nobody is off."""
        return float(self.value @ self.value) / len(self.value)

    def sign(self, agent: int) -> Vector:
        """``(r,)``: of a drone's error in what is left over, along the direction."""
        return np.array([(other == agent) - float(one == agent) for one, other in self.pairs])


class SlowErrors:
    """Of all drones and pairs; ``state`` ``(N,)``: three per drone, then one per pair."""

    def __init__(self) -> None:
        self.agents: tuple[int, ...] = ()
        self.pairs: tuple[Pair, ...] = ()
        self.state: Vector = np.zeros(0)
        self.covariance: Matrix = np.zeros((0, 0))

    def keep(self, agents: Iterable[int]) -> None:
        """Let these be the drones; of those who were, all is kept."""
        ids = tuple(sorted(agents))
        pairs = tuple(combinations(ids, 2))
        before = {key: at for at, key in enumerate(_keys(self.agents, self.pairs))}
        source = np.array([before.get(key, -1) for key in _keys(ids, pairs)], np.int64)
        self.agents, self.pairs = ids, pairs
        known = source >= 0
        state, covariance = np.zeros(len(source)), np.diag(self.prior())
        state[known] = self.state[source[known]]
        covariance[np.ix_(known, known)] = self.covariance[np.ix_(source[known], source[known])]
        self.state, self.covariance = state, covariance

    def prior(self) -> Vector:
        """Variances ``(N,)`` of errors of which nothing is known."""
        return np.concatenate(
            (np.tile(np.square(WANDER_M), len(self.agents)), np.full(len(self.pairs), PAIR_BIAS_M**2))
        )

    def decay(self, bins: int) -> Vector:
        """``(N,)``: what is left of each after so many bins."""
        taus = np.repeat((WANDER_S, PAIR_BIAS_S), (3 * len(self.agents), len(self.pairs)))
        return np.asarray(np.exp(-bins * BIN_S / taus))

    def pass_by(self, bins: int) -> None:
        """So many bins pass."""
        kept = self.decay(bins)
        self.state = kept * self.state
        self.covariance = kept[:, None] * self.covariance * kept
        self.covariance[np.diag_indices_from(self.covariance)] += (1.0 - kept**2) * self.prior()

    def fresh(self, made: Bin, chosen: Sequence[Pair]) -> Fresh:
        """What is new in the chosen pairs of a bin (at least one), linearised at what is known of their drones."""
        left = [made.pairs[pair] for pair in chosen]
        residual, directions, distances = self._left(chosen, left)
        expected = distances + self.state[[self.of_pair(pair) for pair in chosen]]
        rows = self._rows(chosen, directions)
        noise = _noise(made, chosen, left, directions)
        whiten = np.linalg.inv(np.linalg.cholesky(rows @ self.covariance @ rows.T + noise))
        value = whiten @ residual
        blocked = np.array([each.blocked_nats for each in left])
        return Fresh(tuple(chosen), directions, distances, expected, residual, blocked, whiten, value, whiten @ rows)

    def take(self, fresh: Fresh) -> Matrix:
        """Learn from what is new; gives the gain ``(N, r)`` of the whitened values, 0 where it is too much to be."""
        if fresh.square > ABSURD_SQUARE:
            return np.zeros_like(fresh.rows.T)
        gain = self.covariance @ fresh.rows.T
        self.state = self.state + gain @ fresh.value
        covariance = self.covariance - gain @ gain.T
        self.covariance = 0.5 * (covariance + covariance.T)
        return np.asarray(gain)

    def correct(self, effect: Matrix, error: Vector, covariance: Matrix) -> None:
        """Take out what an error ``(k,)`` with a covariance has done: ``effect`` ``(N, k)`` of each."""
        self.state = self.state - effect @ error
        self.covariance = self.covariance + effect @ covariance @ effect.T

    def forget(self, states: Collection[int]) -> None:
        """Know nothing of some states any more."""
        at = list(states)
        self.state, self.covariance = self.state.copy(), self.covariance.copy()
        self.state[at] = 0.0
        self.covariance[at, :] = 0.0
        self.covariance[:, at] = 0.0
        self.covariance[at, at] = self.prior()[at]

    def of_agent(self, agent: int) -> range:
        """The states of a drone."""
        at = 3 * self.agents.index(agent)
        return range(at, at + 3)

    def of_pair(self, pair: Pair) -> int:
        """The state of a pair."""
        return 3 * len(self.agents) + self.pairs.index(pair)

    def _left(self, chosen: Sequence[Pair], left: Sequence[LeftOver]) -> tuple[Vector, Matrix, Vector]:
        """What is left over of ranges, directions and distances between the drones, less what is known of both."""
        residual, directions, distances = np.zeros(len(chosen)), np.zeros((len(chosen), 3)), np.zeros(len(chosen))
        for at, (pair, each) in enumerate(zip(chosen, left, strict=True)):
            one, other = (self.state[self.of_agent(agent)] for agent in pair)
            apart = each.distance_m * each.direction - one + other
            distance = distances[at] = float(np.linalg.norm(apart))
            directions[at] = apart / distance if distance > NEAREST_M else each.direction
            residual[at] = each.residual_m + each.distance_m - distance - self.state[self.of_pair(pair)]
        return residual, directions, distances

    def _rows(self, chosen: Sequence[Pair], directions: Matrix) -> Matrix:
        rows = np.zeros((len(chosen), len(self.state)))
        for at, pair in enumerate(chosen):
            one, other = (self.of_agent(agent) for agent in pair)
            rows[at, one], rows[at, other], rows[at, self.of_pair(pair)] = -directions[at], directions[at], 1.0
        return rows


def _keys(agents: Sequence[int], pairs: Sequence[Pair]) -> list[tuple[int, int]]:
    """A name for each state; an axis is below every id."""
    return [(agent, -axis) for agent in agents for axis in (1, 2, 3)] + list(pairs)


def _noise(made: Bin, chosen: Sequence[Pair], left: Sequence[LeftOver], directions: Matrix) -> Matrix:
    """Covariance of what is white: ranges, and the fixes that pairs share."""
    noise = np.diag([each.variance_m2 + RANGE_FLOOR_M**2 for each in left])
    for agent in {agent for pair in chosen for agent in pair}:
        sign = np.array([(other == agent) - float(one == agent) for one, other in chosen])
        column = sign[:, None] * directions
        noise += (column * made.fix_variance_m2[agent]) @ column.T
    return np.asarray(noise)
