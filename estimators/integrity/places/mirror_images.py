"""Both sides of a plane: what ranges to bodies in one plane leave open of a drone that is near it.

Ranges to bodies in a plane are the same at a place and at its mirror image in the plane. A hypothesis
(`estimators.integrity.places.hypotheses`) that lies astride of the plane is no Gaussian any more once ranges say how
far from the plane the drone is, and one that has come down on a side may have come down on the wrong one: corrected
by linearised ranges it is surer of its side than the ranges are. So the first is cut along the normal, and of the
second the image is held as well. The log odds of the two are never higher than what the Gaussian left of them, of
covariance P with an image at an offset d,

    CREDIT / 2 d' P^-1 d,

and what is measured from then on decides between them.
"""

from __future__ import annotations

import numpy as np

from estimators.integrity.places.hypotheses import MERGED_SQUARE, MOST, PRUNED_NATS, Mixture, cut
from estimators.integrity.thresholds import CREDIT, DIRECTIONS, HELD_SPREAD, WEAK_M
from estimators.model.measurements import Matrix, Vector

ASTRIDE = 1.0
"""Height over the plane, in sigmas of a hypothesis, below which it lies on both sides."""
FEW = 24
"""More hypotheses than this are those of a drone whose place is not known at all: both sides are among them."""
LOOK_AHEAD_S = 0.1
"""Over which the plane is moved, to mirror a velocity."""


def hold_both_sides(mixture: Mixture, places: Matrix, velocities: Matrix) -> None:
    """Add to a mixture what ranges to bodies at ``places`` ``(m, 3)`` with ``velocities`` ``(m, 3)`` leave open.

    Nothing where the bodies are too few to give a plane, or not in one.
    """
    if len(places) < DIRECTIONS or len(mixture.log_weights) > FEW:
        return
    if not flat(places):
        return
    normal = _normal(places)
    height = (mixture.means[:, :3] - places.mean(axis=0)) @ normal
    sigma_m = np.sqrt(np.einsum("i,kij,j->k", normal, mixture.covariances[:, :3, :3], normal))
    astride = np.flatnonzero((np.abs(height) < ASTRIDE * sigma_m) & (sigma_m > WEAK_M))
    if len(astride):
        cut(mixture, astride, np.tile(normal, (len(astride), 1)))
    _add_images(mixture, places, velocities, normal)


def _add_images(mixture: Mixture, places: Matrix, velocities: Matrix, normal: Vector) -> None:
    """Hold the image of every component at least as likely as the component's own covariance left it."""
    images = mirrored_states(mixture.means, places, velocities)
    turn = _turn(normal, mixture.means.shape[1])
    spreads = turn @ mixture.covariances @ turn
    away = images - mixture.means
    lead_nats = 0.5 * CREDIT * np.einsum("ki,ki->k", away, _solved(mixture.covariances, away))
    wanted = mixture.log_weights - lead_nats
    for k in np.flatnonzero(wanted > mixture.log_weights.max() - PRUNED_NATS):
        off = mixture.means - images[k]
        square = np.einsum("ki,ki->k", off, _solved(mixture.covariances + spreads[k], off))
        same = square < MERGED_SQUARE
        if same.any():
            held = np.logaddexp.reduce(mixture.log_weights[same])
            mixture.log_weights[same] += max(wanted[k] - held, 0.0)
        elif len(mixture.log_weights) < MOST:
            mixture.add(float(wanted[k]), images[k], spreads[k])


def image_of(mean: Vector, covariance: Matrix, places: Matrix, velocities: Matrix) -> tuple[Vector, Matrix]:
    """The image of one hypothesis, with as many states; arguments as in `hold_both_sides`."""
    turn = _turn(_normal(places), len(mean))
    return mirrored_states(mean[None], places, velocities)[0], turn @ covariance @ turn


def mirror(places: Matrix) -> Matrix:
    """What turns a state ``(6,)`` relative to the centre of bodies at ``places`` ``(m, 3)`` into its image."""
    return _turn(_normal(places))


def _turn(normal: Vector, states: int = 6) -> Matrix:
    return np.asarray(np.kron(np.eye(states // 3), np.eye(3) - 2.0 * np.outer(normal, normal)), np.float64)


def mirrored_states(states: Matrix, places: Matrix, velocities: Matrix) -> Matrix:
    """The images of states ``(k, 6)``, or 9, in the plane that bodies are nearest to, and move on with."""
    now = _mirrored(states[:, :3], places)
    later = _mirrored(states[:, :3] + LOOK_AHEAD_S * states[:, 3:6], places + LOOK_AHEAD_S * velocities)
    turn = _turn(_normal(places), states.shape[1])[6:, 6:]
    return np.concatenate([now, (later - now) / LOOK_AHEAD_S, states[:, 6:] @ turn], axis=-1)


def _mirrored(points: Matrix, places: Matrix) -> Matrix:
    normal = _normal(places)
    return np.asarray(points - 2.0 * ((points - places.mean(axis=0)) @ normal)[:, None] * normal, np.float64)


def flat(places: Matrix) -> bool:
    """Whether places ``(m, 3)`` are in one plane, as far as ranges to them can tell."""
    about = places - places.mean(axis=0)
    values = np.linalg.eigvalsh(about.T @ about)
    return bool(values[0] <= HELD_SPREAD * values.sum())


def _normal(places: Matrix) -> Vector:
    about = places - places.mean(axis=0)
    return np.asarray(np.linalg.eigh(about.T @ about)[1][:, 0], np.float64)


def _solved(covariances: Matrix, vectors: Matrix) -> Matrix:
    """P^-1 v ``(k, D)`` of covariances ``(k, D, D)``."""
    return np.asarray(np.linalg.solve(covariances, vectors[:, :, None])[:, :, 0], np.float64)
