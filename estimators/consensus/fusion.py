"""Consensus by weighted fusion: each round, a convex combination of the neighbourhood's information pairs."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from estimators.consensus.information import NO_PAIRS, Pairs, WeightRule, fuse_pairs, usable_pairs, weigh
from estimators.estimator import Payload
from estimators.model.gaussian import Pair


class Fusion:
    """The rounds (11)-(14) of Borelle et al. 2023, by the weights of a rule.

    The last round's combination waits until its result is asked for: a compiled step does it with the rest of its
    work (`unfused`).
    """

    def __init__(self, rule: WeightRule) -> None:
        self.refused = 0
        """Neighbours' pairs of the right tick that could not be fused."""
        self._rule = rule
        self._own = Payload(0, np.zeros((0, 0)), np.zeros(0), 0)
        self._pending: Pairs | None = None
        self._ranks: dict[int, int] = {}
        self._degree = 0

    def begin(self, tick: int, pair: Pair, rank: int) -> None:
        """Begin the rounds of a tick with the own pair, of the state at ``tick``, and the own observability rank."""
        self._own = Payload(tick, *pair, rank, self._degree)
        self._pending = None
        self._ranks = {}

    def outgoing(self) -> Payload:
        """What neighbours get after the rounds so far."""
        if self._pending is not None:
            pair, self._pending = fuse_pairs(self._pending), None
            self._own = Payload(self._own.tick, *pair, self._own.rank, self._own.degree)
        return self._own

    def mix(self, round_: int, received: Mapping[int, Payload], *, fuse: bool = True) -> Collection[int]:
        """One round with what neighbours sent, by slot; gives whose pairs could be fused.

        Pairs of another tick are not used. With ``fuse`` false the own pair stays what it is.
        """
        usable, refused = usable_pairs(received, self._own.tick, len(self._own.vector))
        self.refused += refused
        if round_ == 0:
            self._ranks = {slot: pair.rank for slot, pair in usable.items()}
            self._degree = len(usable)
        own = self.outgoing()
        self._own = Payload(own.tick, own.information, own.vector, own.rank, self._degree)
        if fuse:
            self._pending = weigh(self._own, usable, self._rule, self._ranks)
        return usable

    def unfused(self) -> tuple[Pair, Pairs]:
        """The pair that the rounds made, or room for it and the pairs still to be combined into it."""
        if self._pending is None:
            return (self._own.information, self._own.vector), NO_PAIRS
        n = len(self._own.vector)
        return (np.empty((n, n)), np.empty(n)), self._pending

    def change_members(self) -> None:
        """Go on with another fleet: the neighbours are to be counted anew."""
        self._degree = 0
