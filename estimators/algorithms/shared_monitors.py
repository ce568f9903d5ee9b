"""What watches over the shared estimator: which places the data tell, and whether they allow another one.

Three monitors look at every solved window: what the data alone say (`estimators.integrity.data_observability`), the
mirror image of the whole fleet (`estimators.integrity.fleet_mirror`), and, for a drone without fixes, a witness of
its own state (`estimators.integrity.ambiguity`). What they find widens the covariance, takes agents out of the
observable ones, or moves the belief to the only place that the data allow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.ambiguity import Body, Opinion, Witness, body_of, own_rows
from estimators.integrity.data_observability import DataInformation
from estimators.integrity.fleet_mirror import FleetMirror, doubtful, mirror_offset, mirrored
from estimators.model.gaussian import covering
from estimators.model.layout import Layout, block
from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.members import InformationState, MemberChange
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.row_kernels import POSITION, any_of
from estimators.window.types import WindowProblem

RESEATED_SPREAD = 2.0
"""Factor on the covariance of a place taken over from the witness: the window's rows are in it already."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What an estimator made of a window."""

    path: Matrix
    """``(N+1, 6n)`` its states."""
    covariance: Matrix
    """``(6n, 6n)`` of the newest one."""
    arrival: InformationState
    """The arrival cost of the next window."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the monitors leave of a belief."""

    belief: Belief
    observable: NDArray[np.bool_]
    """``(n,)`` whose place the data tell."""
    moves: int
    """How often the belief was moved to where the data hold."""


class SharedMonitors:
    """The monitors of one agent; ``own`` is its state at the first tick."""

    def __init__(self, layout: Layout, slot: int, own: Body, period_s: float, norm_smoothing: float) -> None:
        self._slot = slot
        self._period_s = period_s
        self._norm_smoothing = norm_smoothing
        self._own = own
        """The own state at the last tick."""
        self._data = DataInformation(layout.size)
        self._mirror = FleetMirror()
        self._witness = Witness(slot, own, period_s)

    def look(self, problem: WindowProblem, measured: RowTable, belief: Belief, *, slide: bool) -> Verdict:
        """Weigh a solved window; ``measured`` are its rows with the sensors' own variances.

        ``slide``: whether the arrival cost is that of a window that starts one tick later.
        """
        eps = self._norm_smoothing
        observable = self._data.advance(problem, belief.path, eps, slide=slide)
        turned = self._past_mirror(problem, belief, slide=slide)
        moves = 0 if turned is belief else 1
        mean, covariance, arrival = turned.path[-1], turned.covariance, turned.arrival
        opinion = self._second_opinion(problem, measured, mean, covariance, observable)
        if opinion is not None and opinion.ambiguous:
            observable = observable.copy()
            observable[self._slot] = False
        if opinion is not None and opinion.understated:
            covariance = covering(covariance, opinion.second_moment, self._slot)
        if opinion is not None and opinion.elsewhere is not None:
            arrival = self._moved(arrival, opinion.elsewhere, problem, slide=slide)
            moves += 1
        weighed = 1 if slide else 0
        image = self._mirror.image(mean, problem.rows, problem.start[weighed:], list(turned.path[weighed:]), eps)
        if image is not None:
            observable = observable & ~doubtful(image, covariance)
            covariance = image.covered(covariance)
        return Verdict(Belief(turned.path, covariance, arrival), observable, moves)

    def _past_mirror(self, problem: WindowProblem, belief: Belief, *, slide: bool) -> Belief:
        """Weigh the oldest tick, whose rows are all there by now, as it leaves; become the image if that is it."""
        if slide:
            self._mirror.weigh(problem.rows[: problem.start[1]], belief.path[0], self._norm_smoothing)
        self._mirror.pass_by(belief.arrival.mean, belief.arrival.information)
        if not self._mirror.reversed:
            return belief
        self._mirror = FleetMirror(-self._mirror.lead_nats)
        _, covariance = mirrored(belief.path[-1], belief.covariance)
        arrival = InformationState.from_moments(*mirrored(belief.arrival.mean, belief.arrival.covariance()))
        path = np.array([state + mirror_offset(state) for state in belief.path])
        return Belief(path, covariance, arrival)

    def _second_opinion(
        self,
        problem: WindowProblem,
        measured: RowTable,
        mean: Vector,
        covariance: Matrix,
        observable: NDArray[np.bool_],
    ) -> Opinion | None:
        """Let the witness see the newest tick, and ask it about the estimate."""
        slot = self._slot
        before, self._own = self._own, body_of(mean, covariance, slot)
        if any_of(problem.rows, POSITION, slot):
            self._witness.rest()
            return None
        mine = slice(3 * slot, 3 * slot + 3)
        newest = own_rows(measured[problem.start[-2] :], slot)
        self._witness.advance(newest, problem.accel[-1, mine], problem.accel_variance[-1, mine], False, before)
        located = np.flatnonzero(observable)
        self._witness.see(newest, {int(s): body_of(mean, covariance, int(s)) for s in located if s != slot})
        return self._witness.judge(self._own)

    def _moved(
        self, arrival: InformationState, there: Body, problem: WindowProblem, *, slide: bool
    ) -> InformationState:
        """The arrival cost with its own block where the witness is sure to be, carried back through the window."""
        mine, own = slice(3 * self._slot, 3 * self._slot + 3), block(self._slot)
        back, push = transition_matrix(1, -self._period_s), input_matrix(1, self._period_s)
        place, spread = there[0], RESEATED_SPREAD * there[1]
        for k in range(len(problem.accel) - 1, 0 if slide else -1, -1):
            place = back @ (place - push @ problem.accel[k, mine])
            spread = back @ (spread + (push * problem.accel_variance[k, mine]) @ push.T) @ back.T
        mean = arrival.mean.copy()
        mean[own] = place
        return InformationState.from_moments(mean, covering(arrival.covariance(), spread, self._slot))

    def change_members(self, change: MemberChange, restart: Body | None) -> None:
        """Go on with another fleet; ``restart``: the own state at the last tick, where it begins anew."""
        self._slot = change.own
        self._data.change_members(change)
        self._witness.change_members(change)
        if restart is not None:
            self._own = restart
            self._witness = Witness(change.own, restart, self._period_s)
