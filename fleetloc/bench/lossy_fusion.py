"""``fleetloc bench fusion``: Fu, Bi and Gao's estimators over a channel that holds and delays, by Monte Carlo.

Two agents measure a target, the leader always on time, the follower on time, late or not at all with
probabilities 0.4, 0.3, 0.3. The expected figures are those of an independent implementation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.algorithms.lossy_fusion import (
    AXES,
    STATES,
    CentralFilter,
    LeaderFusion,
    LocalFilter,
    Rule,
    SentEstimate,
    StampedFilter,
    TargetModel,
    update,
)

Floats = NDArray[np.float64]
ON_TIME, LATE = np.array([1.0, 0.4]), np.array([0.0, 0.3])
START = np.array([100.0, 100.0, 100.0, 10.0, 10.0, 0.0])
START_COVARIANCE = np.diag([100.0, 100.0, 100.0, 5.0, 5.0, 5.0])
STEPS, STEADY_FROM = 100, 20
POSITION_VARIANCE_M2 = 10.0


@dataclass(frozen=True)
class Setting:
    """What moves and what the filters believe; variances in (m/s2)^2. ``expected``: method to (MSE, s.e.) in m2."""

    name: str
    truth_variance: float
    filter_variance: float
    runs: int
    expected: dict[str, tuple[float, float]]


SETTINGS = (
    Setting("manoeuvring", 5.0, 5.0, 300, {
        "central": (20.484, 0.133), "central_conditional": (18.265, 0.125),
        "kalman_as_if_on_time": (358.324, 15.549), "leader_only": (20.740, 0.135),
        "no_loss": (11.231, 0.072), "stamped_on_time_only": (16.522, 0.115),
        "stamped": (16.018, 0.112), "age_trace_feedback": (20.296, 0.174),
        "age_trace": (16.895, 0.131), "age_safe_feedback": (17.965, 0.137),
        "age_intersection_grid_feedback": (18.836, 0.118), "hold_trace_feedback": (439.677, 18.881),
    }),
    Setting("straight", 0.0, 5.0, 200, {
        "central": (17.725, 0.142), "central_conditional": (15.417, 0.126),
        "kalman_as_if_on_time": (84.078, 2.084), "leader_only": (18.117, 0.145),
        "no_loss": (9.964, 0.081), "stamped_on_time_only": (14.318, 0.125),
        "stamped": (13.732, 0.117), "age_trace_feedback": (11.157, 0.103),
        "age_trace": (11.534, 0.101), "age_safe_feedback": (12.720, 0.106),
        "age_intersection_grid_feedback": (16.135, 0.124), "hold_trace_feedback": (96.294, 2.487),
    }),
    Setting("calm", 0.05, 0.05, 200, {
        "central": (8.317, 0.111), "central_conditional": (7.731, 0.107),
        "kalman_as_if_on_time": (65.570, 1.905), "leader_only": (9.477, 0.129),
        "no_loss": (5.414, 0.066), "stamped_on_time_only": (7.334, 0.101),
        "stamped": (6.880, 0.092), "age_trace_feedback": (10.974, 0.185),
        "age_trace": (6.685, 0.095), "age_safe_feedback": (8.324, 0.110),
        "age_intersection_grid_feedback": (8.408, 0.101), "hold_trace_feedback": (117.024, 3.525),
    }),
)  # fmt: skip


@dataclass(frozen=True)
class TargetFlight:
    """One run: truth ``(T, 6)``, positions measured ``(T, 2, 3)``, the channel's outcomes ``(T, 2)`` and what
    it delivers ``(T, 2, 3)``."""

    truth: Floats
    measured: Floats
    outcome: NDArray[np.int64]
    received: Floats


def fly(setting: Setting, rng: np.random.Generator) -> TargetFlight:
    """Draw one run. The truth begins at `START` (the filters know it only to `START_COVARIANCE`), and what the
    channel holds before the first packet is its position."""
    model = TargetModel(1.0, setting.truth_variance, POSITION_VARIANCE_M2)
    gain = np.vstack([0.5 * np.eye(AXES), np.eye(AXES)])
    state = START
    truth = np.empty((STEPS, STATES))
    for k in range(STEPS):
        truth[k] = state
        state = model.transition @ state + gain @ rng.normal(0.0, np.sqrt(setting.truth_variance), AXES)
    noise = rng.normal(0.0, np.sqrt(POSITION_VARIANCE_M2), (STEPS, 2, AXES))
    measured = truth[:, None, :AXES] + noise
    draws = rng.random((STEPS, 2))
    outcome = np.where(draws < ON_TIME, 1, np.where(draws < ON_TIME + LATE, 2, 0))
    received = np.empty_like(measured)
    before, held = np.tile(START[:AXES], (2, 1)), np.tile(START[:AXES], (2, 1))
    for k in range(STEPS):
        choices = {0: held, 1: measured[k], 2: before}
        received[k] = [choices[int(outcome[k, agent])][agent] for agent in range(2)]
        before, held = measured[k], received[k]
    return TargetFlight(truth, measured, outcome, received)


Estimates = Iterator[tuple[Floats, Floats]]
Method = Callable[[TargetModel, TargetFlight], Estimates]


def _central(conditional: bool) -> Method:
    def run(model: TargetModel, flight: TargetFlight) -> Estimates:
        central = CentralFilter(model, ON_TIME, LATE, START, START_COVARIANCE, conditional=conditional)
        return (central.step(received) for received in flight.received)

    return run


def _kalman(model: TargetModel, measured: Floats) -> Estimates:
    """The Kalman filter of positions of any number of agents ``(T, L, 3)``, all taken as of their step."""
    mean, covariance = START, START_COVARIANCE
    rows = np.tile(model.measured, (measured.shape[1], 1))
    noise = POSITION_VARIANCE_M2 * np.eye(len(rows))
    for k, positions in enumerate(measured):
        if k > 0:
            mean, covariance = model.predict(mean, covariance)
        mean, covariance = update(mean, covariance, positions.ravel() - rows @ mean, rows, noise)
        yield mean, covariance


def _stamped(use_late: bool) -> Method:
    def run(model: TargetModel, flight: TargetFlight) -> Estimates:
        stamped = StampedFilter(model, 2, START, START_COVARIANCE, use_late=use_late)
        before = np.concatenate([flight.measured[:1], flight.measured[:-1]])
        steps = zip(flight.measured, before, flight.outcome, strict=True)
        return (stamped.step(now, then, kinds.tolist()) for now, then, kinds in steps)

    return run


def _distributed(rule: Rule, *, feedback: bool, compensate: bool = True) -> Method:
    def run(model: TargetModel, flight: TargetFlight) -> Estimates:
        leader = LeaderFusion(model, START, START_COVARIANCE, rule, feedback=feedback)
        follower = LocalFilter(model, START, START_COVARIANCE)
        sent: list[SentEstimate] = []
        held = SentEstimate(0, START, START_COVARIANCE)
        for k, (now, kinds) in enumerate(zip(flight.measured, flight.outcome, strict=True)):
            sent.append(SentEstimate(k, *follower.step(now[1])))
            packet = {1: sent[k], 2: sent[k - 1] if k else None, 0: None}[int(kinds[1])]
            if not compensate:  # what is held is taken for the present
                held = packet or held
                packet = SentEstimate(k, held.mean, held.covariance)
            yield leader.step(now[0], packet)

    return run


METHODS: dict[str, Method] = {
    "no_loss": lambda model, flight: _kalman(model, flight.measured),
    "stamped": _stamped(use_late=True),
    "stamped_on_time_only": _stamped(use_late=False),
    "central_conditional": _central(conditional=True),
    "central": _central(conditional=False),
    "leader_only": lambda model, flight: _kalman(model, flight.measured[:, :1]),
    "kalman_as_if_on_time": lambda model, flight: _kalman(model, flight.received),
    "age_trace": _distributed(Rule.TRACE, feedback=False),
    "age_trace_feedback": _distributed(Rule.TRACE, feedback=True),
    "age_safe_feedback": _distributed(Rule.SAFE, feedback=True),
    "age_intersection_feedback": _distributed(Rule.INTERSECTION, feedback=True),
    "age_intersection_grid_feedback": _distributed(Rule.INTERSECTION_GRID, feedback=True),
    "hold_trace_feedback": _distributed(Rule.TRACE, feedback=True, compensate=False),
}


@dataclass(frozen=True)
class Figures:
    """Of one method over the runs, steps from `STEADY_FROM` on: mean squared position error and its s.e. in m2,
    trace of the position covariance in m2, NEES over 6."""

    mse_m2: float
    mse_se_m2: float
    trace_m2: float
    nees_per_state: float


def study(setting: Setting, runs: int, seed: int, on_run: Callable[[], None]) -> dict[str, Figures]:
    """All methods on the same runs."""
    model = TargetModel(1.0, setting.filter_variance, POSITION_VARIANCE_M2)
    sums = {name: np.empty((runs, 3)) for name in METHODS}
    for run in range(runs):
        flight = fly(setting, np.random.default_rng([seed, SETTINGS.index(setting), run]))
        for name, method in METHODS.items():
            sums[name][run] = _score(flight.truth, method(model, flight))
        on_run()
    return {name: _figures(values) for name, values in sums.items()}


def _score(truth: Floats, estimates: Estimates) -> tuple[float, float, float]:
    squared, traces, nees = [], [], []
    for k, (mean, covariance) in enumerate(estimates):
        if k >= STEADY_FROM:
            error = mean - truth[k]
            squared.append(error[:AXES] @ error[:AXES])
            traces.append(np.trace(covariance[:AXES, :AXES]))
            nees.append(error @ np.linalg.solve(covariance, error) / STATES)
    return float(np.mean(squared)), float(np.mean(traces)), float(np.mean(nees))


def _figures(values: Floats) -> Figures:
    error = values[:, 0].std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    mse, trace, nees = values.mean(axis=0)
    return Figures(float(mse), float(error), float(trace), float(nees))
