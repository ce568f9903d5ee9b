"""Figures of a stream of errors in constant memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LOW, HIGH = 1e-6, 1e6
BINS_PER_E = 200
"""Bins of half a percent: far finer than any single run's median is certain."""


class Spread:
    """Root mean square, mean and percentiles of what was added; values that are not finite are left out.

    Percentiles are of a histogram with logarithmic bins of half a percent, for magnitudes from 1e-6 to 1e6.
    """

    def __init__(self) -> None:
        self.count = 0
        self._sum = 0.0
        self._squares = 0.0
        self._bins = np.zeros(int(BINS_PER_E * math.log(HIGH / LOW)) + 2, np.int64)

    def add(self, values: Floats) -> None:
        """More values ``(K,)``, none of them negative."""
        finite = values[np.isfinite(values)]
        if not len(finite):
            return
        self.count += len(finite)
        self._sum += float(finite.sum())
        self._squares += float(finite @ finite)
        places = BINS_PER_E * np.log(np.clip(finite, LOW, HIGH) / LOW)
        self._bins += np.bincount(places.astype(np.int64), minlength=len(self._bins))

    @property
    def rms(self) -> float | None:
        """Root mean square; ``None`` of nothing, as the others."""
        return math.sqrt(self._squares / self.count) if self.count else None

    @property
    def mean(self) -> float | None:
        """Mean."""
        return self._sum / self.count if self.count else None

    def percentile(self, percent: float) -> float | None:
        """The value below which that share lies, to half a percent of it."""
        if not self.count:
            return None
        below = np.cumsum(self._bins)
        place = int(np.searchsorted(below, percent / 100.0 * self.count))
        return LOW * math.exp((place + 0.5) / BINS_PER_E)


class Thinned:
    """A series of rows ``(columns,)`` for a plot: all while they are few, then every second, fourth, ..."""

    def __init__(self, limit: int = 4000) -> None:
        self._limit = limit
        self._rows: list[Floats] = []
        self._step = 1
        self._seen = 0

    def add(self, row: Floats) -> None:
        """One more row."""
        if self._seen % self._step == 0:
            self._rows.append(row)
            if len(self._rows) > self._limit:
                del self._rows[1::2]
                self._step *= 2
        self._seen += 1

    @property
    def step(self) -> int:
        """Every how many-th row is kept."""
        return self._step

    def table(self, columns: int) -> Floats:
        """What is kept, ``(K, columns)``."""
        return np.array(self._rows).reshape(len(self._rows), columns)
