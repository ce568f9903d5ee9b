"""One flight of the integrity study in virtual time: what was promised at each tick, and what was true."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.reading import with_other_table
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from estimators.integrity.protection.statement import IntegrityState
from estimators.model.layout import position
from fleetloc.bench.fault_flights import Bools, Flight, Floats
from sim_bridge.virtual.fleet_lockstep import FleetLockstep
from sim_bridge.world.sim_table import sim_table

ALERTS = (IntegrityState.ALERT, IntegrityState.NOT_OBSERVABLE)


@dataclass(frozen=True, slots=True)
class Promises:
    """Over ticks and drones ``(T, n)``; NaN and an alert where there was no estimate in time.

    Attributes
    ----------
    error_m, level_m : of the own position, horizontal and vertical ``(T, n, 2)``, and its protection levels
    alert : whether the position was said to be of no use
    fixes_off, ranges_off : whose fixes, and an end of which ranges, each drone holds to be off ``(T, n, n)``
    somebody : whether something was said to be off, and not whose
    """

    error_m: Floats
    level_m: Floats
    alert: Bools
    fixes_off: Bools
    ranges_off: Bools
    somebody: Bools


@dataclass(frozen=True, slots=True)
class KeptFlight:
    """A flight, and where what it gave is kept; ``None``: nowhere."""

    flight: Flight
    folder: Path | None

    def promises(self) -> Promises:
        """What it gave, flown if it is not kept."""
        path = None if self.folder is None else self.folder / f"{self._name()}.npz"
        if path is not None and path.exists():
            with np.load(path) as held:
                return Promises(**{each.name: held[each.name] for each in fields(Promises)})
        made = fly(self.flight)
        if path is not None:
            unfinished = path.with_suffix(".part.npz")
            np.savez_compressed(unfinished, **{each.name: getattr(made, each.name) for each in fields(Promises)})
            unfinished.rename(path)
        return made

    def _name(self) -> str:
        """Of all that the flight follows from."""
        said = repr((self.flight.configured(), self.flight.duration_s))
        return hashlib.blake2b(said.encode(), digest_size=12).hexdigest()


def promises_of(kept: KeptFlight) -> Promises:
    """For a pool of processes."""
    return kept.promises()


def first_drones(config: FleetConfig, count: int) -> FleetConfig:
    """The same fleet with its first drones alone, and without faults of its own."""
    ids = config.ids[:count]
    sim = sim_table(config)
    paths = tuple(path for path in sim.paths if path.agent in ids)
    outages = tuple(each for each in sim.gps_outages if each.agent in ids)
    sim = msgspec.structs.replace(sim, paths=paths, gps_outages=outages, faults=())
    edges = config.fleet.edges
    kept = None if edges is None else tuple(edge for edge in edges if set(edge) <= set(ids))
    agents = tuple(agent for agent in config.agents if agent.id in ids)
    smaller = msgspec.structs.replace(config, agents=agents, fleet=msgspec.structs.replace(config.fleet, edges=kept))
    return with_other_table(smaller, "sim", sim)


def fly(flight: Flight) -> Promises:
    """Fly it; the same flight gives the same."""
    config = flight.configured()
    ids, period_s = config.ids, config.fleet.period_s
    ticks, count = round(flight.duration_s / period_s), len(config.ids)
    noted: list[tuple[int, float, NDArray[np.float64], EstimateReady]] = []

    def on_estimate(agent: OnboardAgent, ready: EstimateReady) -> None:
        if agent.core.fleet.started and ready.on_time and ready.integrity is not None:
            slot = ids.index(agent.agent_id)
            place = ready.estimate.mean[position(slot)].copy()
            noted.append((slot, ready.t_s + config.fleet.epoch_unix_s, place, ready))

    report = FleetLockstep(config, make_estimator, on_estimate).run(flight.duration_s)
    error, level = np.full((ticks, count, 2), np.nan), np.full((ticks, count, 2), np.nan)
    alert, somebody = np.ones((ticks, count), np.bool_), np.zeros((ticks, count), np.bool_)
    fixes, ranges = np.zeros((ticks, count, count), np.bool_), np.zeros((ticks, count, count), np.bool_)
    for slot, unix_s, place, ready in noted:
        tick = round((unix_s - report.start_unix_s) / period_s)
        if not 0 <= tick < ticks or unix_s > float(report.truth.time_unix_s[-1]) or ready.integrity is None:
            continue
        stated = ready.integrity
        truth = report.truth.at(max(unix_s, report.start_unix_s)).reshape(count, -1)
        off = place - truth[slot, :3]
        error[tick, slot] = np.hypot(off[0], off[1]), abs(off[2])
        level[tick, slot] = stated.own.horizontal_m, stated.own.vertical_m
        alert[tick, slot] = stated.state in ALERTS
        somebody[tick, slot] = stated.unattributable
        fixes[tick, slot, [ids.index(each) for each in stated.off]] = True
        ranges[tick, slot, [ids.index(each) for pair in stated.ranges_off for each in pair]] = True
    return Promises(error, level, alert, fixes, ranges, somebody)
