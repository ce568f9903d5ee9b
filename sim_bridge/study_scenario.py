"""The studies' scenario: a fleet that flies to fixed references, measured with the paper's uniform noises.

Borelle et al. 2023, Section IV. Truth starts uniform in +-15 m and +-2 m/s per component and is steered by an LQR
(state and input weights 1) to one reference per agent, acceleration clipped to +-2 m/s2 per axis. The plant
moves with the commanded u; the agents know u + w.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimators.motion import predict_mean
from sim_bridge.guidance import STUDIES_REFERENCES_M, Reference, command, lqr_gain
from sim_bridge.recording import Recording

Start = Literal["paper", "good"]

ACCEL_HALF_WIDTH = 0.1
GPS_HALF_WIDTH = (0.15, 0.15, 0.15, 0.08)
RANGE_HALF_WIDTH = 0.1
ACCEL_LIMIT_MPS2 = 2.0

PAPER_P0 = (6.0, 6.0, 6.0, 0.01, 0.01, 0.01)
GOOD_P0 = (6.0, 6.0, 6.0, 1.0, 1.0, 1.0)

GRAPHS: dict[str, tuple[int, Sequence[tuple[int, int]]]] = {
    "line": (3, ((0, 1), (1, 2))),
    "triangle": (3, ((0, 1), (1, 2), (0, 2))),
    "ring4": (4, ((0, 1), (1, 2), (2, 3), (3, 0))),
    **{f"K{n}": (n, tuple((a, b) for a in range(n) for b in range(a + 1, n))) for n in (4, 5, 6)},
}
"""Name -> number of agents and edges."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One family of runs; `record` draws a run of it."""

    graph: str = "line"
    samples: int = 70
    """T: ticks after the first."""
    period_s: float = 0.1
    start: Start = "good"
    blind: int = 0
    """How many agents, from the last backwards, have no GPS."""

    def __post_init__(self) -> None:
        if self.graph not in GRAPHS:
            raise ValueError(f"graph: expected one of {', '.join(GRAPHS)}, found {self.graph!r}")

    def record(self, seed: int, run: int) -> Recording:
        """The recording of one run, a function of ``seed`` and ``run`` alone."""
        rng = np.random.default_rng([seed, run])
        n, edges = GRAPHS[self.graph]
        truth, accel = _fly(rng, n, self.samples, self.period_s)
        positions, speeds = truth[:, :, :3], np.linalg.norm(truth[:, :, 3:], axis=-1)
        gps = np.concatenate([positions, speeds[..., None]], axis=-1)
        gps += rng.uniform(-1, 1, gps.shape) * GPS_HALF_WIDTH
        if self.blind:
            gps[:, n - self.blind :] = np.nan
        x0, p0 = self._start(rng, truth[0])
        return Recording(
            period_s=self.period_s,
            agents=np.arange(1, n + 1),
            edges=np.array(edges, np.int64),
            accel=accel + rng.uniform(-ACCEL_HALF_WIDTH, ACCEL_HALF_WIDTH, accel.shape),
            gps=gps,
            ranges=_ranges(rng, positions, edges),
            gps_half_width=np.array(GPS_HALF_WIDTH),
            range_half_width=RANGE_HALF_WIDTH,
            accel_half_width=ACCEL_HALF_WIDTH,
            x0=x0,
            P0=p0,
            received=np.ones((self.samples + 1, n, n), bool),
            delay_ticks=np.zeros((self.samples + 1, n, n), np.int64),
            truth=truth,
        )

    def _start(
        self, rng: np.random.Generator, truth: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """First estimates ``(n, 6n)`` and their covariance."""
        n = len(truth)
        variances = np.tile(PAPER_P0 if self.start == "paper" else GOOD_P0, n)
        if self.start == "paper":
            return np.zeros((n, 6 * n)), np.diag(variances)
        return truth.ravel() + rng.normal(size=(n, 6 * n)) * np.sqrt(variances), np.diag(variances)


def _fly(
    rng: np.random.Generator, n: int, samples: int, period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True states ``(T+1, n, 6)`` and commanded accelerations ``(T, n, 3)``."""
    gain = lqr_gain(period_s)
    goals = [Reference(point) for point in STUDIES_REFERENCES_M[:n]]
    truth = np.empty((samples + 1, n, 6))
    truth[0] = np.concatenate([rng.uniform(-15, 15, (n, 3)), rng.uniform(-2, 2, (n, 3))], axis=1)
    accel = np.empty((samples, n, 3))
    for k in range(samples):
        accel[k] = command(gain, goals, truth[k, :, :3], truth[k, :, 3:], ACCEL_LIMIT_MPS2)
        truth[k + 1] = predict_mean(truth[k].ravel(), accel[k].ravel(), period_s).reshape(n, 6)
    return truth, accel


def _ranges(
    rng: np.random.Generator, positions: NDArray[np.float64], edges: Sequence[tuple[int, int]]
) -> NDArray[np.float64]:
    """Ranges ``(T+1, n, n)`` along the edges, both ends with their own noise."""
    ticks, n, _ = positions.shape
    ranges = np.full((ticks, n, n), np.nan)
    for a, b in [pair for edge in edges for pair in (edge, edge[::-1])]:
        distance = np.linalg.norm(positions[:, a] - positions[:, b], axis=-1)
        ranges[:, a, b] = distance + rng.uniform(-RANGE_HALF_WIDTH, RANGE_HALF_WIDTH, ticks)
    return ranges
