"""Ranges that are swapped, or without a line of sight: faults of which no size has to be found.

What they make of what is new is known, or known to scatter: two ranges of one drone that are said of each other's
pair go with the distances of the other; those that go around an obstacle are too long, each by something else. So
their odds are those of two distributions, and cumulative sums tell the likeliest begin (Page 1954). Beside them a
receiver that is dragged away cannot pass for ranges for long, nor they for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from scipy.special import log_ndtr

from estimators.integrity.exclusion.baselines import BIN_S, Pair
from estimators.integrity.exclusion.fault_odds import RANGES_PAY_NATS, LikelyFault
from estimators.integrity.exclusion.slow_errors import Fresh
from estimators.model.measurements import Vector

SWAPPED_PAY_NATS = 5.0
"""What two that are swapped pay, which happens seldom."""
BLOCKED_M = 1.5
"""What the ranges of a bin without a line of sight are too long by, on average, and what that scatters by."""

Pairs = tuple[Pair, ...]


class SpoiledRanges:
    """Takes in what is new, bin after bin."""

    def __init__(self) -> None:
        self._nats: dict[Pairs, float] = {}
        self._age_s: dict[Pairs, float] = {}
        self.speaks_nats = 0.0
        """What the last bin alone says for the likeliest."""

    def restart(self) -> None:
        """Begin anew, as after somebody was named or has come."""
        self._nats, self._age_s, self.speaks_nats = {}, {}, 0.0

    def take(self, fresh: Fresh, least_nats: float) -> dict[Pairs, LikelyFault]:
        """The odds of each that is likelier than that, against nobody's being off."""
        likely: dict[Pairs, LikelyFault] = {}
        self.speaks_nats = 0.0
        for pairs, nats, error_m, pay_nats in (*_swapped(fresh), *_blocked(fresh)):
            summed = max(self._nats.get(pairs, 0.0) + nats, 0.0)
            self._nats[pairs] = summed
            self._age_s[pairs] = self._age_s.get(pairs, 0.0) + BIN_S if summed > 0.0 else 0.0
            if summed - pay_nats > least_nats:
                nothing = np.zeros((fresh.rows.shape[1], 1))
                sure = np.array([error_m]), np.zeros((1, 1))
                likely[pairs] = LikelyFault(summed - pay_nats, *sure, nothing, 1.0, self._age_s[pairs])
                self.speaks_nats = max(self.speaks_nats, nats)
        return likely


_Told = tuple[Pairs, float, float, float]
"""Whose; odds of this bin alone; what the first of them is off by, m; and what has to be paid."""


def _swapped(fresh: Fresh) -> Iterator[_Told]:
    """Each two pairs that have a drone in common, their ranges put right."""
    swaps = [
        (at, to) for (at, one), (to, other) in combinations(enumerate(fresh.pairs), 2) if set(one) & set(other)
    ]
    if not swaps:
        return
    at, to = np.array(swaps).T
    along, weight = fresh.whiten.T @ fresh.value, fresh.whiten.T @ fresh.whiten
    said_m = fresh.residual_m + fresh.expected_m
    one_m, other_m = said_m[at] - said_m[to], said_m[to] - said_m[at]  # what putting them right takes off each
    squares = one_m**2 * weight[at, at] + other_m**2 * weight[to, to] + 2.0 * one_m * other_m * weight[at, to]
    nats = one_m * along[at] + other_m * along[to] - 0.5 * squares
    for number, swap in enumerate(swaps):
        pairs = fresh.pairs[swap[0]], fresh.pairs[swap[1]]
        yield pairs, float(nats[number]), float(one_m[number]), SWAPPED_PAY_NATS


def _blocked(fresh: Fresh) -> Iterator[_Told]:
    """Each pair, and all of each drone that has several."""
    along, weight = fresh.whiten.T @ fresh.value, fresh.whiten.T @ fresh.whiten
    agents = sorted({agent for pair in fresh.pairs for agent in pair})
    of_agents = [np.flatnonzero([agent in pair for pair in fresh.pairs]) for agent in agents]
    singles = np.arange(len(fresh.pairs))[:, None]
    nats = _blocked_nats(along[singles], weight.diagonal()[:, None, None])
    scatter_nats = fresh.blocked_nats - max(float(np.quantile(fresh.blocked_nats, 0.25)), 0.0)  # not what all do
    for at, pair in enumerate(fresh.pairs):
        yield (pair,), float(nats[at] + scatter_nats[at]), float(fresh.residual_m[at]), RANGES_PAY_NATS
    for chosen in of_agents:
        if len(chosen) > 1:
            told = float(_blocked_nats(along[chosen], weight[np.ix_(chosen, chosen)]))
            told += float(scatter_nats[chosen].sum())
            pairs = tuple(fresh.pairs[at] for at in chosen)
            yield pairs, told, float(np.mean(fresh.residual_m[chosen])), RANGES_PAY_NATS


def _blocked_nats(along: Vector, weight: Vector) -> Vector:
    """Odds ``(...)`` of ranges ``(..., k)`` that are off by `BLOCKED_M` each, with as much scatter.

    ``along`` is what is new along them, ``weight`` ``(..., k, k)`` its information. A way around is never shorter, so
    those of the Gaussian that are below 0 are none.
    """
    left = along - BLOCKED_M * weight.sum(axis=-1)
    spread = np.eye(weight.shape[-1]) + BLOCKED_M**2 * weight
    held = np.linalg.inv(spread)
    detours = 1.0 + BLOCKED_M * np.einsum("...ij,...j->...i", held, left)  # in units of `BLOCKED_M`, as their sigmas
    explained = np.einsum("...i,...ij,...j->...", left, held, left)
    gain = BLOCKED_M * along.sum(axis=-1) - 0.5 * BLOCKED_M**2 * (weight.sum(axis=(-1, -2)) - explained)
    longer = log_ndtr(detours / np.sqrt(np.diagonal(held, axis1=-2, axis2=-1))) - log_ndtr(1.0)
    return np.asarray(gain - 0.5 * np.linalg.slogdet(spread)[1] + longer.sum(axis=-1))
