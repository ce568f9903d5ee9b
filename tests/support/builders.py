"""Windows, rows and recordings for tests, drawn from a generator that the test passes in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Estimate, Estimator
from estimators.model.layout import Layout
from estimators.model.measurements import (
    InputTable,
    Kind,
    RowTable,
    anchor_range_row,
    empty_inputs,
    empty_rows,
    height_row,
    input_rows,
    position_rows,
    range_row,
    relative_rows,
    speed_row,
    velocity_rows,
)
from estimators.window.history import MeasurementWindow
from estimators.window.problem import WindowProblem
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import StudyScenario
from tests.support import dense_reference as dense

Array = NDArray[np.float64]
ALL_KINDS = tuple(Kind)
LINEAR_KINDS = (Kind.POSITION, Kind.VELOCITY)


def joined(tables: Sequence[RowTable]) -> RowTable:
    """One table of several, which may be none."""
    return np.concatenate(tables) if len(tables) else empty_rows()


def random_covariance(rng: np.random.Generator, order: int, scale: float = 1.0) -> Array:
    """A positive definite matrix with correlations, eigenvalues within about 0.3 to 3 times ``scale``."""
    axes = np.linalg.qr(rng.normal(size=(order, order)))[0]
    return np.asarray((axes * (scale * np.exp(rng.uniform(-1, 1, order)))) @ axes.T)


def fly(rng: np.random.Generator, agents: int, ticks: int, dt: float) -> tuple[Array, Array]:
    """True fleet states ``(ticks+1, 6n)`` in a cube of 30 m and accelerations ``(ticks, 3n)`` within 2 m/s2."""
    x = np.concatenate([rng.uniform(-15, 15, (agents, 3)), rng.uniform(-2, 2, (agents, 3))], axis=1).ravel()
    accel = rng.uniform(-2, 2, (ticks, 3 * agents))
    states = [x]
    for k in range(ticks):
        states.append(dense.transition(agents, dt) @ states[-1] + dense.inputs(agents, dt) @ accel[k])
    return np.array(states), accel


def row_of(
    kind: Kind, rng: np.random.Generator, tick: int, agent: int, agents: int, offset_s: float = 0.0
) -> RowTable:
    """One sensor reading without a value; a RANGE or RELATIVE is of another agent too, so it needs two."""
    direction = rng.normal(size=3)
    variance = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.1))))
    if kind is Kind.POSITION:
        return position_rows(tick, agent, np.zeros(3), random_covariance(rng, 3, variance), offset_s=offset_s)
    if kind in (Kind.VELOCITY, Kind.ODOMETRY):
        covariance = random_covariance(rng, 3, variance)
        return velocity_rows(tick, agent, np.zeros(3), covariance, offset_s=offset_s, kind=kind)
    if kind is Kind.SPEED:
        return speed_row(tick, agent, 0.0, variance, offset_s=offset_s)
    if kind is Kind.ANCHOR_RANGE:
        return anchor_range_row(tick, agent, 20.0 * direction, 0.0, variance, offset_s=offset_s)
    if kind is Kind.HEIGHT:
        return height_row(tick, agent, 0.0, variance, offset_s=offset_s, drifts=bool(rng.random() < 0.7))
    other = int((agent + rng.integers(1, agents)) % agents)
    if kind is Kind.RELATIVE:
        return relative_rows(tick, agent, other, direction, variance, 4.0 * variance, offset_s=offset_s)
    return range_row(tick, agent, other, 0.0, variance, offset_s=offset_s)


def measured(rows: RowTable, states: Array, eps: float, rng: np.random.Generator | None) -> RowTable:
    """Rows with the values that their ticks' states give, with Gaussian noise if there is a generator."""
    out = rows.copy()
    for row in out:
        row["value"] = dense.predicted_row(row, states[row["tick"]], eps)
    if rng is not None:
        out["value"] += rng.normal(size=len(out)) * np.sqrt(out["variance"])
    return out


