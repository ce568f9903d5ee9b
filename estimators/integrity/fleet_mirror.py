"""The mirror image of a whole fleet: which of the two do the fixes fit?

Ranges between drones are the same in a fleet and in its mirror image. What tells them apart are fixes and motion. Of
the two, a linearised estimate only knows the one that it is at: when a fleet flies through a plane (drones near one
height are in one), it may come out as its own mirror image, and its covariance knows nothing of the other. Here the
logarithm of the odds of the estimate x against its mirror image x' in the fleet's own plane is followed. They are
never higher than what the estimate, of covariance P, left of the two at the closest passage, by a Gaussian

    log N(x; x, P) - log N(x'; x, P) = 1/2 (x' - x)' P^-1 (x' - x),

and every fix adds the difference of its log likelihoods at x and at x'. Measured velocities are left out: on the
wrong side a fleet is turned to fit its fixes, and so is its image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry
from estimators.integrity.ambiguity import DECISIVE_NATS, FLOOR_M, UNDERSTATED
from estimators.model.gaussian import symmetrised
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.row_kernels import ANCHOR_RANGE, POSITION, PRECISION, VALUE, IntArray, encode_rows, predict_row

FEWEST_AGENTS = 4
"""Fewer are in one plane, and are their own mirror image."""
CERTAIN_NATS = 24.0
"""Evidence for the estimate that settles the matter until the fleet comes near a plane again."""
CREDIT = 0.25
"""Share of an estimate's information that is believed where a fleet is nearly plane: ranges in a plane tell of what
is across it in the second order only, and a linearisation takes that for more."""
SURE_NATS = 9.0
"""Evidence from which on the mirror image, with a probability of 1e-4, is left out of the covariance."""
TURN_RAD = 0.3
"""1-sigma about each axis by which a fleet that was taken for its mirror image is turned, to fit the fixes better."""


class Image(NamedTuple):
    """How wrong an estimate may be if the fleet is its mirror image."""

    probability: float
    offset: Vector
    """Image less estimate ``(6n,)``."""

    def covered(self, covariance: Matrix) -> Matrix:
        """The mean square error ``(6n, 6n)`` of the estimate, over both."""
        return covariance + self.probability * np.outer(self.offset, self.offset)

    def expected_square(self) -> Vector:
        """What it adds to the expected square error of each agent's position ``(n,)``, m2."""
        return np.asarray(self.probability * (self.offset.reshape(-1, 2, 3)[:, 0] ** 2).sum(-1), np.float64)


class FleetMirror:
    """Follows the odds of an estimate against its mirror image."""

    def __init__(self, lead_nats: float = CERTAIN_NATS) -> None:
        self.lead_nats = lead_nats
        """Log odds; negative: the mirror image is the likelier."""

    def weigh(self, rows: RowTable, state: Vector, eps: float) -> None:
        """Use rows ``(m,)`` of one tick, at the estimate ``(6n,)`` of that tick; each row once.

        What was certain stays so until the fleet comes near a plane: it cannot have changed sides. The errors of
        fixes last, and a minute of them must not add up to another opinion.
        """
        if len(state) >= FEWEST_AGENTS * STATES_PER_AGENT and len(rows) and self.lead_nats < CERTAIN_NATS:
            gained = likelihood_ratio(rows, state, state + mirror_offset(state), eps)
            self.lead_nats = min(self.lead_nats + gained, CERTAIN_NATS)

    def pass_by(self, state: Vector, information: Matrix) -> None:
        """Know no more than an estimate ``(6n,)`` with its information ``(6n, 6n)`` tells of the two."""
        if len(state) >= FEWEST_AGENTS * STATES_PER_AGENT:
            offset = mirror_offset(state)
            self.lead_nats = min(self.lead_nats, 0.5 * CREDIT * float(offset @ information @ offset))

    @property
    def reversed(self) -> bool:
        """Whether the fleet has turned out to be the mirror image."""
        return self.lead_nats < -DECISIVE_NATS

    def image(
        self, state: Vector, rows: RowTable, start: IntArray, path: Sequence[Vector], eps: float
    ) -> Image | None:
        """The mirror image of an estimate ``(6n,)``, unless it can be neglected.

        ``path`` are the states ``(6n,)`` at the ticks that were not weighed yet, the rows of tick k from ``start[k]``
        on.
        """
        if len(state) < FEWEST_AGENTS * STATES_PER_AGENT or self.lead_nats >= SURE_NATS:
            return None
        lead_nats = self.lead_nats
        for k, there in enumerate(path):
            lead_nats += likelihood_ratio(rows[start[k] : start[k + 1]], there, there + mirror_offset(there), eps)
        if lead_nats >= SURE_NATS:
            return None
        return Image(float(1.0 / (1.0 + np.exp(max(lead_nats, -CERTAIN_NATS)))), mirror_offset(state))


def doubtful(image: Image, covariance: Matrix) -> NDArray[np.bool_]:
    """Of which agents ``(n,)`` the place is not to be trusted to the estimate's own covariance ``(6n, 6n)``."""
    claimed = covariance.diagonal().reshape(-1, STATES_PER_AGENT)[:, :3].sum(-1)
    expected = claimed + image.expected_square()
    return np.asarray(expected > np.maximum(FLOOR_M**2, UNDERSTATED * claimed))


def mirror_offset(state: Vector) -> Vector:
    """From a fleet's state ``(6n,)`` to that of its image in the plane that its positions are closest to.

    The centre of the fleet stays where it is and goes on as it did.
    """
    vectors = state.reshape(-1, 2, 3)
    about = vectors - vectors.mean(axis=0)
    normal = plane_normal(about[:, 0])
    return np.asarray((-2.0 * (about @ normal)[..., None] * normal).ravel(), np.float64)


def plane_normal(about: Matrix) -> Vector:
    """Unit vector ``(3,)`` along which positions about their mean ``(n, 3)`` are spread least."""
    return np.asarray(np.linalg.eigh(about.T @ about)[1][:, 0], np.float64)


def mirrored(mean: Vector, covariance: Matrix) -> tuple[Vector, Matrix]:
    """Mean ``(6n,)`` and covariance ``(6n, 6n)`` of a fleet that turned out to be the mirror image of an estimate.

    On the wrong side the fleet was turned to fit its fixes as well as it could: the image may be, by `TURN_RAD`.
    """
    there = mean + mirror_offset(mean)
    reflection = _reflection(mean)
    covariance = reflection @ covariance @ reflection
    about = there.reshape(-1, 2, 3) - there.reshape(-1, 2, 3).mean(axis=0)
    for axis in np.eye(3):
        turn = TURN_RAD * np.cross(axis, about).ravel()
        covariance += np.outer(turn, turn)
    return there, symmetrised(covariance)


def _reflection(state: Vector) -> Matrix:
    """The linear map ``(6n, 6n)`` that mirrors deviations from the fleet's centre; its own inverse and transpose."""
    positions = state.reshape(-1, 2, 3)[:, 0]
    n = len(positions)
    normal = plane_normal(positions - positions.mean(axis=0))
    centring = np.eye(n) - 1.0 / n
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
