"""The slow errors of a fleet's sensors, as constants over a window that its rows and inputs hold.

What lasts for longer than a window is no noise: the wander of a receiver's fixes, of its own and common to all that
see the same sky; the error of an acceleration by bias and tilt; the bias of the ranges between two antennas; the
drift of a barometer, and the scale of its heights, as air is colder or warmer than that of the standard atmosphere.
Each is a Gauss-Markov process that enters the rows:

    fix of agent a along u:        + u . w_a + u . w
    range between a and b:         + b_ab
    range between a and target t:  + b_at + s_t
    acceleration of a:             + e_a
    barometer of a, at height z:   + d_a + z k_a

Ranges to a target are made by a sensor of its own, which is off by as much for all drones, s_t. Sizes follow the
data, but for those of barometers and targets (`estimators.systematic.sizes`). Order of the q errors: wander ``3n``,
acceleration ``3n``, common wander ``3``, pairs ``n (n - 1) / 2``, drift of barometers ``n``, where that of a target
is s_t, their scale ``n``. A row with a hard bound has none: its sensor is said to have no others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.row_kernels import HEIGHT, POSITION, RANGE, IntArray

WANDER_S = 60.0
"""Time constant of the wander of fixes."""
ACCELERATION_S = 20.0
"""Of the error of accelerations in NED: a bias turns with the body, a tilt lasts longer."""
PAIR_S = 650.0
"""Of the bias of ranges between two antennas, which drifts as they warm up and turn. Real robots ask for more: those
of TIERS stand still. Simulated antennas with lobes ask for less: with 1000 s their fleets have an ANEES of 1.4."""
HEIGHT_S = 80_000.0
"""Of the drift of a barometer and of its scale: both go with the weather."""
COUPLED = 7
"""Slow errors in one row at most, and one place that ends the list."""


def count(agents: int) -> int:
    """How many slow errors a fleet has."""
    return 8 * agents + 3 + agents * (agents - 1) // 2


def wander_of(slot: int) -> slice:
    """Wander of an agent's fixes, NED m."""
    return slice(3 * slot, 3 * slot + 3)


def acceleration_of(slot: int, agents: int) -> slice:
    """Error of an agent's acceleration, NED m/s2."""
    return slice(3 * (agents + slot), 3 * (agents + slot) + 3)


def common(agents: int) -> slice:
    """Wander that all fixes share, NED m."""
    return slice(6 * agents, 6 * agents + 3)


def pairs(agents: int) -> slice:
    """Biases of the ranges, m."""
    return slice(6 * agents + 3, 6 * agents + 3 + agents * (agents - 1) // 2)


def pair_of(one: int, other: int, agents: int) -> int:
    """Bias of the ranges between two agents."""
    a, b = min(one, other), max(one, other)
    return 6 * agents + 3 + a * agents - a * (a + 1) // 2 + b - a - 1


def drifts(agents: int) -> slice:
    """Drifts of the barometers, NED m; of a target, which has none, the bias of ranges to it."""
    return slice(count(agents) - 2 * agents, count(agents) - agents)


def scales(agents: int) -> slice:
    """Scales of the barometers' heights, less one."""
    return slice(count(agents) - agents, count(agents))


def kept_per_tick(agents: int, period_s: float) -> Vector:
    """Factor ``(q,)`` by which each error decays in a tick."""
    times = np.empty(count(agents))
    times[: 3 * agents] = WANDER_S
    times[3 * agents : 6 * agents] = ACCELERATION_S
    times[common(agents)] = WANDER_S
    times[pairs(agents)] = PAIR_S
    times[drifts(agents)] = times[scales(agents)] = HEIGHT_S
    return np.exp(-period_s / times)


def places_before(before: int, stayed: Mapping[int, int], after: int) -> IntArray:
    """Where each slow error of a changed fleet was, ``(q,)``, -1 for those that begin anew.

    ``stayed``: by slot in the new fleet of ``after`` agents, the slot in the old one of ``before``.
    """
    was = np.full(count(after), -1, np.int64)
    was[common(after)] = np.arange(6 * before, 6 * before + 3)
    for slot, old in stayed.items():
        was[wander_of(slot)] = np.arange(3 * old, 3 * old + 3)
        was[acceleration_of(slot, after)] = np.arange(3 * (before + old), 3 * (before + old) + 3)
        was[drifts(after).start + slot] = drifts(before).start + old
        was[scales(after).start + slot] = scales(before).start + old
        for other, old_other in stayed.items():
            if other > slot:
                was[pair_of(slot, other, after)] = pair_of(old, old_other, before)
    return was


def couplings(rows: RowTable, is_vehicle: NDArray[np.bool_]) -> tuple[IntArray, Matrix]:
    """Which slow errors each row holds ``(m, 7)``, -1 where fewer, and by how much; ``is_vehicle`` ``(n,)``."""
    at, by = np.full((len(rows), COUPLED), -1, np.int64), np.zeros((len(rows), COUPLED))
    _couple(rows, is_vehicle, at, by)
    return at, by


@entry("void(ROW[::1], boolean[::1], int64[:, ::1], float64[:, ::1])", ROW=ROW)
def _couple(rows: RowTable, is_vehicle: NDArray[np.bool_], at: IntArray, by: Matrix) -> None:
    agents = is_vehicle.shape[0]
    drifts_at = 6 * agents + 3 + agents * (agents - 1) // 2
    for r in range(rows.shape[0]):
        row, j = rows[r], 0
        if np.isfinite(row["half_width"]):
            continue
        if row["kind"] == POSITION:
            direction = (row["x"], row["y"], row["z"])
            for i in range(3):
                if direction[i] != 0.0:
                    at[r, j], by[r, j] = 3 * row["agent"] + i, direction[i]
                    at[r, j + 1], by[r, j + 1] = 6 * agents + i, direction[i]
                    j += 2
        elif row["kind"] == HEIGHT and row["x"] != 0.0:
            drift = drifts_at + row["agent"]
            at[r, 0], by[r, 0] = drift, row["x"]
            at[r, 1], by[r, 1] = drift + agents, row["x"] * row["value"]
        elif row["kind"] == RANGE:
            a, b = min(row["agent"], row["other"]), max(row["agent"], row["other"])
            at[r, 0], by[r, 0] = 6 * agents + 3 + a * agents - a * (a + 1) // 2 + b - a - 1, 1.0
            if not (is_vehicle[a] and is_vehicle[b]):
                at[r, 1], by[r, 1] = drifts_at + (a if is_vehicle[b] else b), 1.0


def corrected_rows(rows: RowTable, at: IntArray, by: Matrix, errors: Vector, variance: Vector) -> RowTable:
    """Rows less what they hold of the ``errors`` ``(q,)``, less sure by the ``variance`` ``(q,)`` of these."""
    out = rows.copy()
    if len(errors):
        held = at >= 0
        out["value"] -= np.where(held, by * errors[at], 0.0).sum(axis=1)
        out["variance"] += np.where(held, by**2 * variance[at], 0.0).sum(axis=1)
    return out
