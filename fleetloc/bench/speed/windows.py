"""Windows to time solvers on: captured from a fleet that really runs, not drawn at random.

A fleet of drones flies circles, measures as in the studies' scenario (GPS position, speed norm, ranges along
the edges, uniform noises) and runs DMHE-pre-EKF in a closed loop; DEKF-CI runs beside it on the same rows.
After the transient, what one agent held before and received in the consensus round is kept, tick after tick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estimators.consensus.information import Pairs, fuse, weigh
from estimators.estimator import Estimate, Estimator, Payload
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import Matrix, RowTable, Vector, empty_rows
from estimators.model.motion import predict_mean
from estimators.model.row_kernels import IntArray
from estimators.settings import EstimatorSettings
from estimators.window.history import MeasurementWindow
from estimators.window.problem import WindowProblem
from fleetloc.errors import InputError
from sim_bridge.studies.lockstep import neighbours, own_input, own_rows
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import (
    ACCEL_HALF_WIDTH,
    ACCEL_LIMIT_MPS2,
    GOOD_P0,
    GPS_HALF_WIDTH,
    RANGE_HALF_WIDTH,
    noisy_ranges,
)
from sim_bridge.world.guidance import Circle, command, lqr_gain

PERIOD_S = 0.1
TRANSIENT_TICKS = 40
TICKS_BETWEEN_WINDOWS = 3
MEAN_DEGREE = 4.0
"""Of the random geometric graphs, and wanted of the agent whose windows are taken."""

Edges = tuple[tuple[int, int], ...]
Graph = Literal["line", "ring", "random geometric"]


@dataclass(frozen=True, slots=True)
class Size:
    """Number of agents n and horizon N in ticks."""

    agents: int
    window: int

    @property
    def graph(self) -> Graph:
        """Kind of graph that fleets of this size get."""
        return "line" if self.agents == 3 else "ring" if self.agents == 5 else "random geometric"


DEFAULT_SIZES = (Size(3, 2), Size(5, 5), Size(10, 5), Size(20, 5))


def parse_size(text: str) -> Size:
    """``"10x5"``: 10 agents, horizon 5; raises `InputError`."""
    agents, _, window = text.partition("x")
    if not (agents.isdecimal() and window.isdecimal() and int(agents) >= 3 and 1 <= int(window) <= 64):
        expected = "AGENTSxWINDOW with at least 3 agents and 1 to 64 ticks, such as 10x5"
        raise InputError("--sizes", "", expected, repr(text))
    return Size(int(agents), int(window))


@dataclass(frozen=True, slots=True)
class FilterStep:
    """What DEKF-CI holds and receives in the same tick."""

    mean: Vector
    """Filtered mean ``(6n,)`` of the tick before."""
    information: Matrix
    rank: int
    received: Mapping[int, Payload]
    rows: RowTable
    """Of this tick."""
    accel: Vector
    accel_variance: Vector


@dataclass(frozen=True, slots=True)
class BenchWindow:
    """One agent at one tick, just before its consensus round."""

    slot: int
    own: Payload
    received: Mapping[int, Payload]
    ranks: Mapping[int, int]
    rows: RowTable
    start: IntArray
    accel: Matrix
    accel_variance: Matrix
    keep: IntArray
    filter_step: FilterStep

    def fused(self) -> tuple[Matrix, Vector]:
        """The information pair ``(6n, 6n)``, ``(6n,)`` after the consensus round."""
        return fuse(self.own, self.received, "observability_rank", self.ranks)

    def unfused_problem(self) -> tuple[WindowProblem, Pairs]:
        """The window's problem as the agent solves it, with the consensus round still to be done."""
        n = len(self.own.vector)
        pairs = weigh(self.own, self.received, "observability_rank", self.ranks)
        return self.problem((np.empty((n, n)), np.empty(n))), pairs

    def problem(self, pair: tuple[Matrix, Vector]) -> WindowProblem:
        """The window's problem with a fused pair, or with room for one."""
        return WindowProblem(
            rows=self.rows,
            start=self.start,
            accel=self.accel,
            accel_variance=self.accel_variance,
            information=pair[0],
            vector=pair[1],
            keep=self.keep,
            period_s=PERIOD_S,
            with_gains=True,
        )

    def regional_agents(self) -> int:
        """|R|: how many agents the rows name."""
        return len(set(self.rows["agent"].tolist()) | set(self.rows["other"].tolist()) - {-1} | {self.slot})


