"""Moving horizon estimation over everything the fleet shared (``dmhe_shared``), see docs/algorithms.md.

A fixed-lag smoother over the last N ticks, as the field calls it, run on every drone. Measurements and inputs travel
over hops, so that the window of every agent holds what the fleet measured and each solves the central problem. It is
solved over its first state alone, the exact form of the paper's estimator with EKF pre-estimation
(`estimators.window.first_state`), together with the slow errors of the sensors (`estimators.systematic`), and with
outliers weighted down. The arrival cost is filtered, so that nothing is used twice; consensus on its states only
repairs what was lost on the way: the slow errors follow from the same measurements everywhere and do not travel.

What an arrival cost holds is never linearised anew. So a range between places that are not known well enters it
with what its linearisation misses (`estimators.model.second_order`), and monitors keep other places in mind
(`estimators.algorithms.shared_monitors`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimators.algorithms.rival import Passages, Rival, log_likelihood, merged, placed
from estimators.algorithms.shared_monitors import Belief, SharedMonitors, Verdict, loosened
from estimators.consensus.inheritance import Inheritance
from estimators.estimator import Estimate, Payload, SolverReport, Status
from estimators.integrity.finding import Finding, What
from estimators.integrity.innovations import InnovationMonitor
from estimators.integrity.places.ambiguity import Body
from estimators.integrity.thresholds import DECISIVE_NATS
from estimators.model.gaussian import Pair, Prior, symmetrised
from estimators.model.layout import ALL_VEHICLES, Kinds, Layout, block
from estimators.model.limits import state_limits
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.members import InformationState, MemberChange
from estimators.model.motion import input_matrix, transition_matrix
from estimators.settings import EstimatorSettings
from estimators.solvers.qp import make_engine
from estimators.systematic.acceleration_errors import AccelerationErrors
from estimators.systematic.belief import SlowBelief
from estimators.systematic.range_biases import RangeBiases
from estimators.systematic.sizes import SystematicSizes
from estimators.systematic.slow_errors import corrected_rows
from estimators.window.arrival_cost import first_estimate
from estimators.window.assembly import open_window
from estimators.window.limited import solve_limited
from estimators.window.opening import guess_of_linear_rows, is_open
from estimators.window.problem import WindowProblem
from estimators.window.slow_window import (
    SlowProblem,
    SlowSolution,
    continued,
    leaving_residuals,
    slow_problem,
)


class SharedMovingHorizonEstimator:
    """One agent's ``dmhe_shared``; arguments as in `estimators.factory.make_estimator`.

    A measurement window, the belief about its start, inheritance as consensus on it, and the monitors.
    """

    fixed_members = False

    def __init__(
        self,
        settings: EstimatorSettings,
        layout: Layout,
        slot: int,
        prior_mean: Vector,
        prior_covariance: Matrix,
        period_s: float,
    ) -> None:
        self.settings = settings
        self.layout = layout
        self.slot = slot
        self.period_s = period_s
        self.rounds = settings.rounds
        self.window = open_window(settings, layout, period_s)
        self._sizes = SystematicSizes(layout, period_s) if settings.systematic_errors else None
        mean, covariance = np.array(prior_mean, float), symmetrised(np.asarray(prior_covariance, float))
        self.belief = SlowBelief.first(mean, covariance, self._present_sizes())
        """About the window's start, before consensus."""
        self._states: InformationState | None = self.belief.kinematic()
        """Its states alone, where they are those of the last tick's solution."""
        self._own: Pair = self._states.pair()
        self._last: SlowSolution | None = None
        """Of the tick before, to start from."""
        self._consensus = Inheritance(layout, slot)
        self._innovations = InnovationMonitor(layout.size, slot, period_s)
        self._rival: Rival | None = None
        """The same fleet with a drone at another place, while that is possible."""
        self._passages = Passages(layout.size)
        self._limits = state_limits(settings, layout)
        self._monitors = SharedMonitors(
            layout, slot, mean, covariance, period_s, settings.norm_smoothing_m, self._limits
        )

    @property
    def dropped(self) -> int:
        """Rows and inputs that came too late for the window."""
        return self.window.dropped

    @property
    def refused_pairs(self) -> int:
        """Neighbours' pairs of the right tick that could not be fused."""
        return self._consensus.refused

    @property
    def prior_tick(self) -> int:
        """The next window's first tick."""
        return self.window.next_first

    def begin(self, tick: int, measurements: RowTable, inputs: InputTable) -> None:
        """Open a tick: slide the window and insert what arrived."""
        self.window.open(tick)
        self.window.insert(measurements, inputs)
        if self._states is None:
            self._states = self.belief.kinematic()
        self._own = self._states.pair()
        self._consensus.begin(self.window.first, self._own)

    def outgoing(self, round_: int) -> Payload:
        """The states of the own arrival cost, with what was inherited in ``round_`` rounds."""
        return self._consensus.outgoing()

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        """Inherit from each neighbour's pair what it knows better; nothing at the very first tick.

        Gives whose pair does not fit the own one (`estimators.consensus.inheritance`).
        """
        for slot in self._consensus.mix(received, fuse=self.window.begun):
            self.window.hear(slot, self.window.first)
        return self._consensus.disbelieved

    def solve(self, budget: int | None = None) -> Estimate:
        """Solve the window, filter it for the next arrival cost, and let the monitors look at both."""
        if not self.window.begun:
            return first_estimate(self.window, self.belief.kinematic())
        self._states = None
        pair = self._consensus.pair()
        if pair is not self._own:
            self.belief = self.belief.with_pair(self._own, pair)
        before, self.belief = self._rival, self._resized(self.belief)
        problem, solution, moves = self._compared(*self._solved(self.belief, self._last, budget), budget)
        self._learn(problem, solution)
        contradictions = self._contradictions(problem, solution)
        states = self.belief.states
        covariance = symmetrised(solution.covariance[:states, :states])
        belief = Belief(solution.path, covariance, solution.arrival.kinematic(), self._acceleration_errors(solution))
        rows, measured = self._seen(problem, solution)
        verdict = self._monitors.look(rows, measured, belief, (before, self._rival), slide=self.window.full)
        observable = verdict.observable
        for finding in contradictions:
            if finding.what is What.FIXES_CONTRADICT:
                observable[finding.about] = False
        observable[list(solution.strained)] = False
        self.belief, self._states, self._last = solution.arrival, belief.arrival, solution
        if verdict.moves:
            moved = verdict.belief.arrival
            self.belief, self._states = solution.arrival.with_states(moved.mean, moved.covariance()), moved
            self._last = self._rival = None
        elif self._rival is None:
            self._rival = self._other_place(problem, solution, verdict)
        for slot, moment in verdict.found_again.items():
            self.belief, self._states = loosened(self.belief, slot, moment), None
        return Estimate(
            self.window.last,
            verdict.belief.path[-1],
            verdict.belief.covariance,
            self._status(solution.converged, len(problem.rows) > 0, bool(observable[self.slot])),
            self.window.ages(),
            SolverReport(
                solution.iterations, solution.programs, solution.cost, solution.active, moves + verdict.moves
            ),
            observable,
            contradictions,
            self._innovations.averages(),
            self._range_biases(solution),
        )

    def _acceleration_errors(self, solution: SlowSolution) -> AccelerationErrors | None:
        if self._sizes is None:
            return None
        return AccelerationErrors.of(solution.slow, solution.covariance, self.belief.sizes, self.period_s)

    def _range_biases(self, solution: SlowSolution) -> RangeBiases | None:
        if self._sizes is None:
            return None
        states = self.belief.states
        covariance = solution.covariance[states:, states:]
        return RangeBiases.of(self.layout, solution.slow, covariance, self._sizes.sizes())

    def _compared(
        self, problem: SlowProblem, solution: SlowSolution, budget: int | None
    ) -> tuple[SlowProblem, SlowSolution, int]:
        """The window and its solution, or those of the rival if it leads now; and how often that happened."""
        rival, gained_nats = self._rival, 0.0
        if rival is None:
            return problem, solution, 0
        try:
            belief = self._resized(rival.belief)
            theirs, elsewhere = self._solved(belief, rival.last, budget)
            if self.window.full:
                gained_nats = log_likelihood(problem, solution, self.belief.covariance)
                gained_nats -= log_likelihood(theirs, elsewhere, belief.covariance)
        except (ArithmeticError, ValueError):  # where the data cannot be explained, the drone is not
            self._drop_rival(rival)
            return problem, solution, 0
        rival, moves = rival.weighed(gained_nats, elsewhere, solution.cost), 0
        if rival.leads:
            rival, problem, solution, moves = rival.exchanged(solution), theirs, elsewhere, 1
        self._rival = rival
        if rival.odds_nats > DECISIVE_NATS:
            self._drop_rival(rival)
        elif merged(rival, solution):
            self._rival = None
        return problem, solution, moves

    def _other_place(self, problem: SlowProblem, solution: SlowSolution, verdict: Verdict) -> Rival | None:
        """The place that a drone may be at instead: its mirror image, or where its data hold to."""
        located = np.flatnonzero(verdict.held).tolist()
        mirrored = self._passages.rival(problem.rows, solution.arrival, located) if self.window.full else None
        if mirrored is not None and self._is_possible(mirrored):
            return mirrored
        if verdict.elsewhere is None:
            return None
        slot, there = verdict.elsewhere
        bodies = [each for each in located if each != slot]
        return Rival(slot, placed(solution.arrival, slot, there, bodies), None, 0.0)

    def _is_possible(self, rival: Rival) -> bool:
        """Whether a rival's drone is where it may be."""
        at = block(rival.slot)
        mean, spread = rival.belief.mean[None, at], rival.belief.covariance[None, at, at]
        return self._limits is None or bool(self._limits.allow(rival.slot, mean, spread).all())

    def _drop_rival(self, rival: Rival) -> None:
        """Go on with one place, which is decided upon."""
        self._passages.settle(rival.slot)
        self._rival = None

    def _resized(self, belief: SlowBelief) -> SlowBelief:
        """A belief whose slow errors have the sizes of now."""
        return belief if self._sizes is None else belief.resized(self._present_sizes())

    def _solved(
        self, belief: SlowBelief, last: SlowSolution | None, budget: int | None
    ) -> tuple[SlowProblem, SlowSolution]:
        """The window's problem with a belief about its start, and its solution, begun where the last one ended."""
        settings = self.settings
        white = np.ones((self.layout.size, 3)) if self._sizes is None else self._sizes.white_factors()
        problem = slow_problem(
            self.window,
            belief,
            white,
            self.period_s,
            settings.norm_smoothing_m,
            robust=settings.robust,
            ignored=self._innovations.ignored,
        )
        path, slow = belief.mean[None, : belief.states], belief.mean[belief.states :]
        if last is not None:
            slid = len(last.path) - len(problem.window.accel)
            path, slow = last.path[slid:], last.slow
        guess = continued(path, problem, slow), slow
        limit = settings.max_iterations if budget is None else min(budget, settings.max_iterations)
        bounds = None if self._limits is None else (self._limits, make_engine(settings.qp))

        def solved(start: tuple[Matrix, Vector]) -> SlowSolution:
            return solve_limited(
                problem, belief, start, limit, settings.tolerance, bounds, slide=self.window.full
            )

        found = solved(guess)
        other = guess_of_linear_rows(problem, belief, guess, settings.tolerance) if is_open(problem, belief) else None
        return problem, found if other is None else min(found, solved(other), key=lambda each: each.cost)

    def _learn(self, problem: SlowProblem, solution: SlowSolution) -> None:
        """Let the sizes of slow errors follow what leaves the window."""
        if self._sizes is None or not self.window.full:
            return
        window, states = problem.window, self.belief.states
        leaving, variance = problem.rows[: window.start[1]], solution.covariance.diagonal()[states:]
        self._sizes.learn(leaving, window.accel[0], window.accel_variance[0], solution.slow, variance)

    def _contradictions(self, problem: SlowProblem, solution: SlowSolution) -> tuple[Finding, ...]:
        """Whose fixes do not fit the rest, as the rows that leave the window say."""
        if not (self.settings.robust and self.window.full):
            return ()
        monitor = self._innovations
        return monitor.observe(leaving_residuals(problem, solution, monitor.ignored))

    def _seen(self, problem: SlowProblem, solution: SlowSolution) -> tuple[WindowProblem, RowTable]:
        """The window as the monitors see it, less its slow errors, and its rows without what linearisations miss."""
        window, states = problem.window, self.belief.states
        variance = solution.covariance.diagonal()[states:]
        rows = problem.rows.copy()
        rows["variance"] = solution.measured
        measured = corrected_rows(rows, window.slow_at, window.slow_by, solution.slow, variance)
        seen = measured.copy()
        seen["variance"] += solution.variances - solution.measured
        pair = self._own
        return (
            WindowProblem(
                seen, window.start, window.accel, window.accel_variance, *pair,
                np.array([self.slot], np.int64), self.period_s, False,
            ),
            measured,
        )  # fmt: skip

    def _present_sizes(self) -> Vector:
        return np.zeros(0) if self._sizes is None else self._sizes.sizes()

    @staticmethod
    def _status(converged: bool, has_rows: bool, observable: bool) -> Status:
        if not observable:
            return Status.NO_DATA if not has_rows and converged else Status.NOT_OBSERVABLE
        if not converged:
            return Status.NOT_CONVERGED
        return Status.OK if has_rows else Status.NO_DATA

    def change_members(
        self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior], kinds: Kinds = ALL_VEHICLES
    ) -> None:
        """Let agents join and leave, see `estimators.estimator.Estimator`."""
        change = MemberChange.between(self.layout, agents, own, fresh, kinds)
        if self._sizes is not None:
            self._sizes.change_members(change)
        self.belief = self.belief.reindexed(change, self._present_sizes())
        self._states = self._last = None
        self._keep_doubt(change)
        self.layout, self.slot = change.after, change.own
        self.window.change_members(change)
        self._consensus.change_members(change)
        self._innovations.change_members(change)
        began = {each: self._at_last_tick(each, prior) for each, prior in change.fresh.items()}
        self._limits = state_limits(self.settings, self.layout)
        self._monitors.change_members(change, began, self._limits)

    def _keep_doubt(self, change: MemberChange) -> None:
        """Who else joins or leaves decides nothing about a blind drone."""
        self._passages.change_members(change.stayed, change.after.size)
        rival, now = self._rival, {was: slot for slot, was in change.stayed.items()}
        self._rival = None
        if rival is not None and rival.slot in now:
            belief = rival.belief.reindexed(change, self._present_sizes())
            self._rival = replace(rival, slot=now[rival.slot], belief=belief, last=None)

    def _at_last_tick(self, slot: int, prior: Prior) -> Body:
        """A prior of a state, of `prior_tick`, brought to the window's last tick."""
        mean, covariance = prior
        move, push = transition_matrix(1, self.period_s), input_matrix(1, self.period_s)
        mine = slice(3 * slot, 3 * slot + 3)
        accel, variance = self.window.inputs()
        for k in range(self.prior_tick - self.window.first, len(accel)):
            mean = move @ mean + push @ accel[k, mine]
            covariance = move @ covariance @ move.T + (push * variance[k, mine]) @ push.T
        return mean, symmetrised(covariance)
