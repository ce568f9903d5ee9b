"""Moving horizon estimation over everything the fleet shared (``dmhe_relay``), see docs/algorithms.md.

Records and inputs travel over hops, so that the window of every agent holds what the fleet measured and each
solves the central problem. The window is DMHE-1's (input corrections as variables); its arrival cost is
filtered, so that nothing is used twice; consensus on it only repairs what was lost on the way.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimators.estimator import Estimate, Payload, SolverReport, Status
from estimators.information import usable_pairs
from estimators.inheritance import inherit
from estimators.marginalization import filter_along
from estimators.measurements import Vector
from estimators.moving_horizon import MovingHorizonEstimator
from estimators.window_types import WindowProblem, WindowSolution


class RelayMovingHorizonEstimator(MovingHorizonEstimator):
    """One agent's ``dmhe_relay``; arguments as in `estimators.factory.make_estimator`."""

    def _observability_rank(self) -> int:
        """Not used: consensus here has no weights."""
        return 0

    def mix(self, round_: int, received: Mapping[int, Payload]) -> None:
        """Inherit from each neighbour's pair what it knows better. Pairs of another window start are not used."""
        usable, refused = usable_pairs(received, self.window.first, self.layout.dimension)
        self.refused_pairs += refused
        if self.window.last == self.window.first:
            return
        # the best informed first, whatever its place: the result does not depend on the agents' order
        for slot in sorted(usable, key=lambda each: -np.linalg.slogdet(usable[each].information)[1]):
            pair = usable[slot]
            mixed = inherit(self._pair, (pair.information, pair.vector), self.slot)
            if mixed is not self._pair:
                self.window.hear(slot, self.window.first)
            self._pair = mixed

    def _slide(self, problem: WindowProblem, solution: WindowSolution) -> None:
        """Marginalise the oldest tick where the window is full; keep the covariance of the newest."""
        n = len(problem.vector)
        information, vector, covariance = np.empty((n, n)), np.empty(n), np.empty((n, n))
        sound = filter_along(
            problem.rows,
            problem.start,
            problem.accel,
            problem.accel_variance,
            np.ascontiguousarray(solution.path),
            self.period_s,
            self.settings.norm_smoothing_m,
            problem.information,
            problem.vector,
            information,
            vector,
            covariance,
        )
        if not sound:
            raise ArithmeticError("the window's information is not positive definite")
        self._covariance = 0.5 * (covariance + covariance.T)
        self._path = list(solution.path)
        if self.window.last - self.window.first < self.settings.window:  # the start stays
            information, vector = problem.information, problem.vector
        self.prior_information = np.ascontiguousarray(information)
        self.prior_mean = np.asarray(np.linalg.solve(information, vector), np.float64)

    def _estimate(self, problem: WindowProblem, mean: Vector, status: Status, report: SolverReport) -> Estimate:
        """The smoothed newest state with the covariance of the filter along the window."""
        if status is Status.OK and not len(problem.rows):
            status = Status.NO_DATA
        return Estimate(self.window.last, mean, self._covariance, status, self.window.ages(), report)
