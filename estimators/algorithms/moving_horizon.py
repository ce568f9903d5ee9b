"""Distributed moving horizon estimators with arrival-cost consensus: DMHE-pre-EKF and DMHE-1.

Algorithm 1 of Borelle et al. 2023, with its line 18 read as t < N (at t = N the arrival cost must already
move, else time 0 would be the prior of the window that starts at 1).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from estimators.consensus.fusion import Fusion
from estimators.consensus.rank import WindowRank
from estimators.estimator import Estimate, Payload, Status
from estimators.model.gaussian import Prior
from estimators.model.layout import ALL_VEHICLES, Kinds, Layout
from estimators.model.measurements import InputTable, Matrix, RowTable, Vector
from estimators.model.members import InformationState, MemberChange
from estimators.settings import EstimatorSettings
from estimators.window.arrival_cost import first_estimate, smoothed_arrival
from estimators.window.assembly import open_window, window_problem
from estimators.window.solving import pre_estimation, solve_window


class MovingHorizonEstimator:
    """One agent's DMHE, with EKF pre-estimation (``dmhe_pre_ekf``) or with input corrections (``dmhe``).

    A measurement window, the paper's arrival cost and weighted fusion of it; ``settings.kind`` chooses between the
    two. Arguments as in `estimators.factory.make_estimator`.
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
        self._consensus = Fusion(settings.weights)
        self._rank = WindowRank(self.arrival.mean, period_s, settings.norm_smoothing_m)

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
        """Open a tick: slide the window, insert what arrived, compute the observability rank (24)-(25)."""
        self.window.open(tick)
        self.window.insert(measurements, inputs)
        weighed = self.settings.weights == "observability_rank" and self.rounds > 0 and self.window.begun
        self._consensus.begin(self.window.first, self.arrival.pair(), self._rank.rank(self.window) if weighed else 0)

    def outgoing(self, round_: int) -> Payload:
        """The information pair (11)-(12) after ``round_`` rounds."""
        return self._consensus.outgoing()

    def mix(self, round_: int, received: Mapping[int, Payload]) -> Collection[int]:
        """One round of (13)-(14); at the very first tick there is no window to solve, and nothing is fused."""
        for slot in self._consensus.mix(round_, received, fuse=self.window.begun):
            self.window.hear(slot, self.window.first)
        return ()

    def solve(self, budget: int | None = None) -> Estimate:
        """Solve the window (5)-(10), move the arrival cost (17)-(18); the covariance is the pre-estimation's (22)."""
        if not self.window.begun:
            return first_estimate(self.window, self.arrival)
        with_gains = self.settings.kind == "dmhe_pre_ekf"
        prior, pairs = self._consensus.unfused()
        problem = window_problem(self.window, prior, self.slot, self.period_s, with_gains)
        solution = solve_window(problem, self.settings, budget, pairs)
        self.arrival = smoothed_arrival(problem, solution, slide=self.window.full)
        self._rank.keep(solution.path)
        _, covariance = pre_estimation(problem, self.settings.norm_smoothing_m)
        status = Status.NO_DATA if solution.status is Status.OK and not len(problem.rows) else solution.status
        mean = solution.path[-1]
        return Estimate(self.window.last, mean, covariance, status, self.window.ages(), solution.report)

    def change_members(
        self, agents: Sequence[int], own: int, fresh: Mapping[int, Prior], kinds: Kinds = ALL_VEHICLES
    ) -> None:
        """Let agents join and leave, see `estimators.estimator.Estimator`."""
        change = MemberChange.between(self.layout, agents, own, fresh, kinds)
        self.arrival = self.arrival.reindexed(change)
        self.layout, self.slot = change.after, change.own
        self.window.change_members(change)
        self._consensus.change_members()
        first_kept = self.window.last + 1 - self._rank.ticks
        self._rank.change_members(change, self.arrival.mean, first_kept - self.prior_tick)
