"""One flight of a fault study in virtual time: how wrong and how sure each drone was at each tick."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.reading import with_other_table
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from agent.watch.health import State
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import block, position
from fleetloc.bench.fault_rows import RadioSpell
from sim_bridge.faults.fault_tables import FaultTable
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, LockstepReport
from sim_bridge.world.sim_table import sim_table

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
SINGULAR = math.inf
"""NEES where a covariance has no inverse: it claims to know something exactly."""


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight to be flown; the seed is of world and radio, the faults come on top of the configuration's."""

    config: FleetConfig
    seed: int
    faults: tuple[FaultTable, ...]
    duration_s: float
    radio: RadioSpell | None = None

    def configured(self) -> FleetConfig:
        """The configuration of this flight."""
        config = self.config
        sim = sim_table(config)
        sim = msgspec.structs.replace(sim, seed=self.seed, faults=(*sim.faults, *self.faults))
        transport = msgspec.structs.replace(config.transport, seed=self.seed)
        if self.radio is not None:
            transport = self.radio.laid_over(transport)
        return with_other_table(msgspec.structs.replace(config, transport=transport), "sim", sim)


@dataclass(frozen=True, slots=True)
class History:
    """What the drones of a flight published, over ticks and drones ``(T, n)``; NaN where there was no estimate.

    Attributes
    ----------
    error_m, sigma_m : of the own position, 3-D; the sigma is the root of the sum of the axes' variances
    fleet_m : rms over all drones of the errors of their positions, in the eyes of each
    nees, nees_fleet : of the own state and of the whole fleet's, over their dimensions
    available : an estimate in time that is one
    flagged : status or health not ok
    alarm : the health's alarm, or an estimate that is not to be used
    """

    error_m: Floats
    sigma_m: Floats
    fleet_m: Floats
    nees: Floats
    nees_fleet: Floats
    available: Bools
    flagged: Bools
    alarm: Bools


def fly(flight: Flight) -> History:
    """Fly it; the same flight gives the same history."""
    config = flight.configured()
    ids, period_s = config.ids, config.fleet.period_s
    notes: list[_Note] = []

    def on_estimate(agent: OnboardAgent, ready: EstimateReady) -> None:
        health = agent.core.health.health
        estimate, started = ready.estimate, agent.core.fleet.started
        told = (
            started and ready.on_time and estimate.status != Status.NO_DATA,
            estimate.status != Status.OK or health.state is not State.OK,
            health.alarm or health.state in (State.FAULT, State.INIT),
        )
        state = (estimate.mean, estimate.covariance) if started else None
        notes.append(_Note(ids.index(agent.agent_id), ready.t_s + config.fleet.epoch_unix_s, state, told))

    report = FleetLockstep(config, make_estimator, on_estimate).run(flight.duration_s)
    return _history(notes, report, len(ids), round(flight.duration_s / period_s), period_s)


@dataclass(frozen=True, slots=True)
class _Note:
    """What a drone said of a tick: its slot, Unix time, mean and covariance, (available, flagged, alarm)."""

    slot: int
    unix_s: float
    state: tuple[Floats, Floats] | None
    told: tuple[bool, bool, bool]


def _history(notes: list[_Note], report: LockstepReport, count: int, ticks: int, period_s: float) -> History:
    figures = np.full((5, ticks, count), np.nan)
    told = np.zeros((3, ticks, count), np.bool_)
    told[1:] = True  # no estimate at all is no good one
    last_unix_s = float(report.truth.time_unix_s[-1])
    for note in notes:
        tick = round((note.unix_s - report.start_unix_s) / period_s)
        if not 0 <= tick < ticks or note.unix_s > last_unix_s:
            continue
        told[:, tick, note.slot] = note.told
        if note.state is not None:
            truth = report.truth.at(max(note.unix_s, report.start_unix_s))
            figures[:, tick, note.slot] = _figures(*note.state, truth, note.slot)
    return History(*figures, *told)


def _figures(mean: Floats, covariance: Floats, truth: Floats, slot: int) -> tuple[float, float, float, float, float]:
    """Own error and sigma, rms error of all positions, NEES of own state and fleet's over their dimensions."""
    error = mean - truth.reshape(-1)
    own, place = block(slot), position(slot)
    positions = np.array([error[position(each)] for each in range(len(truth))])
    return (
        float(np.linalg.norm(error[place])),
        math.sqrt(float(np.trace(covariance[place, place]))),
        math.sqrt(float(np.mean(np.sum(positions**2, axis=1)))),
        _nees(error[own], covariance[own, own]),
        _nees(error, covariance),
    )


def _nees(error: Floats, covariance: Floats) -> float:
    try:
        return float(error @ np.linalg.solve(covariance, error)) / len(error)
    except np.linalg.LinAlgError:
        return SINGULAR
