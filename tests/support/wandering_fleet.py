"""A fleet whose sensors have slow errors: the world of `estimators.systematic`, with sizes that a test sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import (
    InputTable,
    RowTable,
    empty_inputs,
    height_row,
    input_rows,
    position_rows,
    range_row,
)
from estimators.model.measurements import velocity_rows as velocity_rows_of
from estimators.systematic.slow_errors import ACCELERATION_S, PAIR_S, WANDER_S
from tests.support import builders
from tests.support import dense_reference as dense

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class World:
    """Sizes of errors, m and m/s: standard deviations."""

    agents: int = 3
    period_s: float = 0.1
    claim_m: float = 0.4
    """What receivers claim of their fixes, per axis."""
    white: float = 1.0
    """White noise of the fixes, of the claim."""
    wander_m: float = 0.0
    """Wander, each horizontal axis; the vertical one is 1.5 times that."""
    common_share: float = 0.5
    """Of the wander's variance, what all receivers share."""
    accel_mps2: float = 0.0
    """Slow error of accelerations."""
    pair_m: float = 0.0
    """Bias of ranges."""
    drift_m: float | None = None
    """What barometers are off by at first, and how far they drift in an hour; absent = there are none."""
    scale: float = 0.0
    """Of their heights, per metre."""
    baro_m: float = 0.2
    """Their white noise."""
    accel_noise_mps2: float = 0.3
    velocity_mps: float = 0.1
    range_m: float = 0.1


@dataclass(frozen=True, slots=True)
class WanderingFlight:
    """Truth ``(T+1, 6n)``, the rows of each tick, the inputs of the tick that ends there, and accelerations."""

    truth: Array
    rows: list[RowTable]
    inputs: list[InputTable]
    accel: Array
    accel_variance: Array


def gauss_markov(rng: np.random.Generator, ticks: int, shape: tuple[int, ...], keep: float) -> Array:
    """A stationary process ``(ticks, *shape)`` of unit variance."""
    out = np.empty((ticks, *shape))
    out[0] = rng.normal(size=shape)
    for k in range(1, ticks):
        out[k] = keep * out[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(size=shape)
    return out


def fly(world: World, ticks: int, rng: np.random.Generator) -> WanderingFlight:
    """A flight within some 30 m, everybody seen by everybody."""
    n, dt = world.agents, world.period_s
    phase, rate = rng.uniform(0, 2 * np.pi, 3 * n), rng.uniform(0.2, 0.5, 3 * n)
    times = dt * np.arange(ticks)
    accel = 1.5 * rate**2 * 8.0 * np.sin(rate * times[:, None] + phase)
    truth = [np.concatenate([rng.uniform(-15, 15, (n, 3)), np.zeros((n, 3))], axis=1).ravel()]
    truth[0].reshape(n, 2, 3)[:, 1] = (-1.5 * rate * 8.0 * np.cos(phase)).reshape(n, 3)
    for k in range(ticks):
        truth.append(dense.transition(n, dt) @ truth[-1] + dense.inputs(n, dt) @ accel[k])
    states = np.array(truth).reshape(ticks + 1, n, 2, 3)
    axes = world.wander_m * np.array([1.0, 1.0, 1.5])
    keep = np.exp(-dt / WANDER_S)
    own = np.sqrt(1.0 - world.common_share) * axes * gauss_markov(rng, ticks + 1, (n, 3), keep)
    shared = np.sqrt(world.common_share) * axes * gauss_markov(rng, ticks + 1, (1, 3), keep)
    push = world.accel_mps2 * gauss_markov(rng, ticks + 1, (n, 3), np.exp(-dt / ACCELERATION_S))
    bias = world.pair_m * gauss_markov(rng, ticks + 1, (n, n), np.exp(-dt / PAIR_S))
    claim, speed, length = world.claim_m**2, world.velocity_mps**2, world.range_m**2
    rows, inputs = [], []
    height = None if world.drift_m is None else _barometers(world, states[:, :, 0, 2], rng.spawn(1)[0])
    said = accel.reshape(ticks, n, 3) + push[:-1] + world.accel_noise_mps2 * rng.normal(size=(ticks, n, 3))
    for k in range(ticks + 1):
        tables = []
        for a in range(n):
            fix = states[k, a, 0] + own[k, a] + shared[k, 0] + world.white * world.claim_m * rng.normal(size=3)
            tables.append(position_rows(k, a, fix, np.full(3, claim)))
            measured = states[k, a, 1] + world.velocity_mps * rng.normal(size=3)
            tables.append(velocity_rows_of(k, a, measured, np.full(3, speed)))
            if height is not None:
                tables.append(height_row(k, a, float(height[k, a]), world.baro_m**2, drifts=True))
            for b in range(n):
                if a < b:
                    away = float(np.linalg.norm(states[k, a, 0] - states[k, b, 0]))
                    value = away + bias[k, a, b] + world.range_m * rng.normal()
                    tables.append(range_row(k, a, b, value, length))
        rows.append(builders.joined(tables))
        variance = world.accel_noise_mps2**2
        inputs.append(
            empty_inputs() if k == 0
            else np.concatenate([input_rows(k - 1, a, said[k - 1, a], variance) for a in range(n)])
        )  # fmt: skip
    return WanderingFlight(
        np.array(truth), rows, inputs, said.reshape(ticks, 3 * n), np.full((ticks, 3 * n), world.accel_noise_mps2**2)
    )


def _barometers(world: World, down_m: Array, rng: np.random.Generator) -> Array:
    """What the barometers say ``(T+1, n)``, at true heights NED."""
    assert world.drift_m is not None
    ticks, n = down_m.shape
    step_m = world.drift_m * np.sqrt(world.period_s / 3600.0)
    drift = world.drift_m * rng.normal(size=n) + np.cumsum(step_m * rng.normal(size=(ticks, n)), axis=0)
    scale = 1.0 + world.scale * rng.normal(size=n)
    return np.asarray(scale * down_m + drift + world.baro_m * rng.normal(size=(ticks, n)))
