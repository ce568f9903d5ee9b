"""What the data alone say of the fleet: the information filter without the prior.

An estimate holds what was measured and what was believed at the start; where the data say nothing, the covariance
of the second kind passes for knowledge. Here the same rows, linearised along the same path, are filtered from a
start that knows nothing (an observability Gramian that forgets as the process noise says). A direction whose
variance stays that of the start is not observable from what this agent has.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.layout import STATES_PER_AGENT
from estimators.marginalization import filter_along
from estimators.measurements import Matrix
from estimators.window_types import WindowProblem

START_SIGMA_M = 100.0
START_SIGMA_MPS = 10.0
"""What stands for knowing nothing."""
OBSERVABLE_SIGMA_M = 10.0
"""Position sigma of an agent, along its worst direction, up to which the data say where it is."""


def no_information(agents: int) -> Matrix:
    """Information ``(6n, 6n)`` of a start that knows nothing."""
    sigmas = np.repeat([START_SIGMA_M, START_SIGMA_MPS], 3)
    return np.diag(np.tile(sigmas**-2.0, agents))


class DataInformation:
    """Information that the data gave at the start of an estimator's window."""

    def __init__(self, agents: int) -> None:
        self.information = no_information(agents)

    def advance(self, problem: WindowProblem, path: Matrix, eps: float, *, slide: bool) -> NDArray[np.bool_]:
        """Which agents the window's data and those before it observe ``(n,)``.

        ``path`` ``(N+1, 6n)``: where rows are linearised. ``slide``: whether the window's start moves on by a tick.
        """
        n = len(problem.vector)
        following, vector, covariance = np.empty((n, n)), np.empty(n), np.empty((n, n))
        sound = filter_along(
            problem.rows,
            problem.start,
            problem.accel,
            problem.accel_variance,
            np.ascontiguousarray(path),
            problem.period_s,
            eps,
            self.information,
            np.zeros(n),
            following,
            vector,
            covariance,
        )
        if not sound:
            self.information = no_information(n // STATES_PER_AGENT)
            return np.zeros(n // STATES_PER_AGENT, np.bool_)
        if slide:
            self.information = following
        return observable_agents(covariance)


def observable_agents(covariance: Matrix) -> NDArray[np.bool_]:
    """Agents ``(n,)`` whose position is known along every direction, given a covariance without a prior."""
    agents = len(covariance) // STATES_PER_AGENT
    blocks = covariance.reshape(agents, STATES_PER_AGENT, agents, STATES_PER_AGENT)
    positions = np.array([blocks[s, :3, s, :3] for s in range(agents)])
    worst = np.linalg.eigvalsh(positions)[:, -1]
    return np.asarray(worst <= OBSERVABLE_SIGMA_M**2)
