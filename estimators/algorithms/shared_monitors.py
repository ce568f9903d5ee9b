"""What watches over the shared estimator: which places the data tell, and whether they allow another one.

Three monitors look at every solved window: what the data alone say (`estimators.integrity.data_observability`), the
mirror image of the whole fleet (`estimators.integrity.fleet_mirror`), and, for a drone without fixes, other places of
its own (`estimators.integrity.ambiguity`). Here is what follows from what they find: a wider covariance, agents that
are not observable, or a belief moved to the only place that the data allow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.ambiguity import (
    AmbiguityMonitor,
    Body,
    Elsewhere,
    OwnEvidence,
    Understated,
    body_of,
    own_rows,
)
from estimators.integrity.data_observability import ObservabilityMonitor
from estimators.integrity.finding import What, has
from estimators.integrity.fleet_mirror import FleetMirrorMonitor, MirrorImage, mirror_offset, mirrored
from estimators.integrity.window_evidence import WindowEvidence
from estimators.model.gaussian import covering
from estimators.model.layout import STATES_PER_AGENT, Layout, block
from estimators.model.limits import StateLimits
from estimators.model.measurements import Matrix, RowTable, empty_rows
from estimators.model.members import InformationState, MemberChange
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.row_kernels import POSITION, any_of
from estimators.window.problem import WindowProblem

RESEATED_SPREAD = 2.0
"""Factor on the covariance of a place that the own data hold to: the window's rows are in it already."""


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

    def __init__(
        self,
        layout: Layout,
        slot: int,
        own: Body,
        period_s: float,
        norm_smoothing: float,
        limits: StateLimits | None = None,
    ) -> None:
        self._slot = slot
        self._period_s = period_s
        self._norm_smoothing = norm_smoothing
        self._observability = ObservabilityMonitor(layout.size)
        self._mirror = FleetMirrorMonitor()
        self._ambiguity = AmbiguityMonitor(slot, own, period_s, limits)

    def look(self, problem: WindowProblem, measured: RowTable, belief: Belief, *, slide: bool) -> Verdict:
        """Weigh a solved window; ``measured`` are its rows with the sensors' own variances.

        ``slide``: whether the arrival cost is that of a window that starts one tick later.
        """
        window = self._window(problem, belief, slide=slide)
        observable = np.ones(belief.path.shape[1] // STATES_PER_AGENT, np.bool_)
        for finding in self._observability.observe(window):
            observable[finding.about] = False
        mirror, moves = self._mirror.observe(window), 0
        if has(mirror, What.REVERSED):
            belief, moves = _reversed(belief), 1
        covariance, arrival = belief.covariance, belief.arrival
        for finding in self._ambiguity.observe(self._own(problem, measured, belief, observable)):
            match finding:
                case Understated():
                    covariance = covering(covariance, finding.second_moment, self._slot)
                case Elsewhere():
                    arrival, moves = self._moved(arrival, finding.place, problem, slide=slide), moves + 1
                case _:
                    observable[self._slot] = False
        for finding in mirror:
            if isinstance(finding, MirrorImage):
                observable &= ~finding.doubtful(covariance)
                covariance = finding.covered(covariance)
        return Verdict(Belief(belief.path, covariance, arrival), observable, moves)

    def _window(self, problem: WindowProblem, belief: Belief, *, slide: bool) -> WindowEvidence:
        """What the monitors of the whole fleet look at."""
        return WindowEvidence(
            problem.rows,
            problem.start,
            problem.accel_variance,
            belief.path,
            belief.arrival.mean,
            belief.arrival.information,
            slide,
            problem.period_s,
            self._norm_smoothing,
        )

    def _own(
        self, problem: WindowProblem, measured: RowTable, belief: Belief, observable: NDArray[np.bool_]
    ) -> OwnEvidence:
        """What speaks of the own state at the newest tick; the others are where the estimate has them."""
        slot, mean, covariance = self._slot, belief.path[-1], belief.covariance
        fixed = any_of(problem.rows, POSITION, slot)
        mine = slice(3 * slot, 3 * slot + 3)
        located = [] if fixed else [int(s) for s in np.flatnonzero(observable) if s != slot]
        return OwnEvidence(
            fixed,
            body_of(mean, covariance, slot),
            empty_rows() if fixed else own_rows(measured[problem.start[-2] :], slot),
            problem.accel[-1, mine],
            problem.accel_variance[-1, mine],
            {other: body_of(mean, covariance, other) for other in located},
        )

    def _moved(
        self, arrival: InformationState, there: Body, problem: WindowProblem, *, slide: bool
    ) -> InformationState:
        """The arrival cost with its own block where its data hold to, carried back through the window."""
        mine, own = slice(3 * self._slot, 3 * self._slot + 3), block(self._slot)
        back, push = transition_matrix(1, -self._period_s), input_matrix(1, self._period_s)
        place, spread = there[0], RESEATED_SPREAD * there[1]
        for k in range(len(problem.accel) - 1, 0 if slide else -1, -1):
            place = back @ (place - push @ problem.accel[k, mine])
            spread = back @ (spread + (push * problem.accel_variance[k, mine]) @ push.T) @ back.T
        mean = arrival.mean.copy()
        mean[own] = place
        return InformationState.from_moments(mean, covering(arrival.covariance(), spread, self._slot))

    def change_members(
        self, change: MemberChange, restart: Body | None, limits: StateLimits | None = None
    ) -> None:
        """Go on with another fleet, its limits; ``restart``: the own state at the last tick, where it begins anew."""
        self._slot = change.own
        self._observability.change_members(change)
        self._ambiguity.change_members(change, limits)
        if restart is not None:
            self._ambiguity = AmbiguityMonitor(change.own, restart, self._period_s, limits)


def _reversed(belief: Belief) -> Belief:
    """The mirror image of a belief."""
    _, covariance = mirrored(belief.path[-1], belief.covariance)
    arrival = InformationState.from_moments(*mirrored(belief.arrival.mean, belief.arrival.covariance()))
    return Belief(np.array([state + mirror_offset(state) for state in belief.path]), covariance, arrival)
