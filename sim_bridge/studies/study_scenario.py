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

from estimators.model.motion import predict_mean
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.world.guidance import command, default_path, lqr_gain

Start = Literal["paper", "good"]

ACCEL_HALF_WIDTH = 0.1
GPS_HALF_WIDTH = (0.15, 0.15, 0.15, 0.08)
RANGE_HALF_WIDTH = 0.1
ACCEL_LIMIT_MPS2 = 2.0

PAPER_P0 = (6.0, 6.0, 6.0, 0.01, 0.01, 0.01)
GOOD_P0 = (6.0, 6.0, 6.0, 1.0, 1.0, 1.0)

MOST_AGENTS = 10

Edges = Sequence[tuple[int, int]]


def _line(n: int) -> Edges:
    return tuple((a, a + 1) for a in range(n - 1))


def _ring(n: int) -> Edges:
    return tuple((a, (a + 1) % n) for a in range(n))


def _complete(n: int) -> Edges:
    return tuple((a, b) for a in range(n) for b in range(a + 1, n))


GRAPHS: dict[str, tuple[int, Edges]] = {
    "line": (3, _line(3)),
    "triangle": (3, ((0, 1), (1, 2), (0, 2))),
    **{f"line{n}": (n, _line(n)) for n in range(4, MOST_AGENTS + 1)},
    **{f"ring{n}": (n, _ring(n)) for n in range(4, MOST_AGENTS + 1)},
    **{f"K{n}": (n, _complete(n)) for n in range(4, MOST_AGENTS + 1)},
}
"""Name -> number of agents and edges."""

FAMILIES = ("line", "ring", "K")


def graph_of(family: str, agents: int) -> str:
    """Name of the graph of a family with 3 to 10 agents; a ring or complete graph of three is the triangle.

    Raises ``ValueError`` for another family or size.
    """
    if family not in FAMILIES or not 3 <= agents <= MOST_AGENTS:
        raise ValueError(f"graph: expected one of {', '.join(FAMILIES)} with 3 to {MOST_AGENTS} agents, "
                         f"found {family!r} with {agents}")  # fmt: skip
    if agents == 3:
        return "line" if family == "line" else "triangle"
    return f"{family}{agents}"


@dataclass(frozen=True, slots=True)
class StudyScenario:
    """One family of runs; `record` draws a run of it."""

    graph: str = "line"
    samples: int = 70
    """T: ticks after the first."""
    period_s: float = 0.1
    start: Start = "good"
    blind: int = 0
    """How many agents, from the last backwards, have no GPS."""
    start_sigma_m: float | None = None
    """Standard deviation per axis of the good start's positions, in place of the root of 6 m2; P0 says the same."""
    start_offset_m: float = 0.0
    """Length of a further error of every position of the good start, each in a direction of its own; P0 knows."""
    turn_every_s: float | None = None
    """How often every vehicle sets out for the next one's reference; absent: each keeps its own."""

    def __post_init__(self) -> None:
        if self.graph not in GRAPHS:
            raise ValueError(f"graph: expected one of {', '.join(GRAPHS)}, found {self.graph!r}")
        if self.start == "paper" and (self.start_sigma_m is not None or self.start_offset_m):
            raise ValueError("start: expected the good start with a spread or an offset, found the paper's")

    def record(self, seed: int, run: int) -> StudyInput:
        """The recording of one run, a function of ``seed`` and ``run`` alone."""
        rng = np.random.default_rng([seed, run])
        n, edges = GRAPHS[self.graph]
        turn = None if self.turn_every_s is None else max(1, round(self.turn_every_s / self.period_s))
        truth, accel = _fly(rng, n, self.samples, self.period_s, turn)
        positions, speeds = truth[:, :, :3], np.linalg.norm(truth[:, :, 3:], axis=-1)
        gps = np.concatenate([positions, speeds[..., None]], axis=-1)
        gps += rng.uniform(-1, 1, gps.shape) * GPS_HALF_WIDTH
        if self.blind:
            gps[:, n - self.blind :] = np.nan
        x0, p0 = self._start(rng, truth[0])
        return StudyInput(
            period_s=self.period_s,
            agents=np.arange(1, n + 1),
            edges=np.array(edges, np.int64),
            accel=accel + rng.uniform(-ACCEL_HALF_WIDTH, ACCEL_HALF_WIDTH, accel.shape),
            gps=gps,
            ranges=noisy_ranges(rng, positions, edges),
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
        if self.start == "paper":
            return np.zeros((n, 6 * n)), np.diag(np.tile(PAPER_P0, n))
        variances = np.tile(GOOD_P0, n)
        positions = np.tile(np.repeat([True, False], 3), n)
        if self.start_sigma_m is not None:
            variances[positions] = self.start_sigma_m**2
        x0 = truth.ravel() + rng.normal(size=(n, 6 * n)) * np.sqrt(variances)
        if self.start_offset_m:
            direction = rng.normal(size=(n, n, 3))
            direction *= self.start_offset_m / np.linalg.norm(direction, axis=-1, keepdims=True)
            x0[:, positions] += direction.reshape(n, -1)
            variances[positions] += self.start_offset_m**2 / 3.0
        return x0, np.diag(variances)


def _fly(
    rng: np.random.Generator, n: int, samples: int, period_s: float, turn_ticks: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True states ``(T+1, n, 6)`` and commanded accelerations ``(T, n, 3)``."""
    gain = lqr_gain(period_s)
    goals = [default_path(slot, n).reference(0.0) for slot in range(n)]
    truth = np.empty((samples + 1, n, 6))
    truth[0] = np.concatenate([rng.uniform(-15, 15, (n, 3)), rng.uniform(-2, 2, (n, 3))], axis=1)
    accel = np.empty((samples, n, 3))
    for k in range(samples):
        if turn_ticks is not None and k and k % turn_ticks == 0:
            goals = goals[1:] + goals[:1]
        accel[k] = command(gain, goals, truth[k, :, :3], truth[k, :, 3:], ACCEL_LIMIT_MPS2)
        truth[k + 1] = predict_mean(truth[k].ravel(), accel[k].ravel(), period_s).reshape(n, 6)
    return truth, accel


def noisy_ranges(rng: np.random.Generator, positions: NDArray[np.float64], edges: Edges) -> NDArray[np.float64]:
    """Ranges ``(T+1, n, n)`` along the edges, both ends with their own noise."""
    ticks, n, _ = positions.shape
    ranges = np.full((ticks, n, n), np.nan)
    for a, b in [pair for edge in edges for pair in (edge, edge[::-1])]:
        distance = np.linalg.norm(positions[:, a] - positions[:, b], axis=-1)
        ranges[:, a, b] = distance + rng.uniform(-RANGE_HALF_WIDTH, RANGE_HALF_WIDTH, ticks)
    return ranges
