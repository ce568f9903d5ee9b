"""Flights of four whose last drone loses its GPS and passes the plane of its three neighbours.

In the plane the ranges do not tell on which side the drone goes on: its place and its mirror image fit them equally
well, until the neighbours' own motion or the drone's accelerations tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Status
from estimators.model.layout import position
from estimators.model.motion import predict_mean
from sim_bridge.studies.lockstep import LockstepResult
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_scenario import GPS_HALF_WIDTH, RANGE_HALF_WIDTH, noisy_ranges

PERIOD_S = 0.1
BLIND = 3
"""Slot of the drone without GPS."""
FIXED_TICKS = 20
"""Ticks in which it has fixes."""
CIRCLE_M = 10.0
"""Radius of the circle about which the neighbours stand."""
SWAY_MPS2 = 0.3
"""Standard deviation of the vehicles' accelerations about their paths."""
EDGES = tuple((a, b) for a in range(4) for b in range(a + 1, 4))

Array = NDArray[np.float64]


def crossing(seed: int, ticks: int = 160, accel_half_width: float = 0.3) -> StudyInput:
    """A flight, a function of the arguments alone.

    It comes from 2 to 6 m off the plane, stays at it for up to 4 s and goes on to either side.
    """
    rng = np.random.default_rng([seed, 4])
    truth, accel = _fly(rng, ticks)
    positions, speeds = truth[:, :, :3], np.linalg.norm(truth[:, :, 3:], axis=-1)
    gps = np.concatenate([positions, speeds[..., None]], axis=-1)
    gps += rng.uniform(-1, 1, gps.shape) * GPS_HALF_WIDTH
    gps[FIXED_TICKS:, BLIND] = np.nan
    variances = np.tile([1.0] * 3 + [0.25] * 3, 4)
    return StudyInput(
        period_s=PERIOD_S,
        agents=np.arange(1, 5),
        edges=np.array(EDGES, np.int64),
        accel=accel + rng.uniform(-accel_half_width, accel_half_width, accel.shape),
        gps=gps,
        ranges=noisy_ranges(rng, positions, EDGES),
        gps_half_width=np.array(GPS_HALF_WIDTH),
        range_half_width=RANGE_HALF_WIDTH,
        accel_half_width=accel_half_width,
        x0=truth[0].ravel() + rng.normal(size=(4, 24)) * np.sqrt(variances),
        P0=np.diag(variances),
        received=np.ones((ticks + 1, 4, 4), bool),
        delay_ticks=np.zeros((ticks + 1, 4, 4), np.int64),
        truth=truth,
    )


@dataclass(frozen=True, slots=True)
class Passed:
    """What was believed of the blind drone since a second after its last fix."""

    sure_and_wrong: int
    """Ticks in which it is not flagged and its own error is above five sigmas (root of the traces)."""
    wrong_elsewhere: int
    """Ticks in which another drone's estimate of it is beyond five sigmas, summed over the three."""
    flagged: float
    """Share of the ticks in which it is not observable."""
    normalised: Array
    """``(4,)`` mean over the ticks of the square error over the square that each drone claims of it."""
    overstated: float
    """Mean square that its own estimate claims over its mean square error: a doubt held in vain makes it large."""


def passed(recording: StudyInput, result: LockstepResult, since: int = FIXED_TICKS + 10) -> Passed:
    """Judge a flight from the tick ``since`` on."""
    assert recording.truth is not None
    away = result.mean[since:, :, position(BLIND)] - recording.truth[since:, None, BLIND, :3]
    error = np.linalg.norm(away, axis=-1)
    sigma = np.sqrt(result.cov_diag[since:, :, position(BLIND)].sum(axis=-1))
    flagged = result.status[since:, BLIND] == Status.NOT_OBSERVABLE
    wrong = error > 5.0 * sigma
    return Passed(
        int((wrong[:, BLIND] & ~flagged).sum()),
        int(wrong[:, :BLIND].sum()),
        float(flagged.mean()),
        np.asarray((error**2 / sigma**2).mean(axis=0), np.float64),
        float((sigma[:, BLIND] ** 2).mean() / (error[:, BLIND] ** 2).mean()),
    )


def heights_m(recording: StudyInput) -> Array:
    """``(T+1,)``: of the blind drone over its neighbours' plane."""
    assert recording.truth is not None
    first, second, third, blind = recording.truth[:, :, :3].swapaxes(0, 1)
    normal = np.cross(second - first, third - first)
    return np.asarray(((blind - first) * normal).sum(-1) / np.linalg.norm(normal, axis=-1), np.float64)


def _fly(rng: np.random.Generator, ticks: int) -> tuple[Array, Array]:
    """True states ``(T+1, 4, 6)`` and accelerations ``(T, 4, 3)``."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi / 3 * np.arange(3) + rng.uniform(-0.5, 0.5, 3)
    corners = CIRCLE_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=-1)
    start = np.array([*rng.uniform(-6, 6, 2), rng.uniform(2, 6)])
    goal = np.array([*rng.uniform(-6, 6, 2), rng.choice([-1, 1]) * rng.uniform(3, 7)])
    arrive = ticks * rng.uniform(0.3, 0.45)
    leave = arrive + rng.uniform(0, 40)
    truth, accel = np.empty((ticks + 1, 4, 6)), np.empty((ticks, 4, 3))
    truth[0] = np.concatenate([np.vstack([corners, start]) @ turn.T, np.zeros((4, 3))], axis=1)
    for k in range(ticks):
        aim = start * max(1 - k / arrive, 0.0) + goal * np.clip((k - leave) / 40, 0.0, 1.0)
        at = np.vstack([corners, aim]) @ turn.T
        push = 1.0 * (at - truth[k, :, :3]) - 1.4 * truth[k, :, 3:] + rng.normal(size=(4, 3)) * SWAY_MPS2
        accel[k] = np.clip(push, -2.0, 2.0)
        truth[k + 1] = predict_mean(truth[k].ravel(), accel[k].ravel(), PERIOD_S).reshape(4, 6)
    return truth, accel
