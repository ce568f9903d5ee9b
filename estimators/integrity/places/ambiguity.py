"""Where else may a drone without fixes be: does the estimate hold the only place that the data allow?

The estimator linearises its ranges at one place. Started from a wrong one it may settle in a mirror image, and
its covariance knows nothing of the other. This monitor follows the drone's state from its rows alone as a Gaussian
mixture (`estimators.integrity.places.hypotheses`), with the neighbours where the estimate has them, and says how
wrong the estimate may be. It sleeps while the drone has fixes.

The estimate is one hypothesis among the others, and so are the mirror images in the plane of the bodies ranged to
(`estimators.integrity.places.mirror_images`): all are corrected with the same rows in the same way, and the doubt
between two ends when the odds between them are decisive. Every agent runs a monitor for every drone whose records it
holds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.places.hypotheses import (
    Drift,
    Mixture,
    correct_linear,
    correct_range,
    is_sound,
    on_sphere,
    predict,
    reduce,
    split,
)
from estimators.integrity.places.mirror_images import hold_both_sides, image_of
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
from estimators.model.layout import STATES_PER_AGENT, block
from estimators.model.limits import StateLimits
from estimators.model.measurements import Kind, Matrix, RowTable, Vector
from estimators.model.members import MemberChange

SCATTERED_FRACTION = 0.3
"""Sigma of the only hypothesis against the shortest range from which on it is cut to patches of a sphere."""
SAGITTA = 1.5
"""Sagitta over one sigma of a hypothesis, in sigmas of the range, from which on the hypothesis is split."""

LASTING_S = 2.0
"""How long the error of a body's place lasts where one or two bodies hold a drone: ranges that are all off in one way
then tell where it is about them. White noise of a variance 2 t s over the period has the effect of an error of
variance s that lasts for t."""

Body = tuple[Vector, Matrix]
"""Mean ``(6,)`` and covariance ``(6, 6)`` of one agent, NED m and m/s; with the error of its acceleration, m/s2,
where that is followed, ``(9,)`` and ``(9, 9)``."""


@dataclass(frozen=True, slots=True)
class DroneEvidence:
    """What speaks of one drone's state in a tick."""

    fixed: bool
    """Whether the estimator's window holds a fix of this drone: then the rest is not looked at."""
    heard: bool
    """Whether the window holds anything that this drone measured: one never heard is not known to be blind."""
    estimate: Body
    """Its state at this tick."""
    rows: RowTable
    """The tick's rows that name this drone."""
    accel: Vector
    """``(3,)``: over the tick that ends now, m/s2."""
    accel_variance: Vector
    """``(3,)``, (m/s2)2."""
    others: Mapping[int, Body]
    """The drones that are located, by slot, where the estimate has them."""
    drift: Drift | None = None
    """How the error of its acceleration lasts; with it the estimate has nine states."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Understated(Finding):
    """The estimate's covariance is too small; ``value`` is the expected error in m, ``limit`` the claimed one."""

    second_moment: Matrix
    """E[(x - estimate)(x - estimate)'] of its states, over all hypotheses: what the covariance should be."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundAgain(Understated):
    """The drone has a fix again, which the estimate would not believe."""


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
    """Follows the drone in ``slot``; ``prior`` is its state before the first tick that is looked at."""

    def __init__(self, slot: int, prior: Body, period_s: float, limits: StateLimits | None = None) -> None:
        self._slot = slot
        self._period_s = period_s
        self._limits = limits
        self._mixture: Mixture | None = None
        """None while the drone has fixes, and before it is heard."""
        self._estimate = prior
        """As of the last tick."""
        self._drift: Drift | None = None
        """Likewise."""
        self._blind_ticks = BLIND_TICKS
        self._tick = 0
        self._places: dict[tuple[float, ...] | int, tuple[int, Vector]] = {}
        """Located bodies that ranges went to lately (slot, or an anchor's place): when, and where they were."""
        self._settled_ticks = 0

    def observe(self, evidence: DroneEvidence) -> tuple[Finding, ...]:
        """Whether the place is ambiguous, the covariance too small (`Understated`), the drone `Elsewhere`."""
        before, self._estimate = self._estimate, evidence.estimate
        if evidence.drift is not None and len(before[0]) == STATES_PER_AGENT:
            before = _drifting(before, evidence.drift)
        self._tick += 1
        if not evidence.fixed and not evidence.heard and self._mixture is None:
            return ()
        self._blind_ticks = 0 if evidence.fixed else self._blind_ticks + 1
        if self._blind_ticks < BLIND_TICKS:
            mixture, self._mixture = self._mixture, None
            return () if mixture is None else self._found_again(mixture, before)
        mixture = Mixture.single(*before) if self._mixture is None else self._mixture
        self._advance(mixture, evidence)
        mixture = self._corrected(mixture, evidence)
        if not is_sound(mixture) or not self._is_possible(mixture):
            mixture = Mixture.single(*evidence.estimate)
        self._mixture = mixture
        return self._judged(mixture, evidence)

    def _found_again(self, mixture: Mixture, estimate: Body) -> tuple[Finding, ...]:
        """With the first fix: what the estimate that it meets should have been taken for."""
        moment = mixture.second_moment(estimate[0])
        expected, claimed = float(np.trace(moment[:3, :3])), float(np.trace(estimate[1][:3, :3]))
        if expected <= OVERSTATED * claimed:
            return ()
        figures = (self._slot, float(np.sqrt(expected)), float(np.sqrt(claimed)))
        return (FoundAgain(What.UNDERSTATED, Gravity.NOTED, *figures, second_moment=moment),)

    def is_held(self, located: NDArray[np.bool_]) -> bool:
        """Whether the drone has fixes, or ranges to drones of ``located`` ``(n,)`` and to anchors determine it.

        Who is held so is one that others may be located by. Drones without fixes that hold only each other turn
        together about those that they hang on, and none of them is told by the others that it does.
        """
        return self._blind_ticks < BLIND_TICKS or determined(self._estimate[0][:3], self._ranged(located))

    def leaves_two_places(self, located: NDArray[np.bool_]) -> bool:
        """Whether there are enough of ``located`` ``(n,)`` and anchors for a place and its mirror image at most."""
        return len(self._ranged(located)) >= DIRECTIONS

    def _ranged(self, located: NDArray[np.bool_]) -> list[Vector]:
        """Where those are that ranges went to lately."""
        return [place for key, (_, place) in self._places.items() if not isinstance(key, int) or located[key]]

    def restart(self, estimate: Body) -> None:
        """Go on from an estimate of this tick, whose other places somebody else holds."""
        self._estimate, self._mixture = estimate, Mixture.single(*estimate)
        self._tick += 1
        self._settled_ticks = SETTLED_TICKS + 1

    def _is_possible(self, mixture: Mixture) -> bool:
        """Give up hypotheses that are beyond the limits; False where none is left."""
        if self._limits is None:
            return True
        allowed = self._limits.allow(self._slot, mixture.means[:, :6], mixture.covariances[:, :6, :6])
        if allowed.any() and not allowed.all():
            mixture.log_weights, mixture.means = mixture.log_weights[allowed], mixture.means[allowed]
            mixture.covariances = mixture.covariances[allowed]
        return bool(allowed.any())

    def change_members(self, change: MemberChange, limits: StateLimits | None = None) -> None:
        """Go on with another fleet, its limits, of which the drone is still a part.

        Who left or begins anew is no longer a body that ranges went to.
        """
        stayed = {before: slot for slot, before in change.stayed.items()}
        self._slot, self._limits = stayed[self._slot], limits
        kept = {key: seen for key, seen in self._places.items() if not isinstance(key, int) or key in stayed}
        self._places = {stayed[key] if isinstance(key, int) else key: seen for key, seen in kept.items()}

    def _advance(self, mixture: Mixture, evidence: DroneEvidence) -> None:
        """Move to this tick and use its rows other than ranges."""
        rows = evidence.rows
        kind = rows["kind"]
        moves = (kind == Kind.VELOCITY) | (kind == Kind.ODOMETRY)
        linear = rows[moves | (kind == Kind.POSITION) | (kind == Kind.HEIGHT)]
        before, self._drift = self._drift, evidence.drift
        predict(mixture, evidence.accel, evidence.accel_variance, self._period_s, evidence.drift)
        if before is not None and evidence.drift is not None:  # an attitude that tilts does so at once
            grown = np.maximum(evidence.drift.size_mps2**2 - before.size_mps2**2, 0.0)
            mixture.covariances[:, range(6, 9), range(6, 9)] += grown
        for row in linear[np.argsort(linear["value"], kind="stable")]:
            correct_linear(mixture, _slope(row), float(row["value"]), float(row["variance"]))

    def _corrected(self, mixture: Mixture, evidence: DroneEvidence) -> Mixture:
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
        forward = others[0] if others else mixture.means[0, 3:6]
        if len(mixture.log_weights) == 1 and _sigma(mixture.covariances[0]) > SCATTERED_FRACTION * nearest.range_m:
            mixture = _scattered(mixture, nearest, forward)
            usable = usable[1:]
        sigma_m = float(np.sqrt(nearest.variance + _sigma(nearest.spread) ** 2))
        split(mixture, nearest.place[:3], float(np.sqrt(2.0 * SAGITTA * nearest.range_m * sigma_m)), forward)
        lasting = 2.0 * LASTING_S / self._period_s - 1.0 if len(self._places) < DIRECTIONS else 0.0
        for each in usable:
            variance = each.variance + lasting * float(np.trace(each.spread[:3, :3])) / 3.0
            correct_range(mixture, each.place, each.spread, each.range_m, variance, each.offset_s)
        return mixture

    def _judged(self, mixture: Mixture, evidence: DroneEvidence) -> tuple[Finding, ...]:
        """Compare with the estimate of this tick, which is one of the hypotheses."""
        mean, covariance = estimate = evidence.estimate
        bodies = self._bodies(evidence.others)
        elsewhere = _decided(mixture, estimate, bodies)
        reduce(mixture)
        hold_both_sides(mixture, *bodies)
        self._is_possible(mixture)  # an image may be beyond the limits
        _, there, _ = mixture.likeliest()
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

    def _bodies(self, others: Mapping[int, Body]) -> tuple[Matrix, Matrix]:
        """Where the bodies are that ranges went to lately, and how they move: positions, velocities ``(m, 3)``."""
        states: list[Vector] = []
        for key, (_, place) in self._places.items():
            if not isinstance(key, int):
                states.append(np.concatenate([place, np.zeros(3)]))
            elif key in others:
                states.append(others[key][0])
        bodies = np.array(states).reshape(-1, 6)
        return bodies[:, :3], bodies[:, 3:]

    def _usable(self, rows: RowTable, bodies: Mapping[int, Body]) -> Iterator[_Ranged]:
        """The ranges among ``rows`` whose other end is where it is known to be."""
        between = (rows["kind"] == Kind.RANGE) | (rows["kind"] == Kind.ANCHOR_RANGE)
        for row in rows[between & (rows["value"] > 0.0)]:  # noise may push a short one below zero
            if row["kind"] == Kind.ANCHOR_RANGE:
                target = -1
                body: Body = np.array([row["x"], row["y"], row["z"], 0.0, 0.0, 0.0]), np.zeros((6, 6))
            else:
                target = int(row["other"] if row["agent"] == self._slot else row["agent"])
                if target not in bodies or _sigma(bodies[target][1]) > LOCATED_FRACTION * float(row["value"]):
                    continue
                state, spread = bodies[target]
                side = -1.0 if row["agent"] == self._slot else 1.0
                shift = np.array([row["x"], row["y"], row["z"], 0.0, 0.0, 0.0])
                body = state + side * shift, spread
            yield _Ranged(float(row["value"]), float(row["variance"]), float(row["offset_s"]), target, *body)


def _scattered(mixture: Mixture, nearest: _Ranged, forward: Vector) -> Mixture:
    """The one component cut to patches about the nearest neighbour."""
    variance = nearest.variance + _sigma(nearest.spread) ** 2
    centre = nearest.place[:3] + nearest.offset_s * (nearest.place[3:] - mixture.means[0, 3:6])
    return on_sphere(mixture.means[0], mixture.covariances[0], centre, nearest.range_m, variance, forward)


def determined(position_m: Vector, places: Sequence[Vector]) -> bool:
    """Whether ranges to ``places`` ``(3,)`` fix a position about ``position_m``, but for its mirror image.

    It takes three at least, in directions that are not all in a plane.
    """
    if len(places) < DIRECTIONS:
        return False
    return bool(spread(directions(position_m, np.array(places)))[0] > FLAT_SPREAD)


def _decided(mixture: Mixture, estimate: Body, bodies: tuple[Matrix, Matrix]) -> Body | None:
    """The place that the data hold to against the estimate; a mixture that lacks the estimate's place gets it.

    It is as likely then as the others together: what is measured from then on decides, and of both in the same way.
    Where the estimate is a mirror image in the plane of ``bodies``, the image is added: it is as sure as what it
    mirrors, and neither side loses for knowing less of what cannot tell them apart.
    """
    here = ~_apart(mixture, estimate)
    all_nats, top = np.logaddexp.reduce(mixture.log_weights), float(mixture.log_weights.max())
    weight, place, spread = mixture.likeliest()
    if not here.any():
        image = image_of(place, spread, *bodies) if len(bodies[0]) >= DIRECTIONS else estimate
        mirrored = not _apart(Mixture.single(*image), estimate).any()
        mixture.add(float(all_nats), *(image if mirrored else estimate))
        return None
    if np.logaddexp.reduce(mixture.log_weights[here]) > all_nats - DECISIVE_NATS:
        return None
    if weight <= CERTAIN:  # which of the others is not decided: the estimate stays among them
        mixture.log_weights[here] = np.maximum(mixture.log_weights[here], top - DECISIVE_NATS)
        return None
    mixture.log_weights[here] = -np.inf
    return place[:6].copy(), spread[:6, :6].copy()


def _apart(mixture: Mixture, estimate: Body) -> NDArray[np.bool_]:
    """Which components ``(K,)`` and an estimate of the position cannot both be right."""
    away = mixture.means[:, :3] - estimate[0][:3]
    both = mixture.covariances[:, :3, :3] + estimate[1][:3, :3]
    square = np.einsum("ki,ki->k", away, np.linalg.solve(both, away[:, :, None])[:, :, 0])
    return np.asarray(square > DISAGREEMENT_SQUARE)


def _drifting(body: Body, drift: Drift) -> Body:
    """A state ``(6,)`` with an error of its acceleration of which nothing is known yet."""
    covariance = np.zeros((9, 9))
    covariance[:6, :6], covariance[6:, 6:] = body[1], np.diag(drift.size_mps2**2)
    return np.concatenate((body[0], np.zeros(3))), covariance


def rows_of(rows: RowTable, slot: int) -> RowTable:
    """Rows that speak of an agent: its own and ranges to it."""
    return np.asarray(rows[(rows["agent"] == slot) | (rows["other"] == slot)])


def _slope(row: np.void) -> Vector:
    direction = np.array([row["x"], row["y"], row["z"]] if row["kind"] != Kind.HEIGHT else [0.0, 0.0, 1.0])
    if row["kind"] in (Kind.VELOCITY, Kind.ODOMETRY):
        return np.concatenate([np.zeros(3), direction])
    return np.concatenate([direction, float(row["offset_s"]) * direction])


def _sigma(covariance: Matrix) -> float:
    """Largest sigma of the position."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def body_of(mean: Vector, covariance: Matrix, slot: int) -> Body:
    """One agent's state out of the fleet's."""
    own = block(slot)
    return mean[own].copy(), covariance[own, own].copy()
