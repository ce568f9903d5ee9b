"""Rows of a small fleet whose sensors nobody has calibrated: receivers wander, pairs are biased, some are blocked.

Without packets, autopilots or clocks: for monitors that look at rows. Fixes at 5 Hz, ranges of all pairs at 10 Hz.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from estimators.model.measurements import ROW, Kind, RowTable, Vector

PERIOD_S = 0.1
FIX_EVERY = 2
FIX_SIGMA_M = np.array([0.4, 0.4, 0.6])
WANDER_M = np.array([1.0, 1.0, 1.5]) * 0.5**0.5
"""1-sigma of each receiver's own wander, and of that which all share."""
WANDER_S = 60.0
RANGE_SIGMA_M = 0.1
BLOCKED_SHARE, BLOCKED_M = 0.03, 1.0

Shift = Callable[[float, int], Vector]
"""(seconds, slot) -> what is added to a drone's fixes, NED m."""


def no_shift(t_s: float, slot: int) -> Vector:
    return np.zeros(3)


def ramp(slot: int, rate_mps: float, from_s: float, seed: int) -> Shift:
    """One drone's fixes are dragged away horizontally."""
    angle = np.random.default_rng(seed + 999).uniform(0.0, 2.0 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    return lambda t_s, of: along * rate_mps * max(0.0, t_s - from_s) if of == slot else np.zeros(3)


def jump(slot: int, by_m: Vector, from_s: float, to_s: float) -> Shift:
    """One drone's fixes are elsewhere for a while."""
    return lambda t_s, of: by_m if of == slot and from_s <= t_s < to_s else np.zeros(3)


def rows_of_flight(
    drones: int, seed: int, duration_s: float, shift: Shift = no_shift, *, calibrated: bool = False
) -> Iterator[tuple[int, RowTable]]:
    """Tick and rows, from tick 0 on; ``calibrated``: white noise only."""
    rng = np.random.default_rng(seed)
    fly = _flight(drones, rng)
    size = 0.0 if calibrated else 1.0
    own, common = size * rng.normal(size=(drones, 3)) * WANDER_M, size * rng.normal(size=3) * WANDER_M
    bias = size * rng.uniform(0.2, 0.5, (drones, drones))
    kept = np.exp(-FIX_EVERY * PERIOD_S / WANDER_S)
    fresh = size * np.sqrt(1.0 - kept**2)
    for tick in range(round(duration_s / PERIOD_S)):
        rows = []
        if tick % FIX_EVERY == 0:
            own = kept * own + fresh * rng.normal(size=(drones, 3)) * WANDER_M
            common = kept * common + fresh * rng.normal(size=3) * WANDER_M
            for slot in range(drones):
                t_s = tick * PERIOD_S
                fix = fly(slot, t_s) + own[slot] + common + rng.normal(size=3) * FIX_SIGMA_M + shift(t_s, slot)
                rows += _fix_rows(tick, slot, fix)
        for slot in range(drones):
            for other in range(slot + 1, drones):
                offset_s = rng.uniform(-0.5, 0.5) * PERIOD_S
                t_s = tick * PERIOD_S + offset_s
                arms = rng.uniform(-0.3, 0.3, 3)  # of the antennas
                range_m = np.linalg.norm(fly(slot, t_s) - fly(other, t_s) + arms) + bias[slot, other]
                range_m += RANGE_SIGMA_M * rng.normal()
                if rng.random() < size * BLOCKED_SHARE:
                    range_m += rng.exponential(BLOCKED_M)
                noise = RANGE_SIGMA_M**2, np.inf
                rows.append((tick, offset_s, range_m, *noise, *arms, Kind.RANGE, slot, other, slot))
        yield tick, np.array(rows, ROW)


def _fix_rows(tick: int, slot: int, fix: Vector) -> list[tuple[float, ...]]:
    return [
        (tick, 0.0, fix[axis], FIX_SIGMA_M[axis] ** 2, np.inf, *np.eye(3)[axis], Kind.POSITION, slot, -1, slot)
        for axis in range(3)
    ]


def _flight(drones: int, rng: np.random.Generator) -> Callable[[int, float], Vector]:
    """Circles of 6 to 14 m at 2 to 6 m/s, up and down by 2 m."""
    phase, radius = rng.uniform(0.0, 2.0 * np.pi, drones), rng.uniform(6.0, 14.0, drones)
    rate = rng.uniform(0.2, 0.4, drones) * rng.choice((-1.0, 1.0), drones)
    down, middle = rng.uniform(-25.0, -8.0, drones), rng.uniform(-6.0, 6.0, (drones, 2))

    def place(slot: int, t_s: float) -> Vector:
        angle = rate[slot] * t_s + phase[slot]
        north, east = middle[slot] + radius[slot] * np.array([np.cos(angle), np.sin(angle)])
        return np.array([north, east, down[slot] + 2.0 * np.sin(0.3 * t_s + phase[slot])])

    return place
