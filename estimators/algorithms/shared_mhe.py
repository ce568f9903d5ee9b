"""Moving horizon estimation over everything the fleet shared (``dmhe_shared``), see docs/algorithms.md.

A fixed-lag smoother over the last N ticks, as the field calls it, run on every drone. Records and inputs travel over
hops, so that the window of every agent holds what the fleet measured and each solves the central problem. The window
is DMHE-1's (input corrections as variables); its arrival cost is filtered, so that nothing is used twice; consensus
on it only repairs what was lost on the way.

What an arrival cost holds is never linearised anew. So a range between places that are not known well enters it
with what its linearisation misses (`estimators.model.second_order`), and monitors keep other places in mind
(`estimators.algorithms.shared_monitors`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimators.algorithms.shared_monitors import Belief, SharedMonitors
from estimators.consensus.inheritance import Inheritance
from estimators.estimator import Estimate, Payload, Status
from estimators.integrity.ambiguity import Body, body_of
from estimators.model.gaussian import Prior, symmetrised
from estimators.model.layout import Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.members import InformationState, MemberChange
from estimators.model.motion import input_matrix, transition_matrix
from estimators.settings import EstimatorSettings
from estimators.window.arrival_cost import filtered_arrival, first_estimate
from estimators.window.assembly import open_window, window_problem
from estimators.window.solving import solve_window


class SharedMovingHorizonEstimator:
    """One agent's ``dmhe_shared``; arguments as in `estimators.factory.make_estimator`.

    A measurement window, the filtered arrival cost, inheritance as consensus on it, and the monitors.
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
        self.arrival = InformationState.from_moments(prior_mean, prior_covariance)
        """Belief about the window's start before consensus."""
        self._consensus = Inheritance(slot)
        own = body_of(self.arrival.mean, symmetrised(np.asarray(prior_covariance, float)), slot)
        self._monitors = SharedMonitors(layout, slot, own, period_s, settings.norm_smoothing_m)

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
        self._consensus.begin(self.window.first, self.arrival.pair())

    def outgoing(self, round_: int) -> Payload:
        """The own arrival cost, with what was inherited in ``round_`` rounds."""
        return self._consensus.outgoing()

    def mix(self, round_: int, received: Mapping[int, Payload]) -> None:
        """Inherit from each neighbour's pair what it knows better; nothing at the very first tick."""
        for slot in self._consensus.mix(received, fuse=self.window.begun):
            self.window.hear(slot, self.window.first)

    def solve(self, budget: int | None = None) -> Estimate:
        """Solve the window, filter it for the next arrival cost, and let the monitors look at both."""
        if not self.window.begun:
            return first_estimate(self.window, self.arrival)
        slide, eps = self.window.full, self.settings.norm_smoothing_m
        problem = window_problem(self.window, self._consensus.pair(), self.slot, self.period_s, False)
        solution = solve_window(problem, self.settings, budget)
        filtered = filtered_arrival(problem, solution.path, eps, slide=slide)
        belief = Belief(solution.path, filtered.covariance, filtered.arrival)
        verdict = self._monitors.look(problem._replace(rows=filtered.rows), problem.rows, belief, slide=slide)
        self.arrival = verdict.belief.arrival
        return Estimate(
            self.window.last,
            verdict.belief.path[-1],
            verdict.belief.covariance,
            self._status(solution.status, len(problem.rows) > 0, bool(verdict.observable[self.slot])),
            self.window.ages(),
            replace(solution.report, moves=verdict.moves),
            verdict.observable,
        )

    @staticmethod
    def _status(solved: Status, has_rows: bool, observable: bool) -> Status:
        if solved is Status.OK and not has_rows:
            return Status.NO_DATA
        if not observable and solved in (Status.OK, Status.NOT_CONVERGED):
            return Status.NOT_OBSERVABLE
        return solved

    def change_members(self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior]) -> None:
        """Let agents join and leave, see `estimators.estimator.Estimator`."""
        change = MemberChange.between(self.layout, agents, own, fresh)
        self.arrival = self.arrival.reindexed(change)
        self.layout, self.slot = change.after, change.own
        self.window.change_members(change)
        self._consensus.change_members(change)
        prior = change.fresh.get(self.slot)
        self._monitors.change_members(change, None if prior is None else self._at_last_tick(prior))

    def _at_last_tick(self, prior: Prior) -> Body:
        """A prior of the own state, of `prior_tick`, brought to the window's last tick."""
        mean, covariance = prior
        move, push = transition_matrix(1, self.period_s), input_matrix(1, self.period_s)
        mine = slice(3 * self.slot, 3 * self.slot + 3)
        accel, variance = self.window.inputs()
        for k in range(self.prior_tick - self.window.first, len(accel)):
            mean = move @ mean + push @ accel[k, mine]
            covariance = move @ covariance @ move.T + (push * variance[k, mine]) @ push.T
        return mean, symmetrised(covariance)
