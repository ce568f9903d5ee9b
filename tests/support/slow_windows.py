"""Random windows of the shared estimator, with and without slow errors of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.model.layout import Layout
from estimators.model.measurements import Kind, input_rows
from estimators.systematic import slow_errors
from estimators.systematic.belief import SlowBelief
from estimators.window.history import MeasurementWindow
from estimators.window.slow_window import SlowSolution, continued, slow_problem, solve_slow
from tests.support import builders
from tests.support.joint_reference import JointWindow, coupling_matrix

Array = NDArray[np.float64]
DT, EPS = 0.1, 1e-3


@dataclass(frozen=True, slots=True)
class DrawnWindow:
    """A window, a belief about its start, the white factors ``(n, 3)`` of its fixes, and the truth ``(N+1, 6n)``."""

    window: MeasurementWindow
    belief: SlowBelief
    white: Array
    truth: Array

    def solved(
        self, *, robust: bool = False, tolerance: float = 1e-10, iterations: int = 300, slide: bool = True
    ) -> SlowSolution:
        """By the kernels, from the belief's mean."""
        problem = slow_problem(self.window, self.belief, self.white, DT, EPS, robust=robust)
        path, slow = self.belief.mean[None, : self.belief.states], self.belief.mean[self.belief.states :]
        guess = continued(path, problem, slow), slow
        return solve_slow(problem, self.belief, guess, iterations, tolerance, slide=slide)

    def joint(self, *, robust: bool = False) -> JointWindow:
        """The same over all variables."""
        rows, start = self.window.rows()
        return JointWindow(
            rows, start, self.window.inputs(), self.belief, DT, EPS, white=self.white, robust=robust
        )


def draw_window(
    rng: np.random.Generator,
    *,
    agents: int,
    ticks: int,
    slow: bool,
    kinds: Sequence[Kind] = builders.ALL_KINDS,
    rows_per_agent: int = 2,
    prior_m: float = 0.2,
    correlated: bool = True,
) -> DrawnWindow:
    """Rows of random kinds at instants of their own; the belief's mean is drawn from it.

    All of it is correlated, or else only the states are, and the slow errors are as their priors.
    """
    kinds = [kind for kind in kinds if agents > 1 or kind not in (Kind.RANGE, Kind.RELATIVE)]
    truth, accel = builders.fly(rng, agents, ticks, DT)
    count = slow_errors.count(agents) if slow else 0
    scales = np.concatenate([np.full(6 * agents, prior_m), rng.uniform(0.05, 0.5, count)])
    covariance = scales[:, None] * builders.random_covariance(rng, 6 * agents + count) * scales
    if not correlated:
        covariance[6 * agents :] = covariance[:, 6 * agents :] = 0.0
        covariance[range(6 * agents, len(scales)), range(6 * agents, len(scales))] = scales[6 * agents :] ** 2
    errors = np.linalg.cholesky(covariance) @ rng.normal(size=len(scales))
    mean = np.concatenate([truth[0], np.zeros(count)]) + errors
    belief = SlowBelief(mean, 0.5 * (covariance + covariance.T), scales[6 * agents :])
    window = MeasurementWindow(Layout(tuple(range(1, agents + 1))), ticks, other_accel_variance=4 / 3)
    window.advance(ticks)
    for tick in range(ticks + 1):
        for agent in range(agents):
            for _ in range(rows_per_agent):
                kind = kinds[rng.integers(len(kinds))]
                rows = builders.row_of(kind, rng, tick, agent, agents, float(rng.uniform(-DT / 2, DT / 2)))
                rows = builders.measured(rows, truth, EPS, rng)
                if slow:
                    rows["value"] += coupling_matrix(rows, agents) @ rng.normal(0.0, scales[6 * agents :])
                window.insert(rows, input_rows(0, 0, np.zeros(3), 1.0)[:0])
    for k in range(ticks):
        for agent in range(agents):
            push = accel[k, 3 * agent : 3 * agent + 3] + 0.1 * rng.normal(size=3)
            variance = np.exp(rng.uniform(np.log(1e-3), np.log(2.0), 3))
            window.insert(window.rows()[0][:0], input_rows(k, agent, push, variance))
    white = rng.uniform(0.5, 1.5, (agents, 3)) if slow else np.ones((agents, 3))
    return DrawnWindow(window, belief, white, truth)
