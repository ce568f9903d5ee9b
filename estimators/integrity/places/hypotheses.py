"""A Gaussian mixture over one drone's state: hypotheses about where it is, kept apart until data decide.

A drone without position fixes is told where it is by ranges. One range leaves a sphere, two a circle, three a
point and its mirror image in the plane of the neighbours: a single Gaussian linearised at one place cannot say
that. Each component here is a second-order extended Kalman filter over the six states, its weight the likelihood
of what was measured (Gaussian sum filter; Alspach and Sorenson, IEEE TAC 1972). All components are corrected at
once, as arrays. NED, m and m/s.

Where the error of the drone's acceleration lasts (`Drift`), it is three more states, m/s2: which error it would
have to be differs from place to place, and white noise of its size would tell places apart that are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_upper
from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.row_kernels import IntArray

PRUNED_NATS = 14.0
"""Components less likely than the likeliest by more than this (a factor of 1.2e6) are given up; what decides between
two places (`estimators.integrity.thresholds.DECISIVE_NATS`) is less, so that nothing dies undecided."""
MERGED_SQUARE = 2.0
"""Squared Mahalanobis distance over all states below which two components say the same; the parts of a split
are 9 apart."""
MOST = 128
"""Components at most: nothing is split beyond it."""
SPLIT_SHIFT = 1.5
"""How far, in sigma, the outer two of three parts are moved; each is half as wide, their weights 1/6, 2/3, 1/6."""
NEAREST_M = 1e-6
"""Distance at least: at none a range has no direction."""
LEANING = 1e-3
"""Preference among axes along which a component is equally wide: which one is taken must not depend on north."""


@dataclass(slots=True)
class Mixture:
    """K components; the weights sum to one after `reduce`."""

    log_weights: Vector
    """``(K,)``."""
    means: Matrix
    """``(K, 6)``, or ``(K, 9)`` with the error of the acceleration."""
    covariances: Matrix
    """``(K, 6, 6)`` or ``(K, 9, 9)``."""

    @classmethod
    def single(cls, mean: Vector, covariance: Matrix) -> Mixture:
        """One component, certain."""
        return cls(np.zeros(1), np.array(mean, float)[None], np.array(covariance, float)[None])

    def copy(self) -> Mixture:
        """One that can be changed without this one."""
        return Mixture(self.log_weights.copy(), self.means.copy(), self.covariances.copy())

    def add(self, log_weight: float, mean: Vector, covariance: Matrix) -> None:
        """One more component; the weights of the others stay as they are."""
        self.log_weights = np.append(self.log_weights, log_weight)
        self.means = np.concatenate([self.means, mean[None]])
        self.covariances = np.concatenate([self.covariances, covariance[None]])

    @property
    def weights(self) -> Vector:
        """``(K,)``, summing to one."""
        scaled = np.exp(self.log_weights - self.log_weights.max())
        return np.asarray(scaled / scaled.sum(), np.float64)

    def likeliest(self) -> tuple[float, Vector, Matrix]:
        """Weight, mean and covariance of the likeliest component."""
        best = int(np.argmax(self.log_weights))
        return float(self.weights[best]), self.means[best], self.covariances[best]

    def second_moment(self, about: Vector) -> Matrix:
        """E[(x - about)(x - about)']: how wrong an estimate ``about`` of all states may be."""
        away = self.means - about
        each = self.covariances + away[:, :, None] * away[:, None, :]
        return np.asarray(np.einsum("k,kij->ij", self.weights, each), np.float64)


@dataclass(frozen=True, slots=True)
class Drift:
    """How the lasting error of an acceleration goes on: a Gauss-Markov process."""

    kept: float
    """Factor per tick, 0..1."""
    size_mps2: Vector
    """``(3,)`` standard deviations."""


def predict(
    mixture: Mixture, accel: Vector, accel_variance: Vector, period_s: float, drift: Drift | None = None
) -> None:
    """Move all components over a tick with an acceleration ``(3,)`` in m/s2 and its variances.

    ``drift``: how its error goes on, where that is a state.
    """
    move, kinematic = _kinematics(period_s)
    if drift is None:
        transition, push, noise = move, kinematic, np.zeros((6, 6))
    else:
        transition, push, noise = drift.kept * np.eye(9), np.zeros((9, 3)), np.zeros((9, 9))
        transition[:6, :6], transition[:6, 6:], push[:6] = move, -kinematic, kinematic
        noise[range(6, 9), range(6, 9)] = (1.0 - drift.kept**2) * drift.size_mps2**2
    mixture.means = mixture.means @ transition.T + push @ accel
    noise += (push * accel_variance) @ push.T
    mixture.covariances = transition @ mixture.covariances @ transition.T + noise


@cache
def _kinematics(period_s: float) -> tuple[Matrix, Matrix]:
    """Transition ``(6, 6)`` and input matrix ``(6, 3)`` of one agent; they are not to be changed."""
    return transition_matrix(1, period_s), input_matrix(1, period_s)


def correct_linear(mixture: Mixture, slope: Vector, value: float, variance: float) -> None:
    """Correct with a scalar ``slope . x`` + noise; ``slope`` ``(6,)``, the error of an acceleration has none."""
    slope = np.pad(slope, (0, mixture.means.shape[1] - len(slope)))
    innovation = value - mixture.means @ slope
    gain = mixture.covariances @ slope
    _update(mixture, gain, gain @ slope + variance, innovation)


def correct_range(
    mixture: Mixture, place: Vector, place_covariance: Matrix, value_m: float, variance: float, offset_s: float = 0.0
) -> None:
    """Correct with a range to a body whose state ``(6,)`` is known with a covariance; fixed anchors have none.

    Second order: the mean and the variance of what the linearisation misses are in the innovation.
    """
    parts = mixture.log_weights, mixture.means, mixture.covariances
    log_weights, means, covariances = (np.array(part, order="C") for part in parts)
    _use_range(log_weights, means, covariances, place, place_covariance, value_m, variance, offset_s)
    mixture.log_weights, mixture.means, mixture.covariances = log_weights, means, covariances


@entry(
    "void(float64[::1], float64[:, ::1], float64[:, :, ::1], float64[::1], float64[:, ::1], float64, float64,"
    " float64)"
)
def _use_range(
    log_weights: Vector,
    means: Matrix,
    covariances: Matrix,
    place: Vector,
    place_covariance: Matrix,
    value_m: float,
    variance: float,
    offset_s: float,
) -> None:
    size = means.shape[1]
    other, both, bent = _moved(place_covariance, offset_s), np.empty((3, 3)), np.empty((3, 3))
    away, unit, gain = np.empty(3), np.empty(3), np.empty(size)
    for k in range(len(log_weights)):
        mean, covariance = means[k], covariances[k]
        both[:, :] = _moved(covariance, offset_s) + other
        distance = 0.0
        for i in range(3):
            away[i] = mean[i] - place[i] + offset_s * (mean[3 + i] - place[3 + i])
            distance += away[i] ** 2
        distance = max(np.sqrt(distance), NEAREST_M)
        unit[:] = away / distance
        along = unit[0] * both[0] + unit[1] * both[1] + unit[2] * both[2]
        for i in range(3):
            bent[i] = (both[i] - unit[i] * along) / distance
        total, predicted = variance, distance + 0.5 * (bent[0, 0] + bent[1, 1] + bent[2, 2])
        for i in range(3):
            for j in range(3):
                total += 0.5 * bent[i, j] * bent[j, i] + unit[i] * other[i, j] * unit[j]
        for i in range(size):
            gain[i] = 0.0
            for j in range(3):
                gain[i] += (covariance[i, j] + offset_s * covariance[i, 3 + j]) * unit[j]
        for j in range(3):
            total += unit[j] * (gain[j] + offset_s * gain[3 + j])
        innovation = value_m - predicted
        log_weights[k] -= 0.5 * (innovation**2 / total + np.log(total))
        for i in range(size):
            mean[i] += gain[i] * innovation / total
            for j in range(i, size):
                reduced = 0.5 * (covariance[i, j] + covariance[j, i]) - gain[i] * gain[j] / total
                covariance[i, j] = covariance[j, i] = reduced


@kernel
def _moved(covariance: Matrix, offset_s: float) -> Matrix:
    """Covariance ``(3, 3)`` of the position of a state, ``offset_s`` later."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            crossed = covariance[3 + i, j] + covariance[i, 3 + j]
            out[i, j] = covariance[i, j] + offset_s * crossed + offset_s**2 * covariance[3 + i, 3 + j]
    return out


def _update(mixture: Mixture, gain: Matrix, variance: Vector, innovation: Vector) -> None:
    """Kalman update with unscaled gains ``(K, D)``, innovation variances and innovations ``(K,)``."""
    mixture.log_weights = mixture.log_weights - 0.5 * (innovation**2 / variance + np.log(variance))
    mixture.means = mixture.means + gain * (innovation / variance)[:, None]
    reduced = mixture.covariances - gain[:, :, None] * gain[:, None, :] / variance[:, None, None]
    mixture.covariances = 0.5 * (reduced + reduced.transpose(0, 2, 1))


def reduce(mixture: Mixture) -> None:
    """Normalise, give up unlikely components, merge those that say the same (moments are kept)."""
    order = np.argsort(-mixture.log_weights, kind="stable")[:MOST]
    order = order[mixture.log_weights[order] > mixture.log_weights[order[0]] - PRUNED_NATS]
    weights, means, covariances = mixture.weights[order], mixture.means[order], mixture.covariances[order]
    left = _merge(weights, means, covariances)
    mixture.log_weights = np.log(weights[:left] / weights[:left].sum())
    mixture.means, mixture.covariances = means[:left], covariances[:left]


@entry("int64(float64[::1], float64[:, ::1], float64[:, :, ::1])")
def _merge(weights: Vector, means: Matrix, covariances: Matrix) -> int:
    """Replace components, the likeliest first, by what is left of them when each has taken in those near to it.

    Gives how many are left, which stand in front.
    """
    count, size = means.shape
    open_, near, away, kept = np.ones(count, np.bool_), np.empty(count, np.int64), np.empty(size), 0
    for k in range(count):
        if not open_[k]:
            continue
        factor = covariances[k].copy()
        definite, found = cholesky_upper(factor), 0
        for j in range(k, count):
            if not open_[j]:
                continue
            if j > k:
                away[:] = means[j] - means[k]
                if not (definite and _is_near(factor, away)):
                    continue
            near[found], open_[j] = j, False
            found += 1
        weights[kept] = _moments(weights, means, covariances, near[:found], means[kept], covariances[kept])
        kept += 1
    return kept


@kernel
def _is_near(factor: Matrix, away: Vector) -> bool:
    """Whether ``away``, which is overwritten, is nearer than `MERGED_SQUARE`; a few states mostly say that it is not.

    ``factor`` is the upper one of the covariance: its transpose is solved for, a state after the other.
    """
    square = 0.0
    for i in range(len(away)):
        away[i] /= factor[i, i]
        square += away[i] * away[i]
        if not square < MERGED_SQUARE:
            return False
        for j in range(i + 1, len(away)):
            away[j] -= factor[i, j] * away[i]
    return True


@kernel
def _moments(
    weights: Vector, means: Matrix, covariances: Matrix, near: IntArray, mean: Vector, covariance: Matrix
) -> float:
    """mean, covariance <- those of the components ``near`` together; gives their weight."""
    total, centre, spread = 0.0, np.zeros(len(mean)), np.zeros(covariance.shape)
    for j in near:
        total += weights[j]
    for j in near:
        centre += weights[j] / total * means[j]
    for j in near:
        away = means[j] - centre
        spread += weights[j] / total * (covariances[j] + np.outer(away, away))
    mean[:], covariance[:, :] = centre, spread
    return total


def on_sphere(
    mean: Vector, covariance: Matrix, centre: Vector, radius_m: float, radial_variance: float, forward: Vector
) -> Mixture:
    """A wide Gaussian cut to patches of a sphere about ``centre`` ``(3,)``, each small against the radius.

    The patches are a Fibonacci lattice whose first point lies towards the mean and whose turn is given by
    ``forward`` ``(3,)``, so that a rotated problem gives the rotated patches. Each patch is fused with the Gaussian,
    which weighs it; the range itself is thereby used, with its variance ``radial_variance``.
    """
    directions = _lattice(SPHERE_PATCHES) @ _frame(mean[:3] - centre, forward)
    tangential = (radius_m * PATCH_SIGMA) ** 2
    bend = tangential / radius_m
    radial = radial_variance + bend * bend
    outer = directions[:, :, None] * directions[:, None, :]
    patches = tangential * np.eye(3) + (radial - tangential) * outer
    points = centre + (radius_m - bend) * directions  # a patch of a tangent plane lies outside the sphere on average
    total = covariance[:3, :3] + patches
    away = points - mean[:3]
    gain = covariance[:, :3] @ np.linalg.inv(total)
    square = np.einsum("ki,ki->k", away, np.linalg.solve(total, away[:, :, None])[:, :, 0])
    fused = covariance - gain @ covariance[:3, :]
    return Mixture(
        -0.5 * (square + np.linalg.slogdet(total)[1]),
        mean + np.einsum("kij,kj->ki", gain, away),
        0.5 * (fused + fused.transpose(0, 2, 1)),
    )


SPHERE_PATCHES = 64
PATCH_SIGMA = float(np.sqrt(np.pi / SPHERE_PATCHES))
"""Sigma of a patch against the radius: half the distance of its neighbours in the lattice."""


def _lattice(count: int) -> Matrix:
    """Directions ``(count, 3)`` spread evenly over the sphere, the first along the first axis."""
    k = np.arange(count)
    along = 1.0 - 2.0 * k / (count - 1.0)
    turn = k * np.pi * (3.0 - np.sqrt(5.0))
    across = np.sqrt(np.maximum(1.0 - along**2, 0.0))
    return np.stack([along, across * np.cos(turn), across * np.sin(turn)], axis=-1)


def _frame(first: Vector, second: Vector) -> Matrix:
    """Right-handed axes as rows ``(3, 3)``: along ``first``, then ``second`` as far as it is not along it."""
    axes: list[Vector] = []
    for candidate in (first, second, *np.eye(3)):
        for axis in axes:
            candidate = candidate - (candidate @ axis) * axis
        length = np.linalg.norm(candidate)
        if length > 1e-3:
            axes.append(candidate / length)
        if len(axes) == 2:
            break
    return np.array([axes[0], axes[1], np.cross(axes[0], axes[1])])


def split(mixture: Mixture, centre: Vector, widest_m: float, forward: Vector) -> None:
    """Cut components in three, keeping their moments, until none is wider than ``widest_m`` across a range.

    Wide is the sigma of the position at right angles to the direction from ``centre`` ``(3,)``; the rest of the
    state moves with it as their correlation says. ``forward`` ``(3,)`` decides among equally wide axes.
    """
    while True:
        away = mixture.means[:, :3] - centre
        unit = away / np.maximum(np.linalg.norm(away, axis=-1), 1e-6)[:, None]
        places = mixture.covariances[:, :3, :3]
        all_m2 = np.einsum("kii->k", places) - np.einsum("ki,kij,kj->k", unit, places, unit)
        may = np.flatnonzero(all_m2 > widest_m**2)  # no axis has more than all together
        if not len(may):
            return
        across = np.eye(3) - unit[may, :, None] * unit[may, None, :]
        seen = across @ places[may] @ across
        lean = across @ forward / max(float(np.linalg.norm(forward)), 1e-6)
        preferred = LEANING * all_m2[may, None, None] * lean[:, :, None] * lean[:, None, :]
        axis = np.linalg.eigh(seen + preferred)[1][:, :, 2]
        wide = np.flatnonzero(np.einsum("ki,kij,kj->k", axis, seen, axis) > widest_m**2)
        likeliest = np.argsort(-mixture.log_weights[may[wide]], kind="stable")
        wide = wide[likeliest][: (MOST - len(unit)) // 2]
        if not len(wide):
            return
        cut(mixture, may[wide], axis[wide])


def cut(mixture: Mixture, which: IntArray, axis: Matrix) -> None:
    """Cut the components ``which`` along the directions ``axis`` ``(len(which), 3)`` of their positions."""
    chosen = mixture.covariances[which]
    shift = np.einsum("kij,kj->ki", chosen[:, :, :3], axis)
    shift /= np.sqrt(np.einsum("ki,ki->k", shift[:, :3], axis))[:, None]
    inner = chosen - SPLIT_SHIFT**2 / 3.0 * shift[:, :, None] * shift[:, None, :]
    sides = (1 / 6, -1.0), (2 / 3, 0.0), (1 / 6, 1.0)
    parts = [(np.log(share), side * SPLIT_SHIFT * shift) for share, side in sides]
    rest = np.setdiff1d(np.arange(len(mixture.log_weights)), which)
    weights, means = mixture.log_weights[which], mixture.means[which]
    mixture.log_weights = np.concatenate([mixture.log_weights[rest], *(weights + share for share, _ in parts)])
    mixture.means = np.concatenate([mixture.means[rest], *(means + moved for _, moved in parts)])
    mixture.covariances = np.concatenate([mixture.covariances[rest], inner, inner, inner])


def is_sound(mixture: Mixture) -> bool:
    """Whether all is finite and every variance positive."""
    diagonal = np.einsum("kii->ki", mixture.covariances)
    return bool(
        len(mixture.log_weights)
        and np.isfinite(mixture.log_weights).all()
        and np.isfinite(mixture.means).all()
        and np.isfinite(mixture.covariances).all()
        and (diagonal > 0.0).all()
    )
