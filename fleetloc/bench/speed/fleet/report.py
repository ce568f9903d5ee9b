"""How the study of the whole step is shown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from fleetloc.bench.speed.fleet.study import REFERENCE, RIVAL, FleetResult

MEANING = {
    "ours": "measurements and pairs of a tick in, mean and covariance of the fleet out, with consensus and monitors",
    "gtsam": "measurements of the whole fleet in, its newest means out; making the factors is not timed",
    "gtsam_incremental_covariances": "the same, and the covariance of each position and velocity, 3 by 3 each",
    "distance": f"largest component difference to {REFERENCE} over all states and timed ticks, m or m/s",
}


def show(console: Console, results: Sequence[FleetResult]) -> None:
    """One table per fleet."""
    for fleet in results:
        console.print(_table(fleet))
        for kind, ratio in fleet.over_incremental.items():
            console.print(f"{kind} takes {ratio:.2f} times {RIVAL}'s time\n", highlight=False)
        for sentence in fleet.missing:
            console.print(sentence, highlight=False)


def _table(fleet: FleetResult) -> Table:
    title = (
        f"whole step, n={fleet.agents} ({fleet.graph}), lag {fleet.lag_ticks} ticks, "
        f"{fleet.rows_per_tick} rows a tick, {fleet.timed_steps} steps each"
    )
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("method", no_wrap=True)
    for heading in ("median us", "p99 us", "/ ours", "own error m", "fleet error m", "distance"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, step in fleet.steps.items():
        table.add_row(
            name,
            f"{step.cpu_median_us:.0f}",
            f"{step.cpu_p99_us:.0f}",
            f"{step.over_ours:.2f}",
            f"{step.own_error_rms:.4f}",
            f"{step.fleet_error_rms:.4f}",
            "-" if math.isnan(step.distance_max) else f"{step.distance_max:.0e}",
        )
    return table
