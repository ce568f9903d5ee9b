"""``fleetloc bench scale``: what an agent of a large fleet costs, and what it knows, over the size of the fleet.

Every size is flown with the joint state of the configuration's default; sizes of ``whole`` besides with a joint state
that holds the whole fleet, on the same graphs and seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import typer

from fleetloc.bench.scale_flights import FAR, NEAR, ScaleFlight, ScaleFlown, fly
from fleetloc.output import print_table, progress_bar
from sim_bridge.studies.monte_carlo import Hangar

Figures = dict[str, Any]


def scale(
    *, sizes: Sequence[int], whole: Sequence[int], joint_bodies: int, runs: int, seed: int, duration_s: float,
    settle_s: float, degree: float, timed: int, jobs: int,
) -> dict[str, Any]:  # fmt: skip
    """Fly ``runs`` seeds of every size, print the table, return all figures."""
    plans = [(size, joint_bodies) for size in sizes] + [(size, max(size, 2)) for size in whole]
    plans = list(dict.fromkeys(plans))
    flights = [
        ScaleFlight(size, each, joint, duration_s, settle_s, degree, timed)
        for size, joint in plans
        for each in range(seed, seed + runs)
    ]
    flown: list[ScaleFlown] = []
    with Hangar(min(jobs, len(flights))) as hangar, progress_bar("flights", len(flights)) as advance:
        for one in hangar.map(fly, flights):
            flown.append(one)
            advance()
    rows = [_figures(size, joint, flown[k * runs : (k + 1) * runs]) for k, (size, joint) in enumerate(plans)]
    results = {
        "settings": {
            "runs": runs, "seed": seed, "duration_s": duration_s, "settle_s": settle_s, "mean_degree": degree,
            "joint_bodies": joint_bodies, "timed_agents": timed,
        },
        "rows": rows,
        "ratios": _ratios(rows, joint_bodies),
    }  # fmt: skip
    _show(results, runs)
    return results


def _figures(size: int, joint: int, flown: Sequence[ScaleFlown]) -> Figures:
    """The figures of a size, over its seeds; units are in the names, what is not known is NaN."""
    cpu_s = np.concatenate([one.cpu_s for one in flown])
    step_s = np.concatenate([one.step_s for one in flown])
    return {
        "drones": size,
        "joint_bodies": joint,
        "mean_degree": _mean(one.degree for one in flown),
        "joint_mean": _mean(one.joint for one in flown),
        "cpu_per_tick_s": float(cpu_s.mean()),
        "cpu_per_tick_largest_s": float(cpu_s.max()),
        "step_per_tick_s": float(step_s.mean()),
        "near_bytes_per_s": _mean(one.bytes_per_s[NEAR] for one in flown),
        "far_bytes_per_s": _mean(one.bytes_per_s[FAR] for one in flown),
        "largest_packet_bytes": max(one.largest_packet for one in flown),
        "own_rmse_m": _root_mean_square(one.own_rmse_m for one in flown),
        "own_anees": _mean(one.own_anees for one in flown),
        "far_rmse_m": _root_mean_square(one.far_rmse_m for one in flown),
        "far_anees": _mean(one.far_anees for one in flown),
        "far_age_mean_s": _mean(one.far_age_s[0] for one in flown),
        "far_age_largest_s": max(one.far_age_s[1] for one in flown),
        "shown_share": _mean(one.shown for one in flown),
    }


def _ratios(rows: Sequence[Figures], joint_bodies: int) -> list[Figures]:
    """Each size against the one before it, and the neighbourhood's error against the whole state's."""
    found = []
    near = sorted((row for row in rows if row["joint_bodies"] == joint_bodies), key=lambda row: row["drones"])
    for small, large in pairwise(near):
        names = ("cpu_per_tick_s", "near_bytes_per_s", "far_bytes_per_s", "own_rmse_m")
        ratios = {name: large[name] / small[name] if small[name] else float("nan") for name in names}
        found.append({"from_drones": small["drones"], "to_drones": large["drones"], **ratios})
    for row in rows:
        for other in near:
            if row["joint_bodies"] >= row["drones"] == other["drones"] > joint_bodies:
                ratio = other["own_rmse_m"] / row["own_rmse_m"]
                found.append({"drones": row["drones"], "own_rmse_m_neighbourhood_to_whole": ratio})
    return found


def _mean(values: Any) -> float:
    return float(np.mean(list(values)))


def _root_mean_square(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _show(results: Figures, runs: int) -> None:
    settings = results["settings"]
    print_table(
        ["drones", "joint state", "CPU ms/tick", "of it step", "near kB/s", "far kB/s", "largest B",
         "own RMSE m", "ANEES", "far RMSE m", "far age s (max)", "shown %"],
        [_row(row) for row in results["rows"]],
        title=f"{runs} seed(s), mean degree {settings['mean_degree']:g}, {settings['duration_s']:g} s",
    )  # fmt: skip
    for ratio in results["ratios"]:
        if "to_drones" in ratio:
            between = f"{ratio['from_drones']} -> {ratio['to_drones']} drones"
            figures = ("CPU", "cpu_per_tick_s"), ("near bytes", "near_bytes_per_s"), ("far bytes", "far_bytes_per_s")
            told = ", ".join(f"{what} x {ratio[name]:.3g}" for what, name in figures)
        else:
            between = f"{ratio['drones']} drones"
            told = f"own error x {ratio['own_rmse_m_neighbourhood_to_whole']:.3f} of the whole state's"
        typer.echo(f"{between}: {told}")


def _row(row: Figures) -> list[str]:
    beyond = row["drones"] > row["joint_bodies"]
    return [
        str(row["drones"]),
        f"{row['joint_mean']:.1f}" if beyond else "whole",
        f"{1e3 * row['cpu_per_tick_s']:.1f}",
        f"{1e3 * row['step_per_tick_s']:.1f}",
        f"{1e-3 * row['near_bytes_per_s']:.1f}",
        f"{1e-3 * row['far_bytes_per_s']:.2f}",
        str(row["largest_packet_bytes"]),
        f"{row['own_rmse_m']:.3f}",
        f"{row['own_anees']:.2f}",
        f"{row['far_rmse_m']:.2f}" if beyond else "-",
        f"{row['far_age_mean_s']:.2f} ({row['far_age_largest_s']:.1f})" if beyond else "-",
        f"{100 * row['shown_share']:.1f}",
    ]
