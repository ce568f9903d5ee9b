"""The observability rank of a moving window, which its consensus weights follow from."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from estimators.integrity.observability import observability_rank
from estimators.model.layout import STATES_PER_AGENT, states_of
from estimators.model.measurements import Matrix, Vector
from estimators.model.members import MemberChange
from estimators.model.motion import predict_mean
from estimators.window.history import MeasurementWindow


class WindowRank:
    """Rank (24)-(25) of Borelle et al. 2023 over a window, at the last window's estimates and their prediction."""

    def __init__(self, start: Vector, period_s: float, norm_smoothing: float) -> None:
        self._path: list[Vector] = [start]
        """Estimates ``(6n,)`` of the states of the previous window, oldest first."""
        self._period_s = period_s
        self._norm_smoothing = norm_smoothing

    def rank(self, window: MeasurementWindow) -> int:
        """Rank of the window whose last tick follows the estimates kept."""
        rows, start = window.rows()
        accel, _ = window.inputs()
        newest = predict_mean(self._path[-1], accel[-1], self._period_s)
        states = [*self._path, newest][-(len(start) - 1) :]
        by_tick = [rows[a:b] for a, b in pairwise(start)]
        return observability_rank(by_tick, states, self._period_s, self._norm_smoothing)

    def keep(self, path: Matrix) -> None:
        """Take the estimates ``(N+1, 6n)`` of a window's states, for the next one."""
        self._path = list(path)

    def change_members(self, change: MemberChange, mean: Vector, ticks_before_path: int) -> None:
        """Go on with another fleet; of a fresh agent with its prior, moved along with its velocity.

        ``mean`` ``(6n,)`` is that of the new fleet, so many ticks before the first of the estimates kept.
        """
        at, source = states_of(list(change.stayed)), states_of(list(change.stayed.values()))
        path: list[Vector] = []
        for k, state in enumerate(self._path):
            states = mean.reshape(-1, STATES_PER_AGENT).copy()
            states[:, :3] += (ticks_before_path + k) * self._period_s * states[:, 3:]
            moved = np.asarray(states.ravel(), np.float64)
            moved[at] = state[source]
            path.append(moved)
        self._path = path

    @property
    def ticks(self) -> int:
        """How many states are kept."""
        return len(self._path)
