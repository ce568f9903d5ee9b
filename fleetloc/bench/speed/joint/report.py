"""How the study of the joint windows is shown."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from fleetloc.bench.speed.joint.study import OURS, JointResult

MEANING = {
    "ours": "the optimum of the window and its next arrival cost, without consensus and covariance",
    "acados": "setting references, changed weights and start, and solving, in a process of its own",
    "distance": f"largest component difference to {OURS} over all states and windows, m or m/s",
}


def show(console: Console, results: Sequence[JointResult]) -> None:
    """One table per fleet."""
    for fleet in results:
        title = (
            f"joint windows, n={fleet.agents} ({fleet.graph}), N={fleet.window_ticks}, "
            f"{fleet.rows_per_window} rows in the first"
        )
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
        table.add_column("method", no_wrap=True)
        for heading in ("median us", "p99 us", "solves", "/ ours 1e-9", "distance", "failed"):
            table.add_column(heading, justify="right", no_wrap=True)
        for name, method in fleet.methods.items():
            table.add_row(
                name,
                f"{method.cpu_median_us:.0f}",
                f"{method.cpu_p99_us:.0f}",
                str(method.timed_solves),
                f"{method.over_ours:.2f}",
                f"{method.distance_max:.0e}",
                str(method.not_converged or ""),
            )
        console.print(table)
        for sentence in fleet.missing:
            console.print(f"{sentence}\n", highlight=False)
