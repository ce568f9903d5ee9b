"""Which receiver is off: the odds of one receiver's fixes being shifted, against all being as receivers are.

What is left over between ranges and fixes (`baselines`) is explained by slow errors, those of a receiver that wanders
within a minute and of a pair that is biased for good, and by noise. A shifted receiver has an error of any size
besides, from some time on. Both are Gaussian, so their odds are exact: there is no threshold per test to be tuned,
and what explains less has to pay for being able to explain more. The present and a few earlier instants are looked
at together, so that both a place and its change count.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.integrity.exclusion.baselines import BIN_S, Bin, LeftOver, Pair
from estimators.model.measurements import Matrix, Vector

WANDER_M = (0.75, 0.75, 1.1)
"""1-sigma of what a receiver's error wanders by itself, north, east, down; what all share is not seen."""
WANDER_S = 60.0
PAIR_BIAS_M = 0.4
FAULT_M = (8.0, 8.0, 3.0)
"""1-sigma of a shift, north, east, down. Fixes are dragged away along the ground more than up; and heights are what
fixes and ranges of drones side by side tell least, so that a shift of one in height would pass for much else."""
PAIR_FAULT_M = 8.0
"""The same of a pair's ranges."""
RANGE_FLOOR_M = 0.1
"""Of a bin's median: ranges close in time err alike."""
RAMPS_S = (3.0, 15.0, 40.0, 80.0)
"""Since when a shift that grows may be growing."""


@dataclass(frozen=True, slots=True)
class Odds:
    """For each receiver, and for each pair, being off, against nobody; nats."""

    receivers: dict[int, float]
    pairs: dict[Pair, float]
    shifts_m: dict[int, Vector]
    """``(3,)``: by how much each receiver would be off now."""
    separations_m: dict[int, Vector]
    """``(3,)``: by how much the own place, as fixes and ranges have it, moves if that receiver is left out."""


def odds(epochs: Sequence[Bin], doubted: Collection[int] = (), own: int | None = None) -> Odds:
    """The odds of each receiver that is ranged to; the first epoch is the present one.

    ``doubted`` receivers are off already, and explain nothing. ``own``: whose place is asked for, if any.
    """
    left = [
        _Entry(epoch, pair, each)
        for epoch, made in enumerate(epochs)
        for pair, each in sorted(made.pairs.items())
        if all(agent in made.fix_variance_m2 and agent not in doubted for agent in pair)
    ]
    if not any(each.epoch == 0 for each in left):
        return Odds({}, {}, {}, {})
    whiten = np.linalg.inv(np.linalg.cholesky(_spread(epochs, left)))
    residuals = whiten @ np.array([each.left.residual_m for each in left])
    receivers, shifts, separations = {}, {}, {}
    learnt = None if own is None else whiten @ _learnt(epochs, left, own)
    for agent in sorted({agent for each in left if each.epoch == 0 for agent in each.pair}):
        by_epoch = (whiten @ _shifts(left, len(epochs), agent)).reshape(len(left), len(epochs), 3)
        columns = [np.einsum("mek,e->mk", by_epoch, profile) for profile in _profiles(epochs)]
        found = [_gain(residuals, each, np.square(FAULT_M)) for each in columns]
        best = max(range(len(found)), key=lambda at: found[at][0])
        receivers[agent], shifts[agent] = found[best]
        if learnt is not None:
            separations[agent] = learnt.T @ (columns[best] @ shifts[agent]) - (shifts[agent] if agent == own else 0.0)
    return Odds(receivers, _of_pairs(epochs, left, whiten, residuals), shifts, separations)


