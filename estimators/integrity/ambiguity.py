"""Where else may a drone without fixes be: does the estimate hold the only place that the data allow?

The estimator linearises its ranges at one place. Started from a wrong one it may settle in a mirror image, and
its covariance knows nothing of the other. This monitor follows the own state from the own rows alone as a Gaussian
mixture (`estimators.integrity.hypotheses`), with the neighbours where the estimate has them, and says how wrong the
estimate may be. It sleeps while the drone has fixes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.hypotheses import (
    Mixture,
    correct_linear,
    correct_range,
    is_sound,
    on_sphere,
    predict,
    reduce,
    split,
)
from estimators.integrity.range_geometry import directions, spread
from estimators.integrity.thresholds import (
    BLIND_TICKS,
    CERTAIN,
    DECISIVE_NATS,
    DIRECTIONS,
    DISAGREEMENT_SQUARE,
    FLAT_SPREAD,
    FLOOR_M,
    LOCATED_FRACTION,
    OVERSTATED,
    RANGED_TICKS,
    SETTLED_TICKS,
    UNDERSTATED,
    WEAK_M,
)
from estimators.model.layout import block
from estimators.model.limits import StateLimits
from estimators.model.measurements import Kind, Matrix, RowTable, Vector
from estimators.model.members import MemberChange

SCATTERED_FRACTION = 0.3
"""Sigma of the only hypothesis against the shortest range from which on it is cut to patches of a sphere."""
SAGITTA = 1.5
"""Sagitta over one sigma of a hypothesis, in sigmas of the range, from which on the hypothesis is split."""

Body = tuple[Vector, Matrix]
"""Mean ``(6,)`` and covariance ``(6, 6)`` of one agent, NED m and m/s."""


@dataclass(frozen=True, slots=True)
class OwnEvidence:
    """What speaks of the own state in a tick."""

    fixed: bool
    """Whether the estimator's window holds a fix of this drone: then the rest is not looked at."""
    estimate: Body
    """The own state at this tick."""
    rows: RowTable
    """The tick's rows that name this drone."""
    accel: Vector
    """``(3,)``: over the tick that ends now, m/s2."""
    accel_variance: Vector
    """``(3,)``, (m/s2)2."""
    others: Mapping[int, Body]
    """The drones that are located, by slot, where the estimate has them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Understated(Finding):
    """The estimate's covariance is too small; ``value`` is the expected error in m, ``limit`` the claimed one."""

    second_moment: Matrix
    """E[(x - estimate)(x - estimate)'] ``(6, 6)``, over all hypotheses: what the covariance should be."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Elsewhere(Finding):
    """The estimate is not where the data hold to."""

    place: Body
    """The one place that they hold to."""


class _Ranged(NamedTuple):
    """A range and the body that it goes to."""

    range_m: float
    variance: float
    offset_s: float
    target: int
    """Slot, -1 for an anchor."""
    place: Vector
    spread: Matrix


class AmbiguityMonitor:
    """Follows one agent's own state; ``prior`` is its state before the first tick that is looked at."""

    def __init__(self, slot: int, prior: Body, period_s: float, limits: StateLimits | None = None) -> None:
        self._slot = slot
        self._period_s = period_s
        self._limits = limits
        self._mixture: Mixture | None = Mixture.single(*prior)
        """None while the drone has fixes."""
        self._estimate = prior
        """As of the last tick."""
        self._blind_ticks = BLIND_TICKS
        self._tick = 0
        self._places: dict[tuple[float, ...] | int, tuple[int, Vector]] = {}
        """Located bodies that ranges went to lately (slot, or an anchor's place): when, and where they were."""
        self._settled_ticks = 0
        self._foretold = Mixture.single(*prior)
        """The estimate of the last tick, moved to this one, with its rows other than ranges."""
        self._lead_nats = 0.0
        """How much better than the estimate the hypotheses foretold what was measured, while they are apart."""

    def observe(self, evidence: OwnEvidence) -> tuple[Finding, ...]:
        """Whether the place is ambiguous, the covariance too small (`Understated`), the drone `Elsewhere`."""
        before, self._estimate = self._estimate, evidence.estimate
        self._tick += 1
        self._blind_ticks = 0 if evidence.fixed else self._blind_ticks + 1
        if self._blind_ticks < BLIND_TICKS:
            self._mixture = None
            return ()
        if self._mixture is None:
            self._mixture = Mixture.single(*before)
        self._foretold = Mixture.single(*before)
        self._advance(self._mixture, evidence)
        mixture = self._mixture = self._corrected(self._mixture, evidence)
        if not is_sound(mixture) or not self._is_possible(mixture):
            mixture = self._mixture = Mixture.single(*evidence.estimate)
        return self._judged(mixture, evidence.estimate)

    def _is_possible(self, mixture: Mixture) -> bool:
        """Give up hypotheses that are beyond the limits; False where none is left."""
        if self._limits is None:
            return True
        allowed = self._limits.allow(self._slot, mixture.means, mixture.covariances)
        if allowed.any() and not allowed.all():
            mixture.log_weights, mixture.means = mixture.log_weights[allowed], mixture.means[allowed]
            mixture.covariances = mixture.covariances[allowed]
        return bool(allowed.any())

    def change_members(self, change: MemberChange, limits: StateLimits | None = None) -> None:
        """Go on with another fleet, its limits; who left or begins anew is no longer a body that ranges went to."""
        self._slot, self._limits = change.own, limits
        stayed = {before: slot for slot, before in change.stayed.items()}
        kept = {key: seen for key, seen in self._places.items() if not isinstance(key, int) or key in stayed}
        self._places = {stayed[key] if isinstance(key, int) else key: seen for key, seen in kept.items()}

    def _advance(self, mixture: Mixture, evidence: OwnEvidence) -> None:
        """Move to this tick and use its rows other than ranges."""
        rows = evidence.rows
        linear = rows[(rows["kind"] == Kind.POSITION) | (rows["kind"] == Kind.VELOCITY)]
        for each in (mixture, self._foretold):  # both, or the ranges are weighed against an older guess
            predict(each, evidence.accel, evidence.accel_variance, self._period_s)
            for row in linear[np.argsort(linear["value"], kind="stable")]:
                correct_linear(each, _slope(row), float(row["value"]), float(row["variance"]))

    def _corrected(self, mixture: Mixture, evidence: OwnEvidence) -> Mixture:
        """Use the ranges of the tick, nearest first, to the bodies that are located and to anchors."""
        usable = sorted(self._usable(evidence.rows, evidence.others), key=lambda each: each.range_m)
        for each in usable:
            key = each.target if each.target >= 0 else tuple(each.place[:3])
            self._places[key] = self._tick, each.place[:3]
        self._places = {key: seen for key, seen in self._places.items() if self._tick - seen[0] < RANGED_TICKS}
        if not usable:
            return mixture
        nearest = usable[0]
        others = [each.place[:3] - nearest.place[:3] for each in usable if each.target != nearest.target]
        forward = others[0] if others else mixture.means[0, 3:]
        self._compare(mixture, usable)
        if len(mixture.log_weights) == 1 and _sigma(mixture.covariances[0]) > SCATTERED_FRACTION * nearest.range_m:
            mixture = _scattered(mixture, nearest, forward)
            usable = usable[1:]
        sigma_m = float(np.sqrt(nearest.variance + _sigma(nearest.spread) ** 2))
        split(mixture, nearest.place[:3], float(np.sqrt(2.0 * SAGITTA * nearest.range_m * sigma_m)), forward)
        _use(mixture, usable)
        reduce(mixture)
        return mixture

    def _compare(self, mixture: Mixture, ranges: Sequence[_Ranged]) -> None:
        """Weigh the ranges about to be used: how much better the hypotheses foretell them than the estimate."""
        ours, theirs = mixture.copy(), self._foretold.copy()
        known_nats = ours.evidence - theirs.evidence  # of the rows that both have used
        _use(ours, ranges)
        _use(theirs, ranges)
        gained = self._lead_nats + ours.evidence - theirs.evidence - known_nats
        self._lead_nats = float(np.clip(gained, -2.0 * DECISIVE_NATS, 2.0 * DECISIVE_NATS))

    def _judged(self, mixture: Mixture, estimate: Body) -> tuple[Finding, ...]:
        """Compare with the estimate of this tick; where it has won, the hypotheses begin anew from it."""
        mean, covariance = estimate
        elsewhere: Body | None = None
        weight, there, spread_there = mixture.likeliest()
        if not _apart((there, spread_there), estimate):
            self._lead_nats = 0.0
        elif self._lead_nats < -DECISIVE_NATS:
            mixture = self._mixture = Mixture.single(*estimate)
            self._lead_nats = 0.0
        elif self._lead_nats > DECISIVE_NATS and weight > CERTAIN:
            elsewhere = there.copy(), spread_there.copy()
            self._lead_nats = 0.0
        moment = mixture.second_moment(mean)
        expected, claimed = float(np.trace(moment[:3, :3])), float(np.trace(covariance[:3, :3]))
        figures = (self._slot, float(np.sqrt(expected)), float(np.sqrt(claimed)))
        found: list[Finding] = []
        if self._is_ambiguous(expected, claimed, there[:3]):
            found.append(Finding(What.AMBIGUOUS, Gravity.ALARM, *figures))
        if expected > OVERSTATED * claimed:
            found.append(Understated(What.UNDERSTATED, Gravity.NOTED, *figures, second_moment=moment))
        if elsewhere is not None:
            found.append(Elsewhere(What.ELSEWHERE, Gravity.NOTED, self._slot, place=elsewhere))
        return tuple(found)

    def _is_ambiguous(self, expected_m2: float, claimed_m2: float, place: Vector) -> bool:
        """Whether the estimate is not to be trusted, or the ranges have not held the drone for long enough."""
        doubtful = expected_m2 > max(FLOOR_M**2, UNDERSTATED * claimed_m2)
        weak = expected_m2 > WEAK_M**2 and not determined(place, [known for _, known in self._places.values()])
        self._settled_ticks = 0 if doubtful or weak else self._settled_ticks + 1
        unsettled = len(self._places) < DIRECTIONS and self._settled_ticks <= SETTLED_TICKS
        return doubtful or weak or unsettled

    def _usable(self, rows: RowTable, bodies: Mapping[int, Body]) -> Iterator[_Ranged]:
        """The ranges among ``rows`` whose other end is where it is known to be."""
        between = (rows["kind"] == Kind.RANGE) | (rows["kind"] == Kind.ANCHOR_RANGE)
        for row in rows[between & (rows["value"] > 0.0)]:  # noise may push a short one below zero
            if row["kind"] == Kind.ANCHOR_RANGE:
                target = -1
                body = np.array([row["x"], row["y"], row["z"], 0.0, 0.0, 0.0]), np.zeros((6, 6))
            else:
                target = int(row["other"] if row["agent"] == self._slot else row["agent"])
                if target not in bodies or _sigma(bodies[target][1]) > LOCATED_FRACTION * float(row["value"]):
                    continue
                body = bodies[target]
            yield _Ranged(float(row["value"]), float(row["variance"]), float(row["offset_s"]), target, *body)


