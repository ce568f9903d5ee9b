"""A second opinion on where a drone without fixes is: does the estimate hold the only place that the data allow?

The estimator linearises its ranges at one place. Started from a wrong one it may settle in a mirror image, and
its covariance knows nothing of the other. The witness follows the own state from the own rows alone as a
Gaussian mixture (`estimators.integrity.hypotheses`), with the neighbours where the estimate has them, and says
how wrong the estimate may be. It sleeps while the drone has fixes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

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
from estimators.model.layout import block
from estimators.model.measurements import Kind, Matrix, RowTable, Vector
from estimators.model.members import MemberChange

BLIND_TICKS = 10
"""Ticks without a position fix after which a drone that had some is taken to be without."""
LOCATED_FRACTION = 0.15
"""A neighbour is located where the sigma of its position is below this fraction of the range to it."""
SCATTERED_FRACTION = 0.3
"""Sigma of the only hypothesis against the shortest range from which on it is cut to patches of a sphere."""
SAGITTA = 1.5
"""Sagitta over one sigma of a hypothesis, in sigmas of the range, from which on the hypothesis is split."""
FLOOR_M = 0.15
"""Expected errors below this are not worth an alarm."""
UNDERSTATED = 4.0
"""Expected square error against the estimate's own variance from which on the estimate is not to be trusted."""
OVERSTATED = 1.5
"""Expected square error against the estimate's own variance from which on it replaces it."""
WEAK_M = 0.3
"""Expected error from which on ranges that do not determine a position leave it not observable."""
SETTLED_TICKS = 40
"""Ticks that such an error has to stay small before one or two neighbours in motion are taken to have done so."""
RECENT_TICKS = 10
"""Ranges are counted together over this time: not every module ranges to all neighbours in every tick."""
FLAT = 0.1
"""Smallest singular value of the directions to the neighbours below which they lie in a plane with the drone."""
CERTAIN = 0.999
DISAGREEMENT_SQUARE = 25.0
"""Squared Mahalanobis distance in position from which on the estimate is at another place."""
DECISIVE_NATS = 12.0
"""Difference of the log likelihoods of what the estimate and the hypotheses said would be measured, which decides."""

Body = tuple[Vector, Matrix]
"""Mean ``(6,)`` and covariance ``(6, 6)`` of one agent, NED m and m/s."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """What the witness says of an estimate of the own state."""

    ambiguous: bool
    understated: bool
    """Whether the estimate's covariance is too small."""
    second_moment: Matrix
    """E[(x - estimate)(x - estimate)'] ``(6, 6)``, over all hypotheses."""
    elsewhere: Body | None
    """The one place that the data hold to, where the estimate is not."""


class _Ranged(NamedTuple):
    """A range and the body that it goes to."""

    range_m: float
    variance: float
    offset_s: float
    target: int
    """Slot, -1 for an anchor."""
    place: Vector
    spread: Matrix