def capture_windows(size: Size, count: int, seed: int) -> list[BenchWindow]:
    """``count`` windows of the agent whose number of neighbours is nearest to `MEAN_DEGREE`; repeatable."""
    recording = study_recording(size, count, seed)
    adjacent = neighbours(recording)
    slot = min(range(size.agents), key=lambda agent: abs(len(adjacent[agent]) - MEAN_DEGREE))
    wanted = range(TRANSIENT_TICKS, recording.ticks + 1, TICKS_BETWEEN_WINDOWS)
    moving = _ClosedLoop(recording, EstimatorSettings(window=size.window))
    filters = _ClosedLoop(recording, EstimatorSettings(kind="dekf_ci", window=size.window))
    captured = []
    for tick in range(recording.ticks + 1):
        before = filters.estimates[slot], filters.fused[slot]
        moving.advance(tick)
        filters.advance(tick)
        if tick in wanted:
            assert before[0] is not None
            assert before[1] is not None
            captured.append(_capture(moving, filters, slot, before[0].mean, before[1].information))
    return captured


def study_recording(size: Size, count: int, seed: int, graph: Graph | None = None) -> StudyInput:
    """The flight that `capture_windows` takes ``count`` windows from; ``graph`` None: the size's own."""
    rng = np.random.default_rng([seed, size.agents, size.window])
    centers, edges = _fleet(rng, size.agents, size.graph if graph is None else graph)
    return _fly(rng, centers, edges, TRANSIENT_TICKS + TICKS_BETWEEN_WINDOWS * (count - 1))


def _fleet(rng: np.random.Generator, n: int, graph: Graph) -> tuple[Matrix, Edges]:
    """Centres of the circles ``(n, 3)`` NED m, and the edges."""
    if graph != "random geometric":
        centers = rng.uniform(-8.0, 8.0, (n, 3))
        closing = ((n - 1, 0),) if graph == "ring" else ()
        return centers, (*((a, a + 1) for a in range(n - 1)), *closing)
    side = 6.0 * math.sqrt(n)
    while True:
        centers = rng.uniform(-0.5, 0.5, (n, 3)) * (side, side, 8.0)
        distance = np.linalg.norm(centers[:, None, :2] - centers[None, :, :2], axis=-1)
        pairs = [(a, b) for a in range(n) for b in range(a + 1, n)]
        nearest = sorted(pairs, key=lambda pair: distance[pair])[: round(0.5 * MEAN_DEGREE * n)]
        if _connected(n, nearest):
            return centers, tuple(sorted(nearest))


def _connected(n: int, edges: list[tuple[int, int]]) -> bool:
    reached, front = {0}, [0]
    while front:
        agent = front.pop()
        for a, b in edges:
            for here, there in ((a, b), (b, a)):
                if here == agent and there not in reached:
                    reached.add(there)
                    front.append(there)
    return len(reached) == n


