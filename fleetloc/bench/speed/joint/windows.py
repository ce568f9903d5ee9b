"""Windows as the default estimator holds them, in the form that a solver of optimal control problems takes.

The variables are the first state and the accelerations; what the estimator believes of the first state after the
consensus rounds is the prior. All measurements of a tick have fixed places: position and velocity of every drone
along the NED axes, then the ranges of all directed edges. Where there is none its precision is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimators.model.layout import STATES_PER_AGENT, Layout
from estimators.model.measurements import Kind, Matrix, RowTable, Vector, is_shifted
from estimators.model.motion import predict_mean
from estimators.settings import EstimatorSettings
from estimators.window.assembly import open_window, window_problem
from estimators.window.problem import WindowProblem
from fleetloc.bench.speed.fleet.flight import DroneTick, FleetFlight, estimator_of

Edges = Sequence[tuple[int, int]]


def capture_joint_windows(
    flight: FleetFlight, settings: EstimatorSettings, given: Sequence[DroneTick], ticks: Sequence[int]
) -> list[WindowProblem]:
    """The timed drone's windows at some ticks, after their consensus rounds; ``settings`` of a kind with a window."""
    layout = Layout(tuple(int(agent) for agent in flight.recording.agents))
    period_s = flight.recording.period_s
    estimator, window = estimator_of(flight, settings, flight.slot), open_window(settings, layout, period_s)
    found = []
    for tick, drone in enumerate(given):
        window.open(tick)
        window.insert(drone.rows, drone.inputs)
        estimator.begin(tick, drone.rows, drone.inputs)
        for round_, received in enumerate(drone.received):
            estimator.mix(round_, received)
        if tick in ticks:
            prior = estimator.outgoing(estimator.rounds)
            assert prior.tick == window.first
            pair = prior.information.copy(), prior.vector.copy()
            found.append(window_problem(window, pair, flight.slot, period_s, False))
        estimator.solve()
    return found


@dataclass(frozen=True, slots=True)
class StagedWindow:
    """A window in stages, measurements in their fixed places.

    ``value`` and ``precision`` ``(N+1, m)``, ``accel`` and ``accel_precision`` ``(N, 3n)``, prior ``mean`` ``(6n,)``
    and ``information`` ``(6n, 6n)``, ``start`` ``(N+1, 6n)``: the prior's mean rolled out. NED m, m/s, m/s2.
    """

    value: Matrix
    precision: Matrix
    accel: Matrix
    accel_precision: Matrix
    mean: Vector
    information: Matrix
    start: Matrix


def staged(problem: WindowProblem, edges: Edges) -> StagedWindow:
    """A window's problem in stages; raises ``ValueError`` for rows that have no place there."""
    dimension, ticks = len(problem.vector), len(problem.accel)
    value, precision = np.zeros((2, ticks + 1, dimension + len(edges)))
    for k, (first, end) in enumerate(pairwise(problem.start)):
        where = _places(problem.rows[first:end], dimension, edges)
        if len(set(where.tolist())) != len(where):
            raise ValueError("a window has two measurements of one thing in one tick")
        value[k, where] = problem.rows["value"][first:end]
        precision[k, where] = 1.0 / problem.rows["variance"][first:end]
    mean = np.asarray(np.linalg.solve(problem.information, problem.vector), np.float64)
    start = np.empty((ticks + 1, dimension))
    start[0] = mean
    for k in range(ticks):
        start[k + 1] = predict_mean(start[k], problem.accel[k], problem.period_s)
    return StagedWindow(
        value, precision, problem.accel, 1.0 / problem.accel_variance, mean, problem.information, start
    )


def _places(rows: RowTable, dimension: int, edges: Edges) -> NDArray[np.int64]:
    """Where each row stands in its stage."""
    if rows["offset_s"].any() or is_shifted(rows):
        raise ValueError("staged windows: expected rows at the tick's instant, without lever arms")
    place = {edge: dimension + index for index, edge in enumerate(edges)}
    found = []
    for row in rows:
        if row["kind"] == Kind.RANGE:
            found.append(place[int(row["agent"]), int(row["other"])])
            continue
        axis = np.flatnonzero([row["x"], row["y"], row["z"]])
        if row["kind"] not in (Kind.POSITION, Kind.VELOCITY) or len(axis) != 1:
            raise ValueError("staged windows: expected positions and velocities along the NED axes, and ranges")
        found.append(STATES_PER_AGENT * row["agent"] + 3 * (row["kind"] == Kind.VELOCITY) + int(axis[0]))
    return np.array(found, np.int64)
