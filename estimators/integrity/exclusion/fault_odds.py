"""Who is off: the odds of a receiver's shift, and of ranges that are too long or short, against nobody's.

Generalised likelihood ratios after Willsky and Jones (1976), with a prior on the fault's size, so that they are odds.
A fault begins in some bin and then stays (a step) or grows (a ramp). Its effect on what is new in each bin, and on
what the filter of slow errors has learnt wrong from it, is known but for its size, so two sums tell the odds. Begins
are kept closely for the last seconds, and ever more sparsely before.

While nobody is off, the odds of one begin exceed exp(x) at any time with a probability of exp(-x) (Ville), so a
threshold follows from how many begins there are in an hour (`thresholds.NAMED_NATS`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.exclusion.baselines import BIN_S, Pair
from estimators.integrity.exclusion.slow_errors import Fresh, SlowErrors
from estimators.model.measurements import Matrix, Vector

Floats = NDArray[np.float64]

STEP_M = (8.0, 8.0, 3.0)
"""1-sigma of a shift, north, east, down. Fixes are dragged away along the ground more than up; and heights are what
fixes and ranges of drones side by side tell least, so that a shift of one in height would pass for much else."""
FAST_MPS = (3.0, 3.0, 1.0)
"""The same of the rate at which a shift grows fast."""
SLOW_MPS = (0.3, 0.3, 0.1)
"""And slowly."""
RANGES_STEP_M = 8.0
RANGES_RAMP_MPS = 3.0
"""Of ranges: a constant, or, as where they repeat, the distance that they miss."""
BEGIN_BINS = 2
"""A fault may begin in every second bin."""
SLOW_BINS = 32
"""Slow ones are told by what has grown over long, so that it does not matter when exactly: they begin seldom, and as
there are fewer, each is as likely as so many others."""
CLOSE_BINS = 8
"""Begins of the last bins are all kept; before, four in each doubling of the age."""
OLDEST_BINS = 512
OLDEST_RANGES_BINS = 64
"""Ranges go wrong at once: no long memory is needed."""
RANGES_PAY_NATS = 2.0
"""What each of them pays for that there are more ways for ranges to be off than for receivers."""
STEP, RAMP = 0, 1


@dataclass(frozen=True, slots=True)
class LikelyFault:
    """The likeliest fault of somebody, since some bin."""

    nats: float
    error: Vector
    """``(k,)``: its size, m or m/s."""
    covariance: Matrix
    """``(k, k)``."""
    effect: Matrix
    """``(N, k)``: on what the filter of slow errors has learnt."""
    grown: float
    """What makes m of the size by now."""
    age_s: float
    """Since its begin."""

    @property
    def shift_m(self) -> Vector:
        """``(k,)``: of now."""
        return self.grown * self.error


@dataclass(frozen=True, slots=True)
class _Best:
    """Of somebody: the likeliest begin and size."""

    nats: float
    begin: int
    profile: int
    number: int
    error: Vector
    covariance: Matrix


@dataclass(frozen=True, slots=True)
class Odds:
    """For each receiver and for ranges being off, against nobody, where it is not unlikely."""

    receivers: dict[int, LikelyFault]
    ranges: dict[tuple[Pair, ...], LikelyFault]
    """Of one pair; of two pairs of one drone that are swapped (`swaps`); and of all of a drone, alike."""


@dataclass(frozen=True, slots=True)
class _Size:
    """What a fault may have come to: its profile, the 1-sigma ``(k,)`` of its size, and the bins between begins."""

    profile: int
    sigma: Vector
    every: int = BEGIN_BINS

    def nats(self, begun: NDArray[np.int64]) -> Floats:
        """``(b,)``: what each begin is likelier than one of every `BEGIN_BINS`."""
        return np.where(begun % self.every == 0, np.log(self.every / BEGIN_BINS), -np.inf)


class _Sums:
    """Of one sort of fault with ``k`` unknowns: begins ``b``, whose ``w``, profiles ``p``."""

    def __init__(self, sizes: tuple[_Size, ...], oldest: int) -> None:
        self.sizes = sizes
        self.profiles = 1 + max(each.profile for each in sizes)
        self._oldest = oldest
        self.begun: NDArray[np.int64] = np.zeros(0, np.int64)
        self.clear(0, 0, 0)

    def clear(self, states: int, whose: int, unknowns: int) -> None:
        """Begin anew."""
        self.begun = np.zeros(0, np.int64)
        self.effect = np.zeros((0, whose, self.profiles, unknowns, states))
        self.information = np.zeros((0, whose, self.profiles, unknowns, unknowns))
        self.vector = np.zeros((0, whose, self.profiles, unknowns))

    def begin(self, number: int) -> None:
        """A fault may begin in this bin; let go of old begins that others stand for."""
        if number % BEGIN_BINS and len(self.begun):
            return
        kept = np.array([_is_kept(number - int(each), int(each), self._oldest) for each in self.begun], np.bool_)
        for name in ("effect", "information", "vector"):
            held = getattr(self, name)
            setattr(self, name, np.concatenate((held[kept], np.zeros((1, *held.shape[1:])))))
        self.begun = np.append(self.begun[kept], number)

    def grown(self, number: int) -> Floats:
        """``(b, p)``: what a size has become by the middle of a bin."""
        age_s = BIN_S * (number - self.begun + 0.5)
        return np.stack((np.ones_like(age_s), age_s), axis=1)[:, : self.profiles]

    def add(self, number: int, fresh: Fresh, columns: Floats, gain: Matrix) -> None:
        """Take in a bin; ``columns`` ``(w, k, r)``: what a fault of size one adds to what is new, whitened."""
        sized = self.grown(number)[:, None, :, None, None] * columns[None, :, None]
        change = sized - self.effect @ fresh.rows.T
        self.information += change @ np.swapaxes(change, -1, -2)
        self.vector += change @ fresh.value
        self.effect += change @ gain.T

    def likely(self, number: int, least_nats: float) -> dict[int, LikelyFault]:
        """The likeliest of each, by its place, where it is likelier than that."""
        found = self._best(number, self.sizes, self.information, self.vector, least_nats)
        return {whose: self._made(each, whose, np.eye(self.vector.shape[-1])) for whose, each in found.items()}

    def likely_along(
        self, number: int, sizes: Sequence[_Size], ways: Matrix, least_nats: float
    ) -> dict[tuple[int, int], LikelyFault]:
        """The same of one unknown that makes all those of each, in some ``ways`` ``(m, k)``; by place and way."""
        if not ways.size:  # of a drone with one pair there are no two to be swapped
            return {}
        shape = len(self.begun), -1, self.profiles
        information = np.einsum("mi,bwpij,mj->bwmp", ways, self.information, ways).reshape(*shape, 1, 1)
        vector = np.einsum("mi,bwpi->bwmp", ways, self.vector).reshape(*shape, 1)
        found = self._best(number, sizes, information, vector, least_nats)
        keyed = {divmod(place, len(ways)): each for place, each in found.items()}
        return {(whose, way): self._made(each, whose, ways[way : way + 1]) for (whose, way), each in keyed.items()}

    def _best(
        self, number: int, sizes: Sequence[_Size], information: Floats, vector: Floats, least_nats: float
    ) -> dict[int, _Best]:
        """Of sums ``(b, w, p, ...)``."""
        nats, found = [], []
        for size in sizes:
            told, along = information[:, :, size.profile], vector[:, :, size.profile]
            sigma = np.resize(size.sigma, told.shape[-1])
            covariance = np.linalg.inv(told + np.diag(sigma**-2.0))
            error = np.einsum("bwij,bwj->bwi", covariance, along)
            gain = 0.5 * np.einsum("bwi,bwi->bw", error, along)
            paid = -0.5 * np.linalg.slogdet(covariance / sigma**2)[1]
            nats.append(gain - paid + size.nats(self.begun)[:, None])
            found.append((size.profile, error, covariance))
        odds = np.array(nats)  # (sizes, b, w)
        flat = odds.reshape(-1, odds.shape[2])
        best = np.argmax(flat, axis=0)
        likely = {}
        for whose in np.flatnonzero(flat[best, np.arange(flat.shape[1])] > least_nats).tolist():
            size_at, begin = divmod(int(best[whose]), odds.shape[1])
            profile, error, covariance = found[size_at]
            likely[whose] = _Best(
                float(odds[size_at, begin, whose]),
                begin,
                profile,
                number,
                error[begin, whose],
                covariance[begin, whose],
            )
        return likely

    def _made(self, best: _Best, whose: int, ways: Matrix) -> LikelyFault:
        age_s = BIN_S * float(best.number + 1 - self.begun[best.begin])
        grown = float(self.grown(best.number)[best.begin, best.profile])
        effect = (ways @ self.effect[best.begin, whose, best.profile]).T
        return LikelyFault(best.nats, best.error, best.covariance, effect, grown, age_s)


class FaultOdds:
    """Takes in bin after bin; odds below ``least_nats`` are not told."""

    def __init__(self, least_nats: float) -> None:
        self._least_nats = least_nats
        ramps = _Size(RAMP, np.array(FAST_MPS)), _Size(RAMP, np.array(SLOW_MPS), SLOW_BINS)
        self._receivers = _Sums((_Size(STEP, np.array(STEP_M)), *ramps), OLDEST_BINS)
        ranges = _Size(STEP, np.array([RANGES_STEP_M])), _Size(RAMP, np.array([RANGES_RAMP_MPS]))
        self._ranges = _Sums(ranges, OLDEST_RANGES_BINS)
        """Of each drone, one unknown for each of its pairs."""

    def restart(self, slow: SlowErrors) -> None:
        """Begin anew, as after somebody was named or has come."""
        states, agents = len(slow.state), len(slow.agents)
        self._receivers.clear(states, agents, 3)
        self._ranges.clear(states, agents, agents - 1)

    def pass_by(self, slow: SlowErrors, bins: int) -> None:
        """So many bins pass."""
        for sums in (self._receivers, self._ranges):
            sums.effect *= slow.decay(bins)

    def take(self, number: int, slow: SlowErrors, fresh: Fresh, gain: Matrix) -> Odds:
        """Take in what is new in a bin, and the gain with which it was learnt from."""
        signs = np.array([fresh.sign(agent) for agent in slow.agents])
        of_pair = {pair: [float(each == pair) for each in fresh.pairs] for pair in slow.pairs}
        of_ranges = np.array([[of_pair[pair] for pair in _pairs_of(agent, slow)] for agent in slow.agents])
        axes = signs[:, None, :] * fresh.directions.T
        for sums, columns in ((self._receivers, axes), (self._ranges, of_ranges)):
            sums.begin(number)
            sums.add(number, fresh, columns @ fresh.whiten.T, gain)
        receivers = self._receivers.likely(number, self._least_nats).items()
        return Odds({slow.agents[at]: each for at, each in receivers}, self._of_ranges(number, slow, fresh))

    def _of_ranges(self, number: int, slow: SlowErrors, fresh: Fresh) -> dict[tuple[Pair, ...], LikelyFault]:
        """Of each pair, and of all of a drone alike.

        These are too long, and at once: nothing makes them all shorter, or ever longer, as a receiver does that is
        dragged away from the others or towards them.
        """
        count, sizes, least_nats = len(slow.agents) - 1, self._ranges.sizes, self._least_nats + RANGES_PAY_NATS
        each = self._ranges.likely_along(number, sizes, np.eye(count), least_nats)
        alike = self._ranges.likely_along(number, sizes[:1], np.ones((1, count)), least_nats)
        too_long = {key: fault for key, fault in alike.items() if fault.shift_m[0] > 0.0}
        found: dict[tuple[Pair, ...], LikelyFault] = {}
        for ways, likely in ((np.eye(count), each), (np.ones((1, count)), too_long)):
            for (at, way), fault in likely.items():
                of_agent = zip(_pairs_of(slow.agents[at], slow), ways[way], strict=True)
                pairs = tuple(pair for pair, part in of_agent if part)
                if set(pairs) <= set(fresh.pairs):
                    found[pairs] = replace(fault, nats=fault.nats - RANGES_PAY_NATS)
        return found


def _pairs_of(agent: int, slow: SlowErrors) -> list[Pair]:
    return [pair for pair in slow.pairs if agent in pair]


def _is_kept(age: int, begun: int, oldest: int) -> bool:
    if age <= CLOSE_BINS:
        return True
    apart = 2 ** (age.bit_length() - CLOSE_BINS.bit_length() + 1)
    return age <= oldest and begun % apart == 0