def _fly(rng: np.random.Generator, centers: Matrix, edges: Edges, ticks: int) -> StudyInput:
    """Drones on circles about ``centers`` ``(n, 3)`` NED m, with the studies' noises and good start."""
    n = len(centers)
    gain = lqr_gain(PERIOD_S)
    paths = [
        Circle((center[0], center[1], center[2]), radius, lap, phase)
        for center, radius, lap, phase in zip(
            centers.tolist(),
            rng.uniform(2.0, 4.0, n).tolist(),
            rng.uniform(9.0, 14.0, n).tolist(),
            rng.uniform(0.0, 2.0 * math.pi, n).tolist(),
            strict=True,
        )
    ]
    truth, accel = np.empty((ticks + 1, n, 6)), np.empty((ticks, n, 3))
    truth[0] = [(*path.reference(0.0).position_m, *path.reference(0.0).velocity_mps) for path in paths]
    for k in range(ticks):
        goals = [path.reference(k * PERIOD_S) for path in paths]
        accel[k] = command(gain, goals, truth[k, :, :3], truth[k, :, 3:], ACCEL_LIMIT_MPS2)
        truth[k + 1] = predict_mean(truth[k].ravel(), accel[k].ravel(), PERIOD_S).reshape(n, 6)
    gps = np.concatenate([truth[:, :, :3], np.linalg.norm(truth[:, :, 3:], axis=-1, keepdims=True)], axis=-1)
    variances = np.tile(GOOD_P0, n)
    everyone = (ticks + 1, n, n)
    return StudyInput(
        period_s=PERIOD_S,
        agents=np.arange(1, n + 1),
        edges=np.array(edges, np.int64),
        accel=accel + rng.uniform(-ACCEL_HALF_WIDTH, ACCEL_HALF_WIDTH, accel.shape),
        gps=gps + rng.uniform(-1.0, 1.0, gps.shape) * GPS_HALF_WIDTH,
        ranges=noisy_ranges(rng, truth[:, :, :3], edges),
        gps_half_width=np.array(GPS_HALF_WIDTH),
        range_half_width=RANGE_HALF_WIDTH,
        accel_half_width=ACCEL_HALF_WIDTH,
        x0=truth[0].ravel() + rng.normal(size=(n, 6 * n)) * np.sqrt(variances),
        P0=np.diag(variances),
        received=np.ones(everyone, bool),
        delay_ticks=np.zeros(everyone, np.int64),
        truth=truth,
    )


class _ClosedLoop:
    """One estimator per agent over a recording without losses, keeping what the last round exchanged."""

    def __init__(self, recording: StudyInput, settings: EstimatorSettings) -> None:
        self.recording = recording
        self.adjacent = neighbours(recording)
        layout = Layout(tuple(int(agent) for agent in recording.agents))
        self.fleet: list[Estimator] = [
            make_estimator(settings, layout, slot, recording.x0[slot], recording.P0, PERIOD_S)
            for slot in range(layout.size)
        ]
        self.sent: list[Payload] = []
        self.fused: list[Payload | None] = [None] * layout.size
        self.estimates: list[Estimate | None] = [None] * layout.size

    def advance(self, tick: int) -> None:
        """One tick with one consensus round."""
        for slot, estimator in enumerate(self.fleet):
            rows = [own_rows(self.recording, tick, agent) for agent in (slot, *self.adjacent[slot])]
            estimator.begin(
                tick, np.concatenate([empty_rows(), *rows]), own_input(self.recording, tick, slot)
            )
        self.sent = [estimator.outgoing(0) for estimator in self.fleet]
        for slot, estimator in enumerate(self.fleet):
            estimator.mix(0, self.received(slot))
            self.fused[slot] = estimator.outgoing(1)
            self.estimates[slot] = estimator.solve()

    def received(self, slot: int) -> dict[int, Payload]:
        """What an agent got in the last round."""
        return {agent: self.sent[agent] for agent in self.adjacent[slot]}


def _window(estimator: Estimator) -> MeasurementWindow:
    window = getattr(estimator, "window", None)
    assert isinstance(window, MeasurementWindow)
    return window


def _capture(
    moving: _ClosedLoop, filters: _ClosedLoop, slot: int, mean: Vector, information: Matrix
) -> BenchWindow:
    rows, start = _window(moving.fleet[slot]).rows()
    accel, variance = _window(moving.fleet[slot]).inputs()
    filter_rows, filter_start = _window(filters.fleet[slot]).rows()
    filter_accel, filter_variance = _window(filters.fleet[slot]).inputs()
    received = moving.received(slot)
    return BenchWindow(
        slot=slot,
        own=moving.sent[slot],
        received=received,
        ranks={agent: payload.rank for agent, payload in received.items()},
        rows=rows.copy(),
        start=start,
        accel=accel,
        accel_variance=variance,
        keep=np.array([slot], np.int64),
        filter_step=FilterStep(
            mean=mean.copy(),
            information=information.copy(),
            rank=filters.sent[slot].rank,
            received=filters.received(slot),
            rows=filter_rows[filter_start[-2] :].copy(),
            accel=filter_accel[-1],
            accel_variance=filter_variance[-1],
        ),
    )
