"""Monte Carlo studies behind ``fleetloc bench table1`` (tick by tick, as the paper) and ``accuracy`` (flown)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from estimators.settings import EstimatorSettings
from fleetloc.bench.plots import curves, save
from fleetloc.bench.sweep import Point, fly, numbered, show, steady_from
from fleetloc.output import print_table, progress_bar, with_error
from sim_bridge.studies.monte_carlo import Method, run_study, table1_row
from sim_bridge.studies.study_scenario import GRAPHS, StudyScenario, graph_of

PAPER_TABLE1 = {
    "dekf_ci": (2.7651, 0.7059),
    "dmhe": (1.6371, 0.6906),
    "dmhe_pre_ekf": (1.7009, 0.6104),
    "dmhe_pre_ekf_2": (1.6709, 0.5980),
}
"""RMSE and final RMSE that the paper prints."""


def table1(
    *, runs: int, seed: int, period_s: float, samples: int, other_accel_variance: float, start: str
) -> dict[str, Any]:
    """Run the four methods of Table I, print the table, return it."""
    common = EstimatorSettings(other_accel_variance=other_accel_variance, max_iterations=500)
    methods = {
        "dekf_ci": replace(common, kind="dekf_ci"),
        "dmhe": replace(common, kind="dmhe"),
        "dmhe_pre_ekf": replace(common, kind="dmhe_pre_ekf"),
        "dmhe_pre_ekf_2": replace(common, kind="dmhe_pre_ekf", rounds=2),
    }
    scenario = StudyScenario("line", samples, period_s, "paper" if start == "paper" else "good")
    with progress_bar("runs", runs * len(methods)) as advance:
        study = run_study(scenario, methods, runs, seed, advance, flown=False)
    rows = {name: table1_row(sample, samples) for name, sample in study.items()}
    print_table(
        ["method", "mean error", "final error", "step ms", "not converged", "fell back", "paper: mean", "final"],
        [
            [
                name,
                with_error(row["norm_full_mean"], row["norm_full_mean_se"]),
                with_error(row["norm_full_final"], row["norm_full_final_se"]),
                f"{1e3 * row['step_time_mean_s']:.3f}",
                str(study[name].not_converged),
                str(study[name].fell_back),
                *(f"{value:.4f}" for value in PAPER_TABLE1[name]),
            ]
            for name, row in rows.items()
        ],
        title=f"Norm of the fleet-state error, tick by tick, {runs} runs, t = 1..{samples} and t = {samples}",
    )
    settings = {
        "runs": runs,
        "seed": seed,
        "period_s": period_s,
        "samples": samples,
        "other_accel_variance": other_accel_variance,
        "start": start,
    }
    return {"settings": settings, "rows": rows}


def accuracy(
    *, runs: int, seed: int, scenario: StudyScenario, methods: Mapping[str, Method], sweeps: Sequence[Point] = (),
    jobs: int = 1, out: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run methods on one scenario and along axes, print accuracy and consistency, return all figures."""
    base, *along = fly([Point("", "", None, scenario), *sweeps], methods, runs=runs, seed=seed, jobs=jobs)
    first, last = steady_from(scenario.samples), scenario.samples
    print_table(
        ["method", "steady", "transient", "all samples", "own position m", "own velocity m/s", "ANEES", "ANEES own",
         "failures", "availability", "kB/s sent"],
        [_line(name, row) for name, row in base.rows.items()],
        title=f"{scenario.graph}, {runs} runs, steady t = {first}..{last} (mean ± standard error over runs)",
    )  # fmt: skip
    axes = list(dict.fromkeys(each.point.axis for each in along))
    for axis in axes:
        some = [each for each in along if each.point.axis == axis]
        show(some, f"{AXES[axis]}, {runs} runs")
        if out is not None and len(numbered(some, axis)) > 1:
            save(curves(numbered(some, axis), AXES[axis]), out, axis)
    settings = {
        "runs": runs,
        "seed": seed,
        "graph": scenario.graph,
        "samples": scenario.samples,
        "period_s": scenario.period_s,
        "start": scenario.start,
        "blind": scenario.blind,
        "steady_from": first,
    }
    return {"settings": settings, "rows": base.rows, "points": [each.document() for each in along]}


AXES = {
    "agents": "number of drones",
    "gps_share": "share of drones with GPS",
    "start_offset_m": "error of the start, m",
}
"""What an accuracy study can be repeated along, in words."""


def sweep_points(
    scenario: StudyScenario,
    family: str,
    agents: Sequence[int],
    gps_shares: Sequence[float],
    offsets_m: Sequence[float],
) -> list[Point]:
    """Fleets of other sizes, other shares of GPS, other errors of the start; all else as in ``scenario``.

    Raises ``ValueError`` for a size that the family does not have.
    """
    n = GRAPHS[scenario.graph][0]
    found = []
    for size in agents:
        graph = graph_of(family, size)
        found.append(Point(graph, "agents", size, dataclasses.replace(scenario, graph=graph, blind=0)))
    for share in gps_shares:
        blind = n - round(share * n)
        name = f"{scenario.graph}, {n - blind} of {n} with GPS"
        found.append(Point(name, "gps_share", share, dataclasses.replace(scenario, blind=blind), None, blind == 0))
    for offset_m in offsets_m:
        moved = dataclasses.replace(scenario, start_offset_m=offset_m)
        found.append(Point(f"start {offset_m:g} m off", "start_offset_m", offset_m, moved, None, offset_m == 0))
    return found


def _line(name: str, row: Mapping[str, float | int]) -> list[str]:
    def cell(key: str, unit: str = "", digits: int = 3) -> str:
        if f"{key}{unit}" not in row:  # a flight too short to have a transient
            return "-"
        return with_error(row[f"{key}{unit}"], row[f"{key}_se{unit}"], digits)

    return [
        name,
        cell("norm_full_steady_mean"),
        cell("norm_full_transient_mean"),
        cell("norm_full_mean"),
        cell("own_position_steady_mean", "_m"),
        cell("own_velocity_steady_mean", "_mps"),
        cell("anees_full_steady_mean", digits=2),
        cell("anees_own_steady_mean", digits=2),
        str(row["failures"]),
        f"{row['availability_steady']:.4f}" if "availability_steady" in row else "-",
        f"{row['sent_all_bytes_per_s'] / 1e3:.1f}" if "sent_all_bytes_per_s" in row else "-",
    ]