def _of_pairs(epochs: Sequence[Bin], left: Sequence[_Entry], whiten: Matrix, residuals: Vector) -> dict[Pair, float]:
    """The odds of each pair's ranges being off, all at once: one unknown each."""
    at = np.array([each.epoch for each in left])
    present = [each.pair for each in left if each.epoch == 0]
    of_pair = np.array([[float(each.pair == pair) for pair in present] for each in left])
    best = np.full(len(present), -np.inf)
    for profile in _profiles(epochs):
        columns = whiten @ (of_pair * profile[at][:, None])
        information = np.sum(columns * columns, axis=0) + PAIR_FAULT_M**-2
        gain = 0.5 * (columns.T @ residuals) ** 2 / information - 0.5 * np.log(information * PAIR_FAULT_M**2)
        best = np.maximum(best, gain)
    return dict(zip(present, best.tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class _Entry:
    epoch: int
    pair: Pair
    left: LeftOver

    def sign(self, agent: int) -> float:
        """Of a drone's error in what is left over, along the direction."""
        return -1.0 if self.pair[0] == agent else float(self.pair[1] == agent)


def _spread(epochs: Sequence[Bin], left: Sequence[_Entry]) -> Matrix:
    """Covariance of what is left over while nobody is off."""
    at = np.array([each.epoch for each in left])
    same = at[:, None] == at[None, :]
    spread = np.diag([each.left.variance_m2 + RANGE_FLOOR_M**2 for each in left])
    names = {pair: number for number, pair in enumerate({each.pair for each in left})}
    named = np.array([names[each.pair] for each in left])
    spread += PAIR_BIAS_M**2 * (named[:, None] == named[None, :])
    numbers = np.array([made.number for made in epochs])[at]
    kept = np.exp(-BIN_S * np.abs(numbers[:, None] - numbers[None, :]) / WANDER_S)
    directions = np.array([each.left.direction for each in left])
    for agent in {agent for each in left for agent in each.pair}:
        column = np.array([each.sign(agent) for each in left])[:, None] * directions
        spread += (column * np.square(WANDER_M)) @ column.T * kept
        noise = np.array([epochs[each.epoch].fix_variance_m2.get(agent, np.zeros(3)) for each in left])
        spread += (column * noise) @ column.T * same
    return np.asarray(spread)


def _learnt(epochs: Sequence[Bin], left: Sequence[_Entry], own: int) -> Matrix:
    """``(m, 3)``: covariance of what is left over with the present wander of a receiver."""
    kept = [np.exp(-BIN_S * (epochs[0].number - epochs[each.epoch].number) / WANDER_S) for each in left]
    signs = np.array([share * each.sign(own) for share, each in zip(kept, left, strict=True)])
    return np.asarray(signs[:, None] * np.array([each.left.direction for each in left]) * np.square(WANDER_M))


def _shifts(left: Sequence[_Entry], epochs: int, agent: int) -> Matrix:
    """``(m, 3 epochs)``: what a shift of a receiver in each epoch adds to what is left over."""
    columns = np.zeros((len(left), epochs, 3))
    for row, each in enumerate(left):
        columns[row, each.epoch] = each.sign(agent) * each.left.direction
    return columns.reshape(len(left), -1)


def _profiles(epochs: Sequence[Bin]) -> list[Vector]:
    """How a shift may have come about: its share of now in each epoch. At once at some time, or growing since."""
    age_s = BIN_S * np.array([epochs[0].number - made.number for made in epochs])
    steps = [np.asarray(age_s <= begun, np.float64) for begun in age_s]
    return steps + [np.maximum(1.0 - age_s / begun, 0.0) for begun in RAMPS_S if begun < age_s[-1] + WANDER_S]


def _gain(residuals: Vector, columns: Matrix, variance: Vector) -> tuple[float, Vector]:
    """Odds of an error along whitened columns ``(m, k)``, of a prior ``variance`` ``(k,)``, against none, nats; and
    that error, its mean."""
    projected = columns.T @ residuals
    information = columns.T @ columns + np.diag(1.0 / variance)
    error = np.asarray(np.linalg.solve(information, projected), np.float64)
    size = float(np.linalg.slogdet(information * variance)[1])
    return 0.5 * float(projected @ error) - 0.5 * size, error


def largest(values: Mapping[int, float]) -> tuple[int | None, float]:
    """The key with the largest value, and by how much it leads; a single one leads by all that it has."""
    ranked = sorted(values, key=lambda key: -values[key])
    if not ranked:
        return None, 0.0
    return ranked[0], values[ranked[0]] - (values[ranked[1]] if len(ranked) > 1 else 0.0)