def random_window(
    rng: np.random.Generator,
    *,
    agents: int = 3,
    ticks: int = 2,
    kinds: Sequence[Kind] = ALL_KINDS,
    region: Sequence[int] | None = None,
    rows_per_agent: int = 2,
    with_gains: bool = True,
    with_offsets: bool = True,
    dt: float = 0.1,
    eps: float = 1e-3,
    prior_scale: float = 0.2,
) -> tuple[WindowProblem, Array]:
    """A window near the truth, and the truth ``(N+1, 6n)``. Rows are on the agents of ``region`` only.

    The prior is correlated between all agents, and its mean is drawn from it.
    """
    states, accel = fly(rng, agents, ticks, dt)
    measured_agents = list(range(agents)) if region is None else list(region)
    layout = Layout(tuple(range(1, agents + 1)))
    window = MeasurementWindow(layout, ticks, other_accel_variance=4 / 3)
    window.advance(ticks)
    for tick in range(ticks + 1):
        for agent in measured_agents:
            for _ in range(rows_per_agent):
                kind = kinds[rng.integers(len(kinds))]
                offset = float(rng.uniform(-dt / 2, dt / 2)) if with_offsets else 0.0
                row = row_of(kind, rng, tick, agent, agents, offset)
                if kind in (Kind.RANGE, Kind.RELATIVE):
                    choice = [other for other in measured_agents if other != agent]
                    row["other"] = choice[rng.integers(len(choice))]
                window.insert(measured(row, states, eps, rng), empty_inputs())
    rows, start = window.rows()
    covariance = random_covariance(rng, 6 * agents, prior_scale)
    information = np.linalg.inv(covariance)
    information = 0.5 * (information + information.T)
    mean = states[0] + np.linalg.cholesky(covariance) @ rng.normal(size=6 * agents)
    problem = WindowProblem(
        rows=rows,
        start=start,
        accel=accel + 0.05 * rng.normal(size=accel.shape),
        accel_variance=np.exp(rng.uniform(np.log(1e-3), np.log(2.0), accel.shape)),
        information=information,
        vector=information @ mean,
        keep=np.array([measured_agents[0]], np.int64),
        period_s=dt,
        with_gains=with_gains,
    )
    return problem, states


def noiseless(recording: StudyInput) -> StudyInput:
    """The same flight, measured exactly, with the true start at every agent; needs the truth.

    Half widths (and so the assumed variances) stay as they are. Ranges and speeds are the smoothed norms of
    eps = 1e-3, which is what the estimators take them for.
    """
    assert recording.truth is not None
    truth = recording.truth
    n = truth.shape[1]
    dt = recording.period_s
    accel = (truth[1:, :, 3:] - truth[:-1, :, 3:]) / dt
    speed = np.sqrt(np.sum(truth[..., 3:] ** 2, axis=-1) + 1e-6)
    gps = np.concatenate([truth[..., :3], speed[..., None]], axis=-1)
    gps = np.where(np.isnan(recording.gps), np.nan, gps)
    away = truth[:, :, None, :3] - truth[:, None, :, :3]
    ranges = np.where(np.isnan(recording.ranges), np.nan, np.sqrt(np.sum(away**2, axis=-1) + 1e-6))
    x0 = np.tile(truth[0].ravel(), (n, 1))
    return replace(recording, accel=accel, gps=gps, ranges=ranges, x0=x0)


def recording_arrays(recording: StudyInput | None = None) -> dict[str, Any]:
    """The arrays of a (small) recording, to be spoiled by a test."""
    made = StudyScenario(samples=4).record(1, 0) if recording is None else recording
    names = made.__dataclass_fields__
    return {name: getattr(made, name) for name in names if getattr(made, name) is not None}


def run_alone(
    estimator: Estimator,
    rows_at: Callable[[int], RowTable],
    input_at: Callable[[int], InputTable],
    ticks: int,
) -> list[Estimate]:
    """An estimator without neighbours over ticks 0..ticks."""
    estimates = []
    for tick in range(ticks + 1):
        estimator.begin(tick, rows_at(tick), input_at(tick))
        for round_ in range(estimator.rounds):
            estimator.outgoing(round_)
            estimator.mix(round_, {})
        estimates.append(estimator.solve())
    return estimates


def all_inputs(tick: int, accel: Array, variance: float) -> InputTable:
    """The accelerations ``(T, 3n)`` of all agents over the tick that ends at ``tick``."""
    if tick == 0:
        return empty_inputs()
    pushes = accel[tick - 1].reshape(-1, 3)
    return np.concatenate([input_rows(tick - 1, s, push, variance) for s, push in enumerate(pushes)])