def _scattered(mixture: Mixture, nearest: _Ranged, forward: Vector) -> Mixture:
    """The one component cut to patches about the nearest neighbour."""
    variance = nearest.variance + _sigma(nearest.spread) ** 2
    centre = nearest.place[:3] + nearest.offset_s * (nearest.place[3:] - mixture.means[0, 3:])
    return on_sphere(mixture.means[0], mixture.covariances[0], centre, nearest.range_m, variance, forward)


def _use(mixture: Mixture, ranges: Sequence[_Ranged]) -> None:
    for each in ranges:
        correct_range(mixture, each.place, each.spread, each.range_m, each.variance, each.offset_s)


def determined(position_m: Vector, places: Sequence[Vector]) -> bool:
    """Whether ranges to ``places`` ``(3,)`` fix a position about ``position_m``, but for its mirror image.

    It takes three at least, in directions that are not all in a plane.
    """
    if len(places) < DIRECTIONS:
        return False
    return bool(spread(directions(position_m, np.array(places)))[0] > FLAT_SPREAD)


def _apart(one: Body, other: Body) -> bool:
    """Whether two estimates of a position cannot both be right."""
    away = (one[0] - other[0])[:3]
    return float(away @ np.linalg.solve((one[1] + other[1])[:3, :3], away)) > DISAGREEMENT_SQUARE


def own_rows(rows: RowTable, slot: int) -> RowTable:
    """Rows that speak of an agent: its own and ranges to it."""
    return np.asarray(rows[(rows["agent"] == slot) | (rows["other"] == slot)])


def _slope(row: np.void) -> Vector:
    direction = np.array([row["x"], row["y"], row["z"]])
    if row["kind"] == Kind.VELOCITY:
        return np.concatenate([np.zeros(3), direction])
    return np.concatenate([direction, float(row["offset_s"]) * direction])


def _sigma(covariance: Matrix) -> float:
    """Largest sigma of the position."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def body_of(mean: Vector, covariance: Matrix, slot: int) -> Body:
    """One agent's state out of the fleet's."""
    own = block(slot)
    return mean[own].copy(), covariance[own, own].copy()
