"""Horizontal flights on known curves with sensors as wrong as real ones, for the tests of the latency."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Course:
    """Constant velocity plus sines: ``amplitude_m``, ``rate_radps`` and ``phase_rad`` are ``(waves, 2)``."""

    velocity_mps: tuple[float, float] = (0.0, 0.0)
    amplitude_m: tuple[tuple[float, float], ...] = ()
    rate_radps: tuple[tuple[float, float], ...] = ()
    phase_rad: tuple[tuple[float, float], ...] = ()

    @classmethod
    def eight(cls, rng: np.random.Generator | None = None) -> Course:
        """Turns of some metres in some seconds, up to about 5 m/s and 2 m/s2."""
        if rng is None:
            return cls((0.0, 0.0), ((6.0, 4.0),), ((0.5, 0.7),), ((0.0, 1.0),))
        spans = ((3.0, 7.0), (0.4, 0.7), (0.0, 6.28))
        amplitude, rate, phase = (tuple(map(tuple, rng.uniform(*span, (2, 2)).tolist())) for span in spans)
        return cls((0.0, 0.0), amplitude, rate, phase)

    def position(self, t_s: float) -> Array:
        """North and east in m."""
        waves = np.array(self.amplitude_m).reshape(-1, 2) * np.sin(self._angle(t_s))
        return np.asarray(np.array(self.velocity_mps) * t_s + waves.sum(axis=0))

    def velocity(self, t_s: float) -> Array:
        """North and east in m/s."""
        rate = np.array(self.rate_radps).reshape(-1, 2)
        waves = np.array(self.amplitude_m).reshape(-1, 2) * rate * np.cos(self._angle(t_s))
        return np.asarray(np.array(self.velocity_mps) + waves.sum(axis=0))

    def mean_accel(self, from_s: float, to_s: float) -> Array:
        """Mean acceleration over a span, north and east in m/s2."""
        return (self.velocity(to_s) - self.velocity(from_s)) / (to_s - from_s)

    def _angle(self, t_s: float) -> Array:
        rate, phase = np.array(self.rate_radps).reshape(-1, 2), np.array(self.phase_rad).reshape(-1, 2)
        return np.asarray(rate * t_s + phase)


class Markov:
    """First-order Gauss-Markov of a fixed step, ``(2,)``."""

    def __init__(self, sigma: float, correlation_s: float, step_s: float, rng: np.random.Generator) -> None:
        self._kept, self._sigma, self._rng = math.exp(-step_s / correlation_s), sigma, rng
        self.value: Array = sigma * rng.standard_normal(2)

    def step(self) -> Array:
        """The next value."""
        fresh = self._sigma * math.sqrt(1.0 - self._kept**2)
        self.value = self._kept * self.value + fresh * self._rng.standard_normal(len(self.value))
        return self.value
