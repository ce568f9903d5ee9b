"""What watches over the shared estimator: which places the data tell, and whether they allow another one.

Monitors look at every solved window: what the data alone say (`estimators.integrity.data_observability`), the mirror
image of the whole fleet (`estimators.integrity.places.fleet_mirror`), and, of every drone without fixes, other places
(`estimators.integrity.places.ambiguity`): what an agent believes of a blind drone is to be as honest as its own word.
Here is what follows from what they find: a wider covariance, agents that are not observable, another place to be
weighed against the estimate's (`estimators.algorithms.rival`), or a fleet mirrored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimators.algorithms.rival import Rival
from estimators.integrity.data_observability import ObservabilityMonitor
from estimators.integrity.finding import What, has
from estimators.integrity.places.ambiguity import (
    AmbiguityMonitor,
    Body,
    DroneEvidence,
    Elsewhere,
    FoundAgain,
    Understated,
    body_of,
    rows_of,
)
from estimators.integrity.places.fleet_mirror import FleetMirrorMonitor, MirrorImage, mirror_offset, mirrored
from estimators.integrity.thresholds import FLOOR_M, HELD_SIGMA_M, UNDERSTATED
from estimators.integrity.window_evidence import WindowEvidence
from estimators.model.layout import STATES_PER_AGENT, BodyKind, Layout, block
from estimators.model.limits import StateLimits
from estimators.model.measurements import Matrix, RowTable, Vector, empty_rows
from estimators.model.members import InformationState, MemberChange
from estimators.model.motion import input_matrix, transition_matrix
from estimators.model.row_kernels import POSITION, any_of
from estimators.systematic.acceleration_errors import AccelerationErrors
from estimators.systematic.belief import SlowBelief
from estimators.systematic.slow_errors import acceleration_of
from estimators.window.problem import WindowProblem

RESEATED_SPREAD = 2.0
"""Factor on the covariance of a place that the data hold to: the window's rows are in it already."""
HEARSAY_TICKS = 2
"""What another drone measured is looked at so much later than the own: packets may be late."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What an estimator made of a window."""

    path: Matrix
    """``(N+1, 6n)`` its states."""
    covariance: Matrix
    """``(6n, 6n)`` of the newest one."""
    arrival: InformationState
    """The arrival cost of the next window."""
    errors: AccelerationErrors | None = None
    """Of the newest accelerations, where they are estimated."""

    def followed(self, slot: int, lag: int = 0) -> Body:
        """An agent's state some ticks ago, with the error of its acceleration where that is estimated."""
        mean = self.path[-1 - lag]
        if self.errors is None:
            return body_of(mean, self.covariance, slot)
        return self.errors.joined(mean, self.covariance, slot)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the monitors leave of a belief."""

    belief: Belief
    observable: NDArray[np.bool_]
    """``(n,)`` whose place the data tell."""
    held: NDArray[np.bool_]
    """``(n,)``: of these, who has fixes, or hangs on those who have."""
    moves: int
    """How often the belief was moved to where the data hold."""
    elsewhere: tuple[int, Body] | None = None
    """A drone whose data hold to another place, and its state there at the first tick of the next window."""
    found_again: Mapping[int, Matrix] = field(default_factory=dict)
    """By slot, of drones that have a fix again: what the covariance of their states at the first tick of the next
    window, with the error of the acceleration where that is estimated, should be at least."""


class SharedMonitors:
    """The monitors of one agent; ``mean`` and ``covariance`` are the fleet's state at the first tick."""

    def __init__(
        self,
        layout: Layout,
        slot: int,
        mean: Vector,
        covariance: Matrix,
        period_s: float,
        norm_smoothing: float,
        limits: StateLimits | None = None,
    ) -> None:
        self._slot = slot
        self._period_s = period_s
        self._norm_smoothing = norm_smoothing
        self._vehicles, self._stands = layout.is_vehicle, _stands(layout)
        self._observability = ObservabilityMonitor(layout.size)
        self._mirror = FleetMirrorMonitor()
        self._ambiguities = [
            AmbiguityMonitor(each, body_of(mean, covariance, each), period_s, limits) for each in range(layout.size)
        ]
        """By slot."""
        self._doubtful = np.zeros(layout.size, np.bool_)
        """``(n,)``: in the last tick, by these."""

    def look(
        self,
        problem: WindowProblem,
        measured: RowTable,
        belief: Belief,
        rivals: tuple[Rival | None, Rival | None],
        *,
        slide: bool,
    ) -> Verdict:
        """Weigh a solved window; ``measured`` are its rows with the sensors' own variances.

        ``rivals``: that of the tick before, and the one that is left of it. A drone that has one is left to it, where
        there are two places at most: it weighs them with all that the estimator holds.

        ``slide``: whether the arrival cost is that of a window that starts one tick later.
        """
        window = self._window(problem, belief, slide=slide)
        observable = np.ones(belief.path.shape[1] // STATES_PER_AGENT, np.bool_)
        for finding in self._observability.observe(window):
            observable[finding.about] = False
        mirror, moves = self._mirror.observe(window), 0
        if has(mirror, What.REVERSED):
            belief, moves = _reversed(belief, self._vehicles), 1
        covariance, elsewhere = belief.covariance, None
        found_again: dict[int, Matrix] = {}
        before, rival = rivals
        located = self._held(problem.rows, observable & ~self._doubtful, self._surveyed(belief.covariance))
        self._doubtful = np.zeros(len(observable), np.bool_)
        for slot, monitor in enumerate(self._ambiguities):
            lag = 0 if slot == self._slot else HEARSAY_TICKS
            if lag >= len(problem.accel):
                continue
            if before is not None and before.slot == slot and monitor.leaves_two_places(located):
                monitor.restart(belief.followed(slot, lag))
                continue
            for finding in monitor.observe(self._evidence(slot, lag, problem, measured, belief, located)):
                match finding:
                    case FoundAgain():
                        covariance = widened(covariance, finding.second_moment[:6, :6], slot)
                        found_again[slot] = finding.second_moment
                        self._doubtful[slot] = True
                    case Understated():
                        covariance = widened(covariance, finding.second_moment[:6, :6], slot)
                    case Elsewhere():
                        elsewhere = slot, self._carried_back(slot, lag, finding.place, problem, slide=slide)
                    case _:
                        self._doubtful[slot] = True
        observable &= ~self._doubtful
        if rival is not None:
            covered = rival.covered(belief.path, covariance)
            observable &= ~understated(covered, covariance)
            covariance = covered
        for finding in mirror:
            if isinstance(finding, MirrorImage):
                observable &= ~finding.doubtful(covariance)
                covariance = finding.covered(covariance)
        belief = replace(belief, covariance=covariance)
        return Verdict(belief, observable, located & observable, moves, elsewhere, found_again)

    def _surveyed(self, covariance: Matrix) -> NDArray[np.bool_]:
        """``(n,)`` which bodies stand where they have been found: anchors, whoever had fixes when that was."""
        variances = covariance.diagonal().reshape(-1, STATES_PER_AGENT)[:, :3].max(axis=1)
        return np.asarray(self._stands & (variances <= HELD_SIGMA_M**2), np.bool_)

    def _held(
        self, rows: RowTable, trusted: NDArray[np.bool_], surveyed: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Who of the ``trusted`` ``(n,)`` has fixes or is ``surveyed``, or hangs on those, be it over others."""
        fixed = np.array([any_of(rows, POSITION, slot) for slot in range(len(trusted))])
        held = trusted & (fixed | surveyed)
        while True:
            more = trusted & (held | np.array([monitor.is_held(held) for monitor in self._ambiguities]))
            if (more == held).all():
                return np.asarray(held, np.bool_)
            held = more

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
            self._vehicles,
            problem.period_s,
            self._norm_smoothing,
        )

    def _evidence(
        self,
        slot: int,
        lag: int,
        problem: WindowProblem,
        measured: RowTable,
        belief: Belief,
        located: NDArray[np.bool_],
    ) -> DroneEvidence:
        """What speaks of a drone ``lag`` ticks ago; the others are where the estimate has them."""
        mean, covariance = belief.path[-1 - lag], belief.covariance
        drift = None if belief.errors is None else belief.errors.drift(slot)
        fixed = any_of(problem.rows, POSITION, slot)
        mine = slice(3 * slot, 3 * slot + 3)
        start = problem.start
        rows = empty_rows() if fixed else rows_of(measured[start[-2 - lag] : start[-1 - lag]], slot)
        others = [] if fixed else [int(s) for s in np.flatnonzero(located) if s != slot]
        return DroneEvidence(
            fixed,
            slot == self._slot or bool((problem.rows["observer"] == slot).any()),
            belief.followed(slot, lag),
            rows,
            problem.accel[-1 - lag, mine],
            problem.accel_variance[-1 - lag, mine],
            {other: body_of(mean, covariance, other) for other in others},
            drift,
        )

    def _carried_back(self, slot: int, lag: int, there: Body, problem: WindowProblem, *, slide: bool) -> Body:
        """A place that the data held to ``lag`` ticks ago, at the window's start."""
        mine = slice(3 * slot, 3 * slot + 3)
        back, push = transition_matrix(1, -self._period_s), input_matrix(1, self._period_s)
        place, spread = there[0], RESEATED_SPREAD * there[1]
        for k in range(len(problem.accel) - 1 - lag, 0 if slide else -1, -1):
            place = back @ (place - push @ problem.accel[k, mine])
            spread = back @ (spread + (push * problem.accel_variance[k, mine]) @ push.T) @ back.T
        return place, spread

    def change_members(
        self, change: MemberChange, fresh: Mapping[int, Body], limits: StateLimits | None = None
    ) -> None:
        """Go on with another fleet, its limits; ``fresh``: the states, at the last tick, of those that begin anew."""
        self._slot, self._vehicles, self._stands = change.own, change.after.is_vehicle, _stands(change.after)
        self._observability.change_members(change)
        monitors = []
        for slot in range(change.after.size):
            if slot in fresh:
                monitors.append(AmbiguityMonitor(slot, fresh[slot], self._period_s, limits))
            else:
                monitors.append(self._ambiguities[change.stayed[slot]])
                monitors[-1].change_members(change, limits)
        self._doubtful = np.array([s not in fresh and self._doubtful[change.stayed[s]] for s in range(len(monitors))])
        self._ambiguities = monitors


def _stands(layout: Layout) -> NDArray[np.bool_]:
    """``(n,)`` which bodies are said to stand still."""
    return np.array([kind is BodyKind.ANCHOR for kind in layout.kinds])


def widened(covariance: Matrix, moment: Matrix, slot: int) -> Matrix:
    """A covariance ``(6n, 6n)`` whose block of an agent is at least ``moment`` ``(6, 6)`` along every direction.

    Only what is missing is added: the errors that the agent shares with the others stay shared.
    """
    out, own = covariance.copy(), block(slot)
    out[own, own] += lacking(moment, covariance[own, own])
    return out


def lacking(moment: Matrix, covariance: Matrix) -> Matrix:
    """What is to be added to a covariance for it to be at least ``moment`` along every direction."""
    values, axes = np.linalg.eigh(moment - covariance)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T, np.float64)


def loosened(belief: SlowBelief, slot: int, moment: Matrix) -> SlowBelief:
    """A belief whose covariance of an agent's state, with the error of its acceleration, is at least ``moment``.

    ``moment`` ``(6, 6)``, or ``(9, 9)`` with the error.
    """
    at = np.arange(block(slot).start, block(slot).stop)
    if len(moment) > len(at):
        error = acceleration_of(slot, belief.states // STATES_PER_AGENT)
        at = np.concatenate((at, belief.states + np.arange(error.start, error.stop)))
    grid, covariance = np.ix_(at, at), belief.covariance.copy()
    covariance[grid] += lacking(moment, covariance[grid])
    return replace(belief, covariance=covariance)


def understated(covered: Matrix, covariance: Matrix) -> NDArray[np.bool_]:
    """Of which agents ``(n,)`` a covariance ``(6n, 6n)`` is not to be trusted, given what it should be."""
    expected, claimed = (
        each.diagonal().reshape(-1, STATES_PER_AGENT)[:, :3].sum(-1) for each in (covered, covariance)
    )
    return np.asarray(expected > np.maximum(FLOOR_M**2, UNDERSTATED * claimed))


def _reversed(belief: Belief, vehicles: NDArray[np.bool_]) -> Belief:
    """The mirror image of a belief, in the plane of ``vehicles`` ``(n,)``."""
    _, covariance = mirrored(belief.path[-1], belief.covariance, vehicles)
    before = belief.arrival
    arrival = InformationState.from_moments(*mirrored(before.mean, before.covariance(), vehicles))
    path = np.array([state + mirror_offset(state, vehicles) for state in belief.path])
    return Belief(path, covariance, arrival, None if belief.errors is None else belief.errors.apart())
