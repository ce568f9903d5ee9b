"""What cannot be: measurements so far from the estimate that no error of a sound sensor explains them.

Robust weights make little of an outlier, but not nothing of one that claims to be certain; and an algorithm without
them follows it. So what is beyond all reach is left out before any estimator sees it, whoever measured it. The limits
are wide: whatever is nearer is left to the monitors that weigh it (`innovations`, `exclusion`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import FAR_M, FAR_MPS, FAR_SIGMAS, REFUSED_FOR_S, REFUSED_TOLD_S
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Kind, Matrix, RowTable, Vector

_PLACED = (Kind.POSITION, Kind.RANGE, Kind.ANCHOR_RANGE, Kind.RELATIVE)
"""What is measured in m."""


@dataclass(frozen=True, slots=True)
class Presented:
    """The rows of ``tick``, and what is believed of the drones that they name."""

    tick: int
    agents: tuple[int, ...]
    """Ids of the slots of ``rows``."""
    rows: RowTable
    belief_tick: int
    mean: Vector
    """``(6n,)`` of ``agents`` at ``belief_tick``; NaN for a drone of which nothing is believed."""
    sigma: Vector
    """``(6n,)`` of ``mean``."""


@dataclass(slots=True)
class _Refused:
    """Of one drone's sensors."""

    since_tick: int
    """Its fixes have been refused since, without one that was not."""
    last_tick: int
    off: float


class PlausibilityMonitor:
    """``own``: about whom a finding is an alarm; `refused` are the latest rows ``(m,)`` to be left out."""

    def __init__(self, own: int, period_s: float) -> None:
        self._own = own
        self._period_s = period_s
        self._of: dict[int, _Refused] = {}
        self.refused: NDArray[np.bool_] = np.zeros(0, np.bool_)

    def observe(self, evidence: Presented) -> tuple[Finding, ...]:
        """A finding about each drone, by id, that measured what cannot be, now or within the last second."""
        rows, tick = evidence.rows, evidence.tick
        if len(rows):
            off, limit = self._off(evidence)
            self.refused = _with_their_fixes(rows, off > limit)
            self._note(evidence, off)
        else:
            self.refused = np.zeros(0, np.bool_)
        told, kept = REFUSED_TOLD_S / self._period_s, REFUSED_FOR_S / self._period_s
        self._of = {agent: each for agent, each in self._of.items() if tick - each.last_tick <= kept}
        return tuple(
            Finding(What.IMPOSSIBLE, Gravity.ALARM if agent == self._own else Gravity.DEGRADED, agent, each.off)
            for agent, each in sorted(self._of.items())
            if tick - each.last_tick <= told
        )

    def shut_out(self) -> tuple[int, ...]:
        """Drones whose fixes have been refused, one and all, for so long that the estimate may be what is wrong."""
        ticks = REFUSED_FOR_S / self._period_s
        return tuple(agent for agent, each in self._of.items() if each.last_tick - each.since_tick >= ticks)

    def forget(self) -> None:
        """Begin from nothing: the estimate that measurements were held against is given up."""
        self._of = {}

    def _note(self, evidence: Presented, off: Vector) -> None:
        rows, tick = evidence.rows, evidence.tick
        fixed = (rows["kind"] == Kind.POSITION) & ~self.refused
        for slot in np.unique(rows["observer"][fixed]).tolist():
            agent = evidence.agents[slot]
            if agent in self._of:
                self._of[agent].since_tick = tick
        for at in np.flatnonzero(self.refused):
            agent = evidence.agents[rows["observer"][at]]
            known = self._of.setdefault(agent, _Refused(tick, tick, 0.0))
            known.off = max(float(off[at]), known.off if known.last_tick == tick else 0.0)
            known.last_tick = tick

    def _off(self, evidence: Presented) -> tuple[Vector, Vector]:
        """How far each row ``(m,)`` is from what is believed, and how far it may be; in m or m/s."""
        rows = evidence.rows
        states = evidence.mean.reshape(-1, STATES_PER_AGENT)
        sigma = evidence.sigma.reshape(-1, STATES_PER_AGENT)
        spread_m, spread_mps = sigma[:, :3].max(axis=1), sigma[:, 3:].max(axis=1)
        lead_s = (rows["tick"] - evidence.belief_tick) * self._period_s + rows["offset_s"]
        one, other = rows["agent"], np.where(rows["other"] >= 0, rows["other"], rows["agent"])
        velocity = states[one, 3:]
        place, there = (states[each, :3] + lead_s[:, None] * states[each, 3:] for each in (one, other))
        axis = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
        expected: dict[Kind, Callable[[], Vector]] = {
            Kind.POSITION: lambda: _along(axis, place),
            Kind.VELOCITY: lambda: _along(axis, velocity),
            Kind.ODOMETRY: lambda: _along(axis, velocity),
            Kind.SPEED: lambda: _length(velocity + axis),
            Kind.RANGE: lambda: _length(place - there + axis),
            Kind.RELATIVE: lambda: _along(axis, place - there),
            Kind.ANCHOR_RANGE: lambda: _length(place - axis),
        }
        off = np.zeros(len(rows))
        for kind, predict in expected.items():
            of_kind = rows["kind"] == kind
            if of_kind.any():
                off[of_kind] = np.abs(rows["value"] - predict())[of_kind]
        placed = np.isin(rows["kind"], _PLACED)
        spread = np.where(placed, np.maximum(spread_m[one], spread_m[other]), spread_mps[one])
        # of whom nothing is believed, nothing is impossible
        return np.nan_to_num(off, nan=0.0), np.where(placed, FAR_M, FAR_MPS) + FAR_SIGMAS * np.nan_to_num(spread)


def _with_their_fixes(rows: RowTable, refused: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Rows that are refused, and with an axis of a fix, velocity or sighting its others."""
    if not refused.any():
        return refused
    whole = [rows[name].astype(np.float64) for name in ("observer", "kind", "other", "tick", "offset_s")]
    _, fix = np.unique(np.stack(whole, axis=1), axis=0, return_inverse=True)
    vectors = np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY, Kind.ODOMETRY, Kind.RELATIVE))
    return np.asarray(refused | (vectors & np.isin(fix.ravel(), fix.ravel()[refused & vectors])))


def _along(axis: Matrix, vector: Matrix) -> Vector:
    return np.asarray((axis * vector).sum(axis=1))


def _length(vector: Matrix) -> Vector:
    return np.asarray(np.sqrt((vector**2).sum(axis=1)))
