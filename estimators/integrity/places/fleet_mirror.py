"""The mirror image of a whole fleet: which of the two do the fixes fit?

Ranges between drones are the same in a fleet and in its mirror image. What tells them apart are fixes and motion. Of
the two, a linearised estimate only knows the one that it is at: when a fleet flies through a plane (drones near one
height are in one), it may come out as its own mirror image, and its covariance knows nothing of the other. Here the
logarithm of the odds of the estimate x against its mirror image x' in the fleet's own plane is followed. They are
never higher than what the estimate, of covariance P, left of the two at the closest passage, by a Gaussian

    log N(x; x, P) - log N(x'; x, P) = 1/2 (x' - x)' P^-1 (x' - x),

and every fix adds the difference of its log likelihoods at x and at x'. Measured velocities are left out: on the
wrong side a fleet is turned to fit its fixes, and so is its image.

The fleet are its vehicles. Targets have the image that ranges from the vehicles give them, and have no say in where
the plane is or how well it is known: one that is left behind, of which little is known, says nothing of the fleet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import (
    CERTAIN_NATS,
    CREDIT,
    DECISIVE_NATS,
    FEWEST_MIRRORED,
    FLOOR_M,
    SURE_NATS,
    UNDERSTATED,
)
from estimators.integrity.window_evidence import WindowEvidence
from estimators.model.gaussian import marginal_pair, symmetrised
from estimators.model.layout import STATES_PER_AGENT, states_of
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.row_kernels import ANCHOR_RANGE, POSITION, PRECISION, VALUE, IntArray, encode_rows, predict_row

Mask = NDArray[np.bool_]

TURN_RAD = 0.3
"""1-sigma about each axis by which a fleet that was taken for its mirror image is turned, to fit the fixes better."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MirrorImage(Finding):
    """The fleet may be its own mirror image; ``value`` is the probability of that."""

    offset: Vector
    """Image less estimate ``(6n,)``."""

    @property
    def probability(self) -> float:
        """Of the image, 0..1."""
        assert self.value is not None
        return self.value

    def covered(self, covariance: Matrix) -> Matrix:
        """The mean square error ``(6n, 6n)`` of the estimate, over both."""
        return covariance + self.probability * np.outer(self.offset, self.offset)

    def doubtful(self, covariance: Matrix) -> NDArray[np.bool_]:
        """Of which agents ``(n,)`` the place is not to be trusted to the estimate's own covariance ``(6n, 6n)``."""
        claimed = covariance.diagonal().reshape(-1, STATES_PER_AGENT)[:, :3].sum(-1)
        expected = claimed + self.probability * (self.offset.reshape(-1, 2, 3)[:, 0] ** 2).sum(-1)
        return np.asarray(expected > np.maximum(FLOOR_M**2, UNDERSTATED * claimed))


class FleetMirrorMonitor:
    """Follows the odds of an estimate against its mirror image; begins certain of the estimate."""

    def __init__(self) -> None:
        self._lead_nats = CERTAIN_NATS
        """Log odds; negative: the mirror image is the likelier."""

    def observe(self, evidence: WindowEvidence) -> tuple[Finding, ...]:
        """A `MirrorImage` while there is doubt; `What.REVERSED` where the fleet has turned out to be the image.

        The oldest tick, whose rows are all there by now, is weighed as it leaves the window. After a reversal the
        estimate is expected to be the image (`mirrored`), with the odds for it that were against it.
        """
        path, rows, start, eps = evidence.path, evidence.rows, evidence.start, evidence.norm_smoothing
        fleet = evidence.vehicles
        if np.count_nonzero(fleet) < FEWEST_MIRRORED:
            return ()
        if evidence.slide:
            self._weigh(rows[: start[1]], path[0], fleet, eps)
        self._pass_by(evidence.arrival_mean, evidence.arrival_information, fleet)
        if self._lead_nats < -DECISIVE_NATS:
            self._lead_nats = -self._lead_nats
            return (Finding(What.REVERSED, Gravity.NOTED, value=self._lead_nats, limit=DECISIVE_NATS),)
        weighed = 1 if evidence.slide else 0
        return self._doubt(rows, start[weighed:], path[weighed:], fleet, eps)

    def _weigh(self, rows: RowTable, state: Vector, fleet: Mask, eps: float) -> None:
        """Use rows ``(m,)`` of one tick, at the estimate ``(6n,)`` of that tick; each row once.

        What was certain stays so until the fleet comes near a plane: it cannot have changed sides. The errors of
        fixes last, and a minute of them must not add up to another opinion.
        """
        if len(rows) and self._lead_nats < CERTAIN_NATS:
            gained = likelihood_ratio(rows, state, state + mirror_offset(state, fleet), eps)
            self._lead_nats = min(self._lead_nats + gained, CERTAIN_NATS)

    def _pass_by(self, state: Vector, information: Matrix, fleet: Mask) -> None:
        """Know no more than an estimate ``(6n,)`` with its information ``(6n, 6n)`` tells of the two."""
        offset, slots = mirror_offset(state, fleet), np.flatnonzero(fleet).tolist()
        if len(slots) < len(fleet):
            information, offset = marginal_pair((information, offset), slots)[0], offset[states_of(slots)]
        self._lead_nats = min(self._lead_nats, 0.5 * CREDIT * float(offset @ information @ offset))

    def _doubt(
        self, rows: RowTable, start: IntArray, path: Matrix, fleet: Mask, eps: float
    ) -> tuple[MirrorImage, ...]:
        """The mirror image of the newest state, unless it can be neglected; ``path`` are those not weighed yet."""
        lead_nats = self._lead_nats
        if lead_nats >= SURE_NATS:
            return ()
        for k, there in enumerate(path):
            image = there + mirror_offset(there, fleet)
            lead_nats += likelihood_ratio(rows[start[k] : start[k + 1]], there, image, eps)
        if lead_nats >= SURE_NATS:
            return ()
        probability = float(1.0 / (1.0 + np.exp(max(lead_nats, -CERTAIN_NATS))))
        offset = mirror_offset(path[-1], fleet)
        return (MirrorImage(What.MIRRORED, Gravity.ALARM, value=probability, offset=offset),)


