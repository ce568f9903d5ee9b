"""The scenario of the studies of situational awareness: nine drones on a sparse graph, and a target on the ground.

Bassolillo, D'Amato and Notaro 2025, with noises and paths of our own, since the paper's are lost: a fix of 1 m and
0.1 m/s, ranges of 0.1 m between drones within sight, ranges of 1 m with a bias of 0.3 m to the target, a tick of 1 s.
Drone 1 hovers in tests 1 and 2; the others fly at 2 m/s, straight at first, then in S-turns and climbs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Graph = Literal["cycle", "ladder", "chain"]

DRONES = 9
TARGET_ID = 101
_CYCLE = ((1, 2), (2, 4), (4, 6), (6, 8), (8, 9), (9, 7), (7, 5), (5, 3), (3, 1))
EDGES: dict[Graph, tuple[tuple[int, int], ...]] = {
    "cycle": _CYCLE,
    "ladder": (*_CYCLE, (2, 3), (4, 5), (6, 7)),
    "chain": tuple(edge for edge in _CYCLE if edge != (3, 1)),
}
FAILING = ((4, 6), (5, 7))
"""Links that fail in test 2: the cycle falls apart into two."""

PERIOD_S = 1.0
GPS_SIGMA_M, SPEED_SIGMA_MPS = 1.0, 0.1
RANGE_SIGMA_M, SIGHT_M = 0.1, 80.0
TARGET_SIGMA_M, TARGET_BIAS_M = 1.0, 0.3
ACCEL_SIGMA_MPS2 = 0.02
STRAIGHT_S = 26.0
"""The fleet flies straight for so long."""


@dataclass(frozen=True, slots=True)
class AwarenessScenario:
    """One of the four tests.

    ``target``: position and velocity at the start, NED m and m/s, of the target; absent: none. ``outages`` are spans
    in s in which the `FAILING` links are down. ``hover``: whether drone 1 stays where it is.
    """

    graph: Graph = "cycle"
    duration_s: float = 120.0
    speed_mps: float = 2.0
    hover: bool = True
    spacing_m: tuple[float, float] = (20.0, 15.0)
    """Of the rows, and half of that of the columns."""
    target: tuple[float, float, float, float, float, float] | None = None
    outages: tuple[tuple[float, float], ...] = ()

    @property
    def ticks(self) -> int:
        """Ticks after the first."""
        return round(self.duration_s / PERIOD_S)


@dataclass(frozen=True, slots=True)
class AwarenessInput:
    """What the bodies of a scenario do and measure; T ticks after the first, n drones, B bodies (the target last).

    ``truth`` ``(T+1, B, 6)`` NED m and m/s; ``accel`` ``(T, n, 3)`` measured, over (k, k+1); ``gps`` ``(T+1, n, 6)``;
    ``ranges`` ``(T+1, n, B)`` measured by the row's drone, NaN where out of sight.
    """

    scenario: AwarenessScenario
    truth: Floats
    accel: Floats
    gps: Floats
    ranges: Floats


def measure(scenario: AwarenessScenario, seed: int) -> AwarenessInput:
    """What is measured in a run."""
    rng = np.random.default_rng([seed, 15])
    truth, accel = _fly(scenario)
    gps = truth[:, :DRONES] + rng.normal(size=(len(truth), DRONES, 6)) * np.repeat([GPS_SIGMA_M, SPEED_SIGMA_MPS], 3)
    measured = accel + ACCEL_SIGMA_MPS2 * rng.normal(size=accel.shape)
    away = np.linalg.norm(truth[:, :DRONES, None, :3] - truth[:, None, :, :3], axis=-1)
    noise = rng.normal(size=away.shape)
    ranges = away + RANGE_SIGMA_M * noise
    ranges[away > SIGHT_M] = np.nan
    ranges[:, range(DRONES), range(DRONES)] = np.nan
    ranges[:, :, DRONES:] = (away + TARGET_BIAS_M + TARGET_SIGMA_M * noise)[:, :, DRONES:]
    return AwarenessInput(scenario, truth, measured, gps, ranges)


def _fly(scenario: AwarenessScenario) -> tuple[Floats, Floats]:
    """True states ``(T+1, B, 6)`` and accelerations ``(T, n, 3)``, constant over a tick."""
    ticks = scenario.ticks
    velocity = np.stack([_velocities(scenario, each) for each in range(DRONES)], axis=1)
    accel = np.diff(velocity, axis=0) / PERIOD_S
    truth = np.empty((ticks + 1, DRONES, 6))
    truth[0, :, :3], truth[:, :, 3:] = _start(scenario), velocity
    steps = PERIOD_S * velocity[:-1] + 0.5 * PERIOD_S**2 * accel
    truth[1:, :, :3] = truth[0, :, :3] + np.cumsum(steps, axis=0)
    if scenario.target is None:
        return truth, accel
    target = np.tile(np.array(scenario.target, float), (ticks + 1, 1))
    target[:, :3] += PERIOD_S * np.arange(ticks + 1)[:, None] * target[:, 3:]
    return np.concatenate((truth, target[:, None]), axis=1), accel


def _start(scenario: AwarenessScenario) -> Floats:
    """Places ``(n, 3)``: drone 1 ahead, the others behind it in two columns, each row higher."""
    row_m, column_m = scenario.spacing_m
    places = [(0.0, 0.0, -40.0)]
    for each in range(1, DRONES):
        row, side = (each + 1) // 2, -1.0 if each % 2 else 1.0
        places.append((-row_m * row, side * column_m, -42.0 - 8.0 * row - 1.5 * (side + 1.0)))
    return np.array(places)


def _velocities(scenario: AwarenessScenario, drone: int) -> Floats:
    """``(T+1, 3)`` m/s of a drone: straight, then S-turns and climbs, each a little later than the one before it."""
    t_s = PERIOD_S * np.arange(scenario.ticks + 1)
    if drone == 0 and scenario.hover:
        return np.zeros((len(t_s), 3))
    turning_s = np.maximum(t_s - STRAIGHT_S - 1.5 * drone, 0.0)
    heading = 0.35 * np.sin(2.0 * np.pi * turning_s / 60.0)
    climb = -0.25 * np.sin(2.0 * np.pi * turning_s / 60.0)
    return np.stack([scenario.speed_mps * np.cos(heading), scenario.speed_mps * np.sin(heading), climb], axis=1)
