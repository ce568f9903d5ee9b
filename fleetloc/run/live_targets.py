"""The targets in the live picture of a running fleet: as the drone has each that knows it best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.table import Table

from agent.config.tables import FleetConfig
from estimators.model.layout import position
from fleetloc.run.fleet_observer import Observed, RunObserver
from fleetloc.run.live_table import STALE_S
from fleetloc.run.live_truth import LiveTruth
from transport.messages.estimate_body import MAX_AGE_TICKS, FleetEstimate

COLUMNS = ("target", "best known to drone", "state", "error m", "sigma m")


@dataclass(frozen=True, slots=True)
class TargetRow:
    """What is shown of a target, as text."""

    target: str
    seen_by: str
    state: str = ""
    error: str = ""
    sigma: str = ""


def target_rows(config: FleetConfig, observer: RunObserver, truth: LiveTruth, now_s: float) -> list[TargetRow]:
    """The present picture; ``now_s`` is the monotonic clock."""
    return [_row(config, slot, observer, truth, now_s) for slot in range(len(config.targets))]


def _row(config: FleetConfig, slot: int, observer: RunObserver, truth: LiveTruth, now_s: float) -> TargetRow:
    target = config.targets[slot]
    label = f"{target.id} {target.name}".strip()
    known = [
        (_sigma_m(observed.estimate, target.id), agent_id, observed.estimate)
        for agent_id, observed in observer.agents.items()
        if observed.estimate is not None and _has(observed, target.id, now_s)
    ]
    if not known:
        return TargetRow(label, "nobody")
    sigma_m, agent_id, estimate = min(known, key=lambda each: each[:2])
    north, east, down = (float(axis) for axis in estimate.mean[position(estimate.agents.index(target.id))])
    time_unix_s = config.fleet.epoch_unix_s + estimate.tick * config.fleet.period_s
    error_m = truth.error_m(len(config.ids) + slot, time_unix_s, (north, east, down))
    said = observer.agents[agent_id].diagnostics
    state = "" if said is None else said.targets.get(str(target.id), "")
    return TargetRow(label, str(agent_id), state, "" if error_m is None else f"{error_m:.2f}", f"{sigma_m:.2f}")


def _has(observed: Observed, target_id: int, now_s: float) -> bool:
    """Whether a target is part of a drone's estimate, and that is a fresh one."""
    estimate = observed.estimate
    if estimate is None or now_s - observed.estimate_s > STALE_S or target_id not in estimate.agents:
        return False
    return estimate.age_ticks[estimate.agents.index(target_id)] < MAX_AGE_TICKS


def _sigma_m(estimate: FleetEstimate, target_id: int) -> float:
    """1-sigma over the three axes of the position."""
    return float(np.sqrt(estimate.variance[position(estimate.agents.index(target_id))].sum()))


def table(picture: list[TargetRow]) -> Table:
    """The picture for a terminal."""
    shown = Table(title="targets", title_justify="left")
    for column in COLUMNS:
        shown.add_column(column, justify="right")
    for row in picture:
        shown.add_row(row.target, row.seen_by, row.state, row.error, row.sigma)
    return shown


def lines(picture: list[TargetRow]) -> list[str]:
    """The picture for a log."""
    return [
        f"  target {row.target}: best known to drone {row.seen_by}{row.state and ': ' + row.state}; "
        f"error {row.error or '?'} m, sigma {row.sigma or '?'} m"
        for row in picture
    ]
