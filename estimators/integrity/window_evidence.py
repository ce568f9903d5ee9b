"""What monitors of the whole fleet look at: a window that an estimator has solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.row_kernels import IntArray


@dataclass(frozen=True, slots=True)
class WindowEvidence:
    """A window of N ticks and the state at each of its N + 1 instants."""

    rows: RowTable
    """Its measurements, by tick."""
    start: IntArray
    """``(N+2,)``: the rows of instant k are ``rows[start[k]:start[k + 1]]``."""
    accel_variance: Matrix
    """``(N, 3n)`` of the inputs, (m/s2)2."""
    path: Matrix
    """``(N+1, 6n)``: the estimate, where rows are linearised."""
    arrival_mean: Vector
    arrival_information: Matrix
    """``(6n,)``, ``(6n, 6n)``: what the estimator carries into the next window."""
    slide: bool
    """Whether the next window starts one tick later: then the first tick's rows have been used for good."""
    vehicles: NDArray[np.bool_]
    """``(n,)`` which bodies are the fleet's own."""
    period_s: float
    norm_smoothing: float
    """See `estimators.settings.EstimatorSettings.norm_smoothing_m`."""
