"""The rival of an estimate: the same fleet with a drone without fixes at its mirror image.

Three located bodies, or more in one plane, leave two places to a drone that ranges alone hold. When it has been near
their plane, an estimate that comes out at one side is no more than a guess, and its covariance knows nothing of the
other side. So the belief with the drone mirrored is held beside it and solved in every tick from the same window in
the same way: neighbours, slow errors and all else may adapt to either. The log odds of the two begin with what the
estimate, of covariance P with the image at an offset d, left of the image at the closest passage,

    CREDIT / 2 d' P^-1 d,

and every tick that leaves the window adds the difference of the log likelihoods of its rows, foretold from the
beliefs about the window's start (Bar-Shalom, Li, Kirubarajan, Estimation with Applications, 2001, ch. 11). What is
still in the window counts by half the difference of the two optima. Where the rival is far likelier, the two change
places. The doubt ends when the odds are decisive for the estimate, or when both have become one place again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimators.integrity.observability import row_jacobian
from estimators.integrity.places.ambiguity import Body
from estimators.integrity.places.mirror_images import flat, image_of, mirror
from estimators.integrity.thresholds import CERTAIN_NATS, CREDIT, DIRECTIONS, SURE_NATS
from estimators.model.gaussian import reseated
from estimators.model.layout import STATES_PER_AGENT, block
from estimators.model.measurements import Kind, Matrix, RowTable
from estimators.model.row_kernels import POSITION, PRECISION, any_of
from estimators.systematic.belief import SlowBelief
from estimators.window.slow_window import SlowProblem, SlowSolution

APART_SQUARE = 9.0
"""Squared Mahalanobis distance of the two from which on they are two places: solved from nearer, they become one."""
MERGED_SQUARE = 1.0
"""The same, below which they are one again."""
MIRRORED_SPREAD = 2.0
"""Factor on the covariance of the image: the estimate has been bent towards its own side."""
MOST_NATS = 3.0
"""Log odds at most that an estimate begins with: rows linearised at one side, tick after tick, may have told of it
what they do not know, and then it is far surer than it should be."""
LEADING_NATS = 6.0
"""Log odds for the rival from which on the two change places: what the window says goes up and down by a few."""
SETTLING_TICKS = 10
"""A new rival is given so long to find its place, before the two are compared: it is less sure at first, and loses
for that what tells of neither."""
OUTLYING = 3.0
"""Residuals beyond so many sigmas count linearly: one outlier must not decide."""


@dataclass(frozen=True, slots=True)
class Rival:
    """Another belief about the window's start, and how much less likely it is."""

    slot: int
    """The drone that is elsewhere."""
    belief: SlowBelief
    last: SlowSolution | None
    lead_nats: float
    """Log odds of the estimate against it, before the rows of the window."""
    present_nats: float = 0.0
    """What the rows of the window add to them."""
    ticks: int = 0
    """How long it has been held."""

    @property
    def odds_nats(self) -> float:
        """Log odds of the estimate against it, by all that was measured."""
        return self.lead_nats + self.present_nats

    @property
    def leads(self) -> bool:
        """Whether it is to be the estimate."""
        return self.ticks > SETTLING_TICKS and self.odds_nats < -LEADING_NATS

    @property
    def probability(self) -> float:
        """Of the rival, 0..1."""
        return float(1.0 / (1.0 + np.exp(np.clip(self.odds_nats, -CERTAIN_NATS, CERTAIN_NATS))))

    def covered(self, path: Matrix, covariance: Matrix) -> Matrix:
        """The mean square error ``(6n, 6n)`` of an estimate whose last state is ``path[-1]``, over both."""
        if self.last is None:
            return covariance
        away = self.last.path[-1] - path[-1]
        theirs = self.last.covariance[: len(away), : len(away)]
        p = self.probability
        return np.asarray((1.0 - p) * covariance + p * (theirs + np.outer(away, away)), np.float64)

    def weighed(self, gained_nats: float, last: SlowSolution, cost: float) -> Rival:
        """A tick later; ``last`` is its solution, ``cost`` the estimate's."""
        lead = self.lead_nats + (gained_nats if self.ticks >= SETTLING_TICKS else 0.0)
        present = 0.5 * (last.cost - cost)
        return replace(
            self, belief=last.arrival, last=last, lead_nats=lead, present_nats=present, ticks=self.ticks + 1
        )

    def exchanged(self, estimate: SlowSolution) -> Rival:
        """The estimate as the rival of this one."""
        return replace(
            self,
            belief=estimate.arrival,
            last=estimate,
            lead_nats=-self.lead_nats,
            present_nats=-self.present_nats,
        )


class Passages:
    """How near each drone without fixes has come to the plane of the bodies that it is ranged to."""

    def __init__(self, agents: int) -> None:
        self._lead_nats = np.full(agents, CERTAIN_NATS)

    def change_members(self, stayed: Mapping[int, int], agents: int) -> None:
        """Go on with another fleet; ``stayed``: by new slot, the old one."""
        before, self._lead_nats = self._lead_nats, np.full(agents, CERTAIN_NATS)
        for slot, was in stayed.items():
            self._lead_nats[slot] = before[was]

    def settle(self, slot: int) -> None:
        """Take a drone's side as decided until it comes near a plane again."""
        self._lead_nats[slot] = CERTAIN_NATS

    def rival(self, rows: RowTable, arrival: SlowBelief, located: Sequence[int]) -> Rival | None:
        """The likeliest rival of a belief, if one is likely enough and apart; ``rows`` are those of its window."""
        found: Rival | None = None
        for slot in range(len(self._lead_nats)):
            if any_of(rows, POSITION, slot):
                self.settle(slot)
                continue
            bodies = [other for other in located if other != slot and _ranged(rows, slot, other)]
            if len(bodies) < DIRECTIONS:
                continue
            states = arrival.mean[: arrival.states].reshape(-1, STATES_PER_AGENT)[bodies]
            if not flat(states[:, :3]):
                self.settle(slot)
                continue
            square, square_m = _distances(arrival, slot, bodies)
            self._lead_nats[slot] = min(self._lead_nats[slot], 0.5 * CREDIT * square)
            lead = float(self._lead_nats[slot])
            if lead < SURE_NATS and square_m > APART_SQUARE and (found is None or lead < found.lead_nats):
                found = Rival(slot, _mirrored(arrival, slot, bodies), None, min(lead, MOST_NATS))
        return found


