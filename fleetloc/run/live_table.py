"""The live picture of a running fleet: a table on a terminal, a line per drone now and then elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from rich.table import Table
from rich.text import Text

from agent.config.tables import FleetConfig
from estimators.model.layout import Layout, position
from fleetloc.run.fleet_observer import Observed, RunObserver
from fleetloc.run.live_truth import LiveTruth

STALE_S = 1.0
"""An estimate older than this is shown as a silence."""
FIX_NAMES = {0: "no GPS", 1: "no fix", 2: "2-D", 3: "3-D", 4: "DGPS", 5: "RTK float", 6: "RTK fixed"}
STYLES = {"ok": "green", "degraded": "yellow", "aligning": "cyan", "init": "cyan", "fault": "red"}
COLUMNS = (
    "drone",
    "status",
    "error m",
    "sigma m",
    "protection m",
    "GPS",
    "heard (age s)",
    "tick p50/p99 ms",
    "packets rx/lost/bad",
)


@dataclass(frozen=True, slots=True)
class Row:
    """What is shown of one drone, as text; ``style`` colours its status."""

    agent_id: int
    status: str
    style: str
    error: str
    sigma: str
    protection: str
    gps: str
    neighbours: str
    tick: str
    packets: str

    def cells(self) -> tuple[str, ...]:
        """The cells after the status."""
        return self.error, self.sigma, self.protection, self.gps, self.neighbours, self.tick, self.packets


def rows(
    config: FleetConfig, observer: RunObserver, truth: LiveTruth, ended: dict[int, str], now_s: float
) -> list[Row]:
    """The present picture; ``ended`` says why a daemon is no more, ``now_s`` is the monotonic clock."""
    return [
        _row(config, agent_id, observed, truth, ended.get(agent_id), now_s)
        for agent_id, observed in observer.agents.items()
    ]


def _row(
    config: FleetConfig, agent_id: int, observed: Observed, truth: LiveTruth, ended: str | None, now_s: float
) -> Row:
    status, style = _status(observed, ended, now_s)
    error, sigma = _accuracy(config, agent_id, observed, truth, now_s)
    diagnostics = observed.diagnostics
    if diagnostics is None:
        return Row(agent_id, status, style, error, sigma, "", "", "", "", "")
    gauges, counters = diagnostics.gauges, diagnostics.counters
    fix = int(gauges.get("gps_fix_type", 0.0))
    heard = (
        f"{other} ({values['heard_age_s']:.1f})"
        for other, values in diagnostics.neighbours.items()
        if values.get("heard_age_s", math.inf) < config.transport.neighbour_timeout_s
    )
    bad = sum(count for name, count in counters.items() if name.startswith("rejected "))
    return Row(
        agent_id,
        status,
        style,
        error,
        sigma,
        protection_text(gauges),
        gps=f"{FIX_NAMES.get(fix, fix)} {gauges['gps_age_s']:.1f} s" if "gps_age_s" in gauges else "none yet",
        neighbours=", ".join(heard) or "nobody",
        tick=f"{1e3 * gauges.get('tick_time_p50_s', 0.0):.1f}/{1e3 * gauges.get('tick_time_p99_s', 0.0):.1f}",
        packets=f"{counters.get('packets received', 0)}/{counters.get('packets lost', 0)}/{bad}",
    )


def protection_text(gauges: Mapping[str, float]) -> str:
    """Protection levels, horizontal and vertical, m; marked where they, or what else is found, are an alert."""
    names = "protection_horizontal_m", "protection_vertical_m"
    if not all(name in gauges for name in names):
        return ""
    horizontal_m, vertical_m = (gauges[name] for name in names)
    alert = "!" if gauges.get("integrity_alert") else ""
    return f"{horizontal_m:.1f}/{vertical_m:.1f}{alert}" if horizontal_m < 1e3 else f"unknown{alert}"


def _status(observed: Observed, ended: str | None, now_s: float) -> tuple[str, str]:
    silent = observed.estimate is None or now_s - observed.estimate_s > STALE_S
    if ended is not None and silent:
        return ended, "red"
    if silent:
        return ("silent", "red") if observed.estimate is not None else ("starting", "cyan")
    if observed.diagnostics is None:
        return "there", "cyan"
    state, reasons = observed.diagnostics.state, observed.diagnostics.reasons
    return f"{state}: {'; '.join(reasons)}" if reasons else state, STYLES.get(state, "")


def _accuracy(
    config: FleetConfig, agent_id: int, observed: Observed, truth: LiveTruth, now_s: float
) -> tuple[str, str]:
    """Error of the own position against the truth of its instant, and 1-sigma over its three axes, in m."""
    estimate = observed.estimate
    if estimate is None or now_s - observed.estimate_s > STALE_S:
        return "", ""
    slot = Layout(config.ids).slot(agent_id)
    north, east, down = (float(axis) for axis in estimate.mean[position(slot)])
    time_unix_s = config.fleet.epoch_unix_s + estimate.tick * config.fleet.period_s
    error_m = truth.error_m(slot, time_unix_s, (north, east, down))
    sigma_m = float(np.sqrt(np.trace(estimate.own_covariance[:3, :3])))
    known = sigma_m < 1e3
    return ("" if error_m is None or not known else f"{error_m:.2f}"), f"{sigma_m:.2f}" if known else "unknown"


def table(title: str, picture: list[Row]) -> Table:
    """The picture for a terminal."""
    shown = Table(title=title, title_justify="left")
    for index, column in enumerate(COLUMNS):
        shown.add_column(column, justify="left" if index in (1, 5, 6) else "right")
    for row in picture:
        shown.add_row(str(row.agent_id), Text(row.status, style=row.style), *row.cells())
    return shown


def lines(title: str, picture: list[Row]) -> list[str]:
    """The picture for a log."""
    return [title] + [
        f"  drone {row.agent_id}: {row.status}; error {row.error or '?'} m, sigma {row.sigma or '?'} m, "
        f"protection {row.protection or '?'} m; "
        f"GPS {row.gps or '?'}; hears {row.neighbours or '?'}; tick p50/p99 {row.tick or '?'} ms; "
        f"packets rx/lost/bad {row.packets or '?'}"
        for row in picture
    ]