class Witness:
    """Follows one agent's own state; ``prior`` is its state at the first tick."""

    def __init__(self, slot: int, prior: Body, period_s: float) -> None:
        self.slot = slot
        self.mixture: Mixture | None = Mixture.single(*prior)
        """None while the drone has fixes."""
        self._period_s = period_s
        self._blind_ticks = BLIND_TICKS
        self._tick = 0
        self._places: dict[tuple[float, ...] | int, tuple[int, Vector]] = {}
        """Located bodies that ranges went to lately (slot, or an anchor's place): when, and where they were."""
        self._settled_ticks = 0
        self._foretold = Mixture.single(*prior)
        """The estimate of the last tick, moved to this one, with its rows other than ranges."""
        self._lead_nats = 0.0
        """How much better than the estimate the hypotheses foretold what was measured, while they are apart."""

    def advance(self, rows: RowTable, accel: Vector, accel_variance: Vector, fixed: bool, estimate: Body) -> None:
        """Move to the next tick and use its own rows other than ranges.

        ``accel`` ``(3,)``: over the tick that ends now, m/s2. ``fixed``: whether the estimator's window holds a fix
        of this drone. ``estimate``: the own state at the last tick, from which a drone that loses its fixes goes on.
        """
        if fixed:
            self.rest()
            return
        self._tick += 1
        self._blind_ticks += 1
        if self._blind_ticks < BLIND_TICKS:
            self.mixture = None
            return
        if self.mixture is None:
            self.mixture = Mixture.single(*estimate)
        self._foretold = Mixture.single(*estimate)
        linear = rows[(rows["kind"] == Kind.POSITION) | (rows["kind"] == Kind.VELOCITY)]
        for mixture in (self.mixture, self._foretold):  # both, or the ranges are weighed against an older guess
            predict(mixture, accel, accel_variance, self._period_s)
            for row in linear[np.argsort(linear["value"], kind="stable")]:
                correct_linear(mixture, _slope(row), float(row["value"]), float(row["variance"]))

    def rest(self) -> None:
        """Move to the next tick while the window holds a fix: there is nothing to doubt."""
        self._tick += 1
        self._blind_ticks = 0
        self.mixture = None

    def see(self, rows: RowTable, bodies: Mapping[int, Body]) -> None:
        """Use the ranges of a tick, nearest first, to the bodies that are located (by slot) and to anchors."""
        mixture = self.mixture
        if mixture is None:
            return
        usable = sorted(self._usable(rows, bodies), key=lambda each: each.range_m)
        for each in usable:
            key = each.target if each.target >= 0 else tuple(each.place[:3])
            self._places[key] = self._tick, each.place[:3]
        self._places = {key: seen for key, seen in self._places.items() if self._tick - seen[0] < RECENT_TICKS}
        if not usable:
            return
        nearest = usable[0]
        others = [each.place[:3] - nearest.place[:3] for each in usable if each.target != nearest.target]
        forward = others[0] if others else mixture.means[0, 3:]
        self._compare(usable)
        if len(mixture.log_weights) == 1 and _sigma(mixture.covariances[0]) > SCATTERED_FRACTION * nearest.range_m:
            mixture = self.mixture = _scattered(mixture, nearest, forward)
            usable = usable[1:]
        sigma_m = float(np.sqrt(nearest.variance + _sigma(nearest.spread) ** 2))
        split(mixture, nearest.place[:3], float(np.sqrt(2.0 * SAGITTA * nearest.range_m * sigma_m)), forward)
        _use(mixture, usable)
        reduce(mixture)

    def _compare(self, ranges: Sequence[_Ranged]) -> None:
        """Weigh the ranges about to be used: how much better the hypotheses foretell them than the estimate."""
        assert self.mixture is not None
        ours, theirs = self.mixture.copy(), self._foretold.copy()
        known_nats = ours.evidence - theirs.evidence  # of the rows that both have used
        _use(ours, ranges)
        _use(theirs, ranges)
        gained = self._lead_nats + ours.evidence - theirs.evidence - known_nats
        self._lead_nats = float(np.clip(gained, -2.0 * DECISIVE_NATS, 2.0 * DECISIVE_NATS))

    def judge(self, estimate: Body) -> Opinion | None:
        """Compare with the estimate of the own state at this tick; None while asleep."""
        if self.mixture is None:
            return None
        if not is_sound(self.mixture):
            self.mixture = Mixture.single(*estimate)
        mean, covariance = estimate
        elsewhere = None
        weight, there, spread = self.mixture.likeliest()
        if not _apart((there, spread), estimate):
            self._lead_nats = 0.0
        elif self._lead_nats < -DECISIVE_NATS:
            self.mixture = Mixture.single(*estimate)
            self._lead_nats = 0.0
        elif self._lead_nats > DECISIVE_NATS and weight > CERTAIN:
            elsewhere = there.copy(), spread.copy()
            self._lead_nats = 0.0
        moment = self.mixture.second_moment(mean)
        expected, claimed = float(np.trace(moment[:3, :3])), float(np.trace(covariance[:3, :3]))
        doubtful = expected > max(FLOOR_M**2, UNDERSTATED * claimed)
        weak = expected > WEAK_M**2 and not determined(there[:3], [place for _, place in self._places.values()])
        self._settled_ticks = 0 if doubtful or weak else self._settled_ticks + 1
        unsettled = len(self._places) < 3 and self._settled_ticks <= SETTLED_TICKS
        ambiguous = doubtful or weak or unsettled
        return Opinion(ambiguous, expected > OVERSTATED * claimed, moment, elsewhere)

    def change_members(self, change: MemberChange) -> None:
        """Go on with another fleet; who left or begins anew is no longer a body that ranges went to."""
        self.slot = change.own
        stayed = {before: slot for slot, before in change.stayed.items()}
        kept = {key: seen for key, seen in self._places.items() if not isinstance(key, int) or key in stayed}
        self._places = {stayed[key] if isinstance(key, int) else key: seen for key, seen in kept.items()}

    def _usable(self, rows: RowTable, bodies: Mapping[int, Body]) -> Iterator[_Ranged]:
        """The ranges among ``rows`` whose other end is where it is known to be."""
        between = (rows["kind"] == Kind.RANGE) | (rows["kind"] == Kind.ANCHOR_RANGE)
        for row in rows[between & (rows["value"] > 0.0)]:  # noise may push a short one below zero
            if row["kind"] == Kind.ANCHOR_RANGE:
                target = -1
                body = np.array([row["x"], row["y"], row["z"], 0.0, 0.0, 0.0]), np.zeros((6, 6))
            else:
                target = int(row["other"] if row["agent"] == self.slot else row["agent"])
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
    if len(places) < 3:
        return False
    away = position_m - np.array(places)
    directions = away / np.maximum(np.linalg.norm(away, axis=-1), 1e-6)[:, None]
    return bool(np.linalg.svd(directions, compute_uv=False)[-1] > FLAT)


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