def mirror_offset(state: Vector, fleet: Mask) -> Vector:
    """From a state ``(6n,)`` to its image in the plane that the positions of the ``fleet`` ``(n,)`` are closest to.

    The centre of the fleet stays where it is and goes on as it did.
    """
    vectors = state.reshape(-1, 2, 3)
    about = vectors - vectors[fleet].mean(axis=0)
    normal = plane_normal(about[fleet, 0])
    return np.asarray((-2.0 * (about @ normal)[..., None] * normal).ravel(), np.float64)


def plane_normal(about: Matrix) -> Vector:
    """Unit vector ``(3,)`` along which positions about their mean ``(n, 3)`` are spread least."""
    return np.asarray(np.linalg.eigh(about.T @ about)[1][:, 0], np.float64)


def mirrored(mean: Vector, covariance: Matrix, fleet: Mask) -> tuple[Vector, Matrix]:
    """Mean ``(6n,)`` and covariance ``(6n, 6n)`` where the ``fleet`` ``(n,)`` is the mirror image of an estimate.

    On the wrong side the fleet was turned to fit its fixes as well as it could: the image may be, by `TURN_RAD`.
    """
    there = mean + mirror_offset(mean, fleet)
    reflection = _reflection(mean, fleet)
    covariance = reflection @ covariance @ reflection.T
    vectors = there.reshape(-1, 2, 3)
    about = vectors - vectors[fleet].mean(axis=0)
    for axis in np.eye(3):
        turn = TURN_RAD * np.cross(axis, about).ravel()
        covariance += np.outer(turn, turn)
    return there, symmetrised(covariance)


def _reflection(state: Vector, fleet: Mask) -> Matrix:
    """The linear map ``(6n, 6n)`` that mirrors deviations from the fleet's centre; its own inverse."""
    positions = state.reshape(-1, 2, 3)[:, 0]
    n = len(positions)
    normal = plane_normal(positions[fleet] - positions[fleet].mean(axis=0))
    centring = np.eye(n) - fleet / np.count_nonzero(fleet)
    across = np.kron(np.eye(2), np.outer(normal, normal))
    return np.asarray(np.eye(STATES_PER_AGENT * n) - 2.0 * np.kron(centring, across), np.float64)


@entry("float64(ROW[::1], float64[::1], float64[::1], float64)", ROW=ROW)
def likelihood_ratio(rows: RowTable, state: Vector, other: Vector, eps: float) -> float:
    """Log likelihood of positions at one fleet state ``(6n,)`` less that at another."""
    local = np.arange(state.shape[0] // STATES_PER_AGENT)
    code, data, unit = np.empty((rows.shape[0], 3), np.int64), np.empty((rows.shape[0], 7)), np.empty(4)
    encode_rows(rows, local, code, data)
    ratio = 0.0
    for r in range(rows.shape[0]):
        if rows[r]["kind"] != POSITION and rows[r]["kind"] != ANCHOR_RANGE:
            continue
        here = data[r, VALUE] - predict_row(code, data, r, state, eps, unit)
        there = data[r, VALUE] - predict_row(code, data, r, other, eps, unit)
        ratio += 0.5 * data[r, PRECISION] * (there * there - here * here)
    return ratio