def merged(rival: Rival, solution: SlowSolution) -> bool:
    """Whether the two are one place again."""
    assert rival.last is not None
    at = block(rival.slot)
    away = (rival.last.path[-1] - solution.path[-1])[at]
    spread = solution.covariance[at, at] + rival.last.covariance[at, at]
    return float(away[:3] @ np.linalg.solve(spread[:3, :3], away[:3])) < MERGED_SQUARE


def log_likelihood(problem: SlowProblem, solution: SlowSolution, covariance: Matrix) -> float:
    """Of the rows of the window's first tick, foretold from the belief about it; linearised at the solution.

    ``covariance`` ``(D, D)`` is the belief's.
    """
    window = problem.window
    count, total = int(window.start[1]), len(window.prior_mean)
    if not count:
        return 0.0
    rows, states = problem.rows[:count], solution.path.shape[1]
    predicted, jacobian = row_jacobian(rows, solution.path[0], window.eps)
    slopes = np.zeros((count, total))
    slopes[:, :states] = jacobian
    for r, j in np.argwhere(window.slow_at[:count] >= 0):
        slopes[r, states + window.slow_at[r, j]] += window.slow_by[r, j]
    at = np.concatenate((solution.path[0], solution.slow))
    off = rows["value"] - predicted - slopes[:, states:] @ solution.slow + slopes @ (at - window.prior_mean)
    noise = 1.0 / window.data[:count, PRECISION] + solution.variances[:count] - solution.measured[:count]
    spread = slopes @ covariance @ slopes.T + np.diag(noise)
    factor = np.linalg.cholesky(spread)
    size = np.abs(np.linalg.solve(factor, off))
    cost = np.where(size < OUTLYING, size**2, OUTLYING * (2.0 * size - OUTLYING))
    return float(-0.5 * cost.sum() - np.log(factor.diagonal()).sum())


def _ranged(rows: RowTable, one: int, other: int) -> bool:
    between = rows[rows["kind"] == Kind.RANGE]
    pair = ((between["agent"] == one) & (between["other"] == other)) | (
        (between["agent"] == other) & (between["other"] == one)
    )
    return bool(pair.any())


def _distances(arrival: SlowBelief, slot: int, bodies: Sequence[int]) -> tuple[float, float]:
    """Squared Mahalanobis distances of a drone from its image: of the state and of the position.

    The covariance is that relative to the bodies' centre: what all share moves both.
    """
    states = arrival.mean[: arrival.states].reshape(-1, STATES_PER_AGENT)
    spread = _relative_spread(arrival, slot, bodies)
    image, _ = image_of(states[slot], spread, states[bodies][:, :3], states[bodies][:, 3:])
    away = image - states[slot]
    square = float(away @ np.linalg.solve(spread, away))
    return square, float(away[:3] @ np.linalg.solve(spread[:3, :3], away[:3]))


def _relative_spread(arrival: SlowBelief, slot: int, bodies: Sequence[int]) -> Matrix:
    """The covariance ``(6, 6)`` of a drone's state relative to the centre of bodies."""
    relative = np.zeros((STATES_PER_AGENT, len(arrival.mean)))
    relative[:, block(slot)] = np.eye(STATES_PER_AGENT)
    for other in bodies:
        relative[:, block(other)] = -np.eye(STATES_PER_AGENT) / len(bodies)
    return np.asarray(relative @ arrival.covariance @ relative.T, np.float64)


def placed(arrival: SlowBelief, slot: int, there: Body, bodies: Sequence[int]) -> SlowBelief:
    """The belief with a drone at a place, known relative to the centre of ``bodies``; of them it holds the same."""
    mean, onto = arrival.mean.copy(), np.zeros((STATES_PER_AGENT, len(arrival.mean)))
    mean[block(slot)] = there[0]
    for other in bodies:
        onto[:, block(other)] = np.eye(STATES_PER_AGENT) / len(bodies)
    return replace(arrival, mean=mean, covariance=reseated(arrival.covariance, slot, onto, there[1]))


def _mirrored(arrival: SlowBelief, slot: int, bodies: Sequence[int]) -> SlowBelief:
    """The belief with a drone at its image, less sure of it; of the others it holds the same.

    What the drone shares with them goes with it, as do the slow errors that its place hangs on: only what is across
    the plane is turned round.
    """
    states = arrival.mean[: arrival.states].reshape(-1, STATES_PER_AGENT)
    places, velocities = states[bodies][:, :3], states[bodies][:, 3:]
    image, spread = image_of(states[slot], _relative_spread(arrival, slot, bodies), places, velocities)
    turn = mirror(places)
    onto = np.zeros((STATES_PER_AGENT, len(arrival.mean)))
    onto[:, block(slot)] = turn
    for other in bodies:
        onto[:, block(other)] = (np.eye(STATES_PER_AGENT) - turn) / len(bodies)
    mean = arrival.mean.copy()
    mean[block(slot)] = image
    excess = (MIRRORED_SPREAD - 1.0) * spread
    return replace(arrival, mean=mean, covariance=reseated(arrival.covariance, slot, onto, excess))
