"""How the speed study is shown: tables for people, JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
from rich import box
from rich.console import Console
from rich.table import Table

from fleetloc.bench.speed.environment import describe
from fleetloc.bench.speed.fleet import report as fleet_report
from fleetloc.bench.speed.fleet.study import FleetPlan, FleetResult
from fleetloc.bench.speed.joint import report as joint_report
from fleetloc.bench.speed.joint.study import JointResult
from fleetloc.bench.speed.study import CaseResult, SizeResult, SpeedPlan

MEANING = {
    "ours": "fuse of the received pairs, window, next arrival cost; other solvers: the optimisation only",
    "plain_numpy": "whole step, three Gauss-Newton steps",
    "distance": "largest component difference to ours_1e-9 over the windows, m or m/s",
}


def as_document(
    plan: SpeedPlan,
    results: Sequence[SizeResult],
    fleet_plan: FleetPlan,
    fleets: Sequence[FleetResult],
    joint: Sequence[JointResult],
) -> dict[str, Any]:
    """The JSON document; a figure that does not apply is nan."""
    return {
        "command": "bench speed",
        "seed": plan.seed,
        "repeats": plan.repeats,
        "windows": plan.windows,
        "machine": describe(),
        "meaning": MEANING,
        "sizes": msgspec.to_builtins(list(results)),
        "whole_step": {
            "kinds": list(fleet_plan.kinds),
            "ticks": fleet_plan.ticks,
            "rounds": fleet_plan.rounds,
            "meaning": fleet_report.MEANING,
            "fleets": msgspec.to_builtins(list(fleets)),
        },
        "joint_windows": {"meaning": joint_report.MEANING, "fleets": msgspec.to_builtins(list(joint))},
    }


def show(console: Console, results: Sequence[SizeResult]) -> None:
    """One table per size and case."""
    for size in results:
        for case in size.cases:
            console.print(_table(size, case))
            console.print(_verdict(case), "\n", sep="", highlight=False)


def _table(size: SizeResult, case: CaseResult) -> Table:
    title = (
        f"n={size.agents} ({size.graph}), N={size.window_ticks}, {size.rows_per_window} rows over "
        f"{size.regional_agents} agents; {case.name} windows"
    )
    if case.name == "active":
        title += f", {min(case.active_bounds)} to {max(case.active_bounds)} active bounds"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("method", no_wrap=True)
    headings = ("median us", "p99 us", "solves", "/ ours 1e-9", "/ default", "dist. t-N", "dist. t", "failed")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    tight = case.methods["ours_1e-9"].cpu_median_us
    default = case.methods["ours_default"].cpu_median_us
    for name, method in case.methods.items():
        table.add_row(
            name,
            f"{method.cpu_median_us:.0f}",
            f"{method.cpu_p99_us:.0f}",
            str(method.timed_solves),
            f"{method.cpu_median_us / tight:.2f}",
            f"{method.cpu_median_us / default:.2f}",
            _scientific(method.first_state_distance_max),
            _scientific(method.last_state_distance_max),
            str(method.not_converged or ""),
        )
    return table


def _verdict(case: CaseResult) -> str:
    found = case.optimality
    text = (
        f"ours_1e-9 by casadi's figures: cost above IPOPT's {found.cost_excess_relative_max:.1e} (relative)"
    )
    if case.name == "free":
        return f"{text}, gradient {found.gradient_max:.1e}, step left {found.newton_step_max:.1e} m or m/s"
    return f"{text}, outside the box by {found.box_violation_max:.1e} m or m/s"


def _scientific(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0e}"
