"""The figures of a run: ``report.json``, the table on the terminal and the page with the plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import typer

from agent.config.reading import effective
from agent.config.tables import FleetConfig
from estimators.integrity.consistency import rms
from fleetloc.extras import is_installed, sentence
from fleetloc.output import print_table, write_json
from fleetloc.report.fleet_results import AgentTrack, FleetResults, Floats, load_results
from fleetloc.report.report_html import page
from fleetloc.report.target_results import COLUMNS as TARGET_COLUMNS
from fleetloc.report.target_results import target_cells
from fleetloc.run import run_files
from fleetloc.run.fleet_run import RunOutcome
from fleetloc.verdict import verdict
from sim_bridge.world.sim_table import sim_table
from transport.messages.report_body import Diagnostics

SETTLED_S = 10.0
"""Errors are also given from here on, when what an agent knew at its start is forgotten."""
SENSORS = {
    "imu": "imu", "attitude": "attitude", "gps": "gps", "baro": "baro", "ground": "ground", "odometry": "odometry",
    "flow": "flow", "range": "uwb",
}  # fmt: skip
"""Names of the core's counters, and of the counters of what was left out before."""
LEFT_OUT = (
    "switched off", "place unknown", "more than are needed", "always the same", "attitude unknown", "too much tilt",
    "nothing measured", "height unknown", "contradicts the estimate",
)  # fmt: skip
"""Why the core uses no sample of a sensor that came in time."""


def write_report(
    config: FleetConfig,
    directory: Path,
    outcome: RunOutcome,
    json_file: Path | None,
    mode: str,
    required: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Read the run's files, write ``report.json`` and ``report.html``, print the figures; returns them.

    Their ``verdict`` says whether the run was as wanted; ``required`` are the limits of `fleetloc.verdict`.
    Files that cannot be read are named, and done without.
    """
    results = load_results(config, directory)
    figures = report_figures(config, results, directory, outcome, mode)
    found = verdict(figures, required or {})
    figures["verdict"] = {"line": found.line, "failed": found.failed}
    for line in results.unread:
        typer.echo(f"fleetloc: left out: {line}", err=True)
    for path in (directory / run_files.REPORT_JSON, *([json_file] if json_file else [])):
        write_json(path, figures)
    _print(figures)
    typer.echo(found.line)
    html = page(config, results, figures, outcome.plots_until_s)
    (directory / run_files.REPORT_HTML).write_text(html, encoding="utf-8")
    if not is_installed("report"):
        typer.echo(f"note: {sentence('report', f'{run_files.REPORT_HTML} has no plots')}")
    return figures


def report_figures(
    config: FleetConfig, results: FleetResults, directory: Path, outcome: RunOutcome, mode: str
) -> dict[str, Any]:
    """The content of ``report.json``; units are in the names, what is not known is null."""
    agents = []
    for track in results.tracks:
        lives = _lives(directory, track.agent_id, outcome.lives.get(track.agent_id, []))
        use = outcome.use.get(track.agent_id)
        gauges = lives[-1].gauges if lives else {}
        agents.append(
            _of_track(track)
            | {
                "cpu_fraction": (use.cpu_fraction if use else None) or gauges.get("cpu_fraction"),
                "rss_mb": (use.rss_mb if use else None) or gauges.get("rss_mb"),
            }
            | _of_counters(lives)
        )
    names = {target.id: target.name for target in config.targets}
    return {
        "config": effective(config),
        "mode": mode,
        "seed": sim_table(config).seed,
        "duration_s": results.duration_s,
        "truth": "simulator",
        "agents": agents,
        "targets": [
            {"id": track.target_id, "name": names.get(track.target_id, "")} | track.figures()
            for track in results.targets
        ],
        "fleet": _of_fleet(results, agents)
        | {
            "wall_s": outcome.wall_s,
            "times_real_time": results.duration_s / outcome.wall_s if outcome.wall_s > 0.0 else None,
            "interrupted": outcome.interrupted,
            "deaths": [{"name": d.name, "at_s": d.at_s, "why": d.why} for d in outcome.deaths],
            "simulator": _simulator(directory),
        },
    }


def _of_track(track: AgentTrack) -> dict[str, Any]:
    known, settled = track.known, track.known & (track.time_s >= SETTLED_S)
    served, later = track.served, track.served.time_s >= SETTLED_S
    return {
        "id": track.agent_id,
        "ticks_expected": track.ticks_expected,
        "ticks_on_time": int(np.count_nonzero(track.on_time)),
        "ticks_without_estimate": track.ticks_expected - int(np.count_nonzero(known)),
        "daemons": track.records,
        "availability": served.availability(),
        "availability_after_10s": served.availability(SETTLED_S),
        "position_rmse_m": _rms(served.own_error_m),
        "position_rmse_after_10s_m": _rms(served.own_error_m[later]),
        "norm_full_rms": _rms(served.full_error),
        "norm_full_rms_after_10s": _rms(served.full_error[later]),
        "anees": _mean(track.nees[known]),
        "anees_after_10s": _mean(track.nees[settled]),
        "tick_time_p50_s": _percentile(track.tick_time_s, 50),
        "tick_time_p99_s": _percentile(track.tick_time_s, 99),
        "publish_latency_p50_s": _percentile(track.latency_s, 50),
        "publish_latency_p99_s": _percentile(track.latency_s, 99),
    }


def _of_counters(lives: list[Diagnostics]) -> dict[str, Any]:
    """What all daemons of one agent counted together."""
    total: Counter[str] = Counter()
    for life in lives:
        total.update(life.counters)
    sensors = counted_sensors(total)
    gauges = lives[-1].gauges if lives else {}
    if lives:  # of the last daemon: the latency that it assumes, or has estimated on line
        sensors["gps"] |= {
            "latency_s": gauges.get("gps_latency_s"),
            "latency_sigma_s": gauges.get("gps_latency_sigma_s"),
        }
    fit = {name: value for name, value in gauges.items() if name.startswith(("nis_", "weight_"))}
    return {
        "ticks_alarm": total["ticks: alarm"],
        "fit": fit,
        "packets": counted_packets(total),
        "sensors": sensors,
    }


def counted_packets(total: Counter[str]) -> dict[str, Any]:
    """An agent's packets, out of its counters."""
    return {
        "sent": total["packets sent"],
        "received": total["packets received"],
        "lost": total["packets lost"],
        "injected_losses": total["injected losses"],
        "late": total["measurements: late"] + total["information: late"],
        "rejected": {name.removeprefix("rejected "): n for name, n in total.items() if name.startswith("rejected ")},
    }


def counted_sensors(total: Counter[str]) -> dict[str, dict[str, Any]]:
    """An agent's sensors, out of its counters."""
    return {name: _of_sensor(name, left_out, total) for name, left_out in SENSORS.items()}


def _of_sensor(name: str, left_out: str, total: Counter[str]) -> dict[str, Any]:
    """What came of a sensor and what became of it; each sample is in one of the numbers but ``received``."""
    reasons = {
        key.removeprefix(f"skipped {left_out}").lstrip(": "): count
        for key, count in total.items()
        if key.startswith(f"skipped {left_out}") and count
    }
    late = total[f"{name}: late"] + reasons.pop("late", 0)
    for reason in ("wrong time", "refused", "not ours", "not located", *LEFT_OUT):
        if total[f"{name}: {reason}"]:
            reasons[reason] = reasons.get(reason, 0) + total[f"{name}: {reason}"]
    if total[f"{name}: waiting"]:
        reasons["in no tick"] = reasons.get("in no tick", 0) + total[f"{name}: waiting"]
    return {
        "received": total[f"{name}: received"] + reasons.get("dropped on request", 0),
        "used": total[f"{name}: used"] - total[f"{name}: not located"],
        "skipped": sum(reasons.values()),
        "skipped_by_reason": reasons,
        "late": late,
        "latency_s": None,
        "latency_sigma_s": None,
    }


def _of_fleet(results: FleetResults, agents: list[dict[str, Any]]) -> dict[str, Any]:
    expected, on_time = (sum(agent[key] for agent in agents) for key in ("ticks_expected", "ticks_on_time"))
    packets = {key: sum(agent["packets"][key] for agent in agents) for key in ("sent", "received", "lost", "late")}
    rejected: Counter[str] = Counter()
    for agent in agents:
        rejected.update(agent["packets"]["rejected"])
    times = np.concatenate([track.tick_time_s for track in results.tracks])
    return {
        "ticks_expected": expected,
        "ticks_on_time": on_time,
        "ticks_on_time_fraction": on_time / expected if expected else None,
        **{key: root_mean_square(agent[key] for agent in agents) for key in
           ("position_rmse_m", "position_rmse_after_10s_m", "norm_full_rms", "norm_full_rms_after_10s")},
        **{key: mean_known(agent[key] for agent in agents) for key in
           ("anees", "anees_after_10s", "availability", "availability_after_10s")},
        "tick_time_p50_s": _percentile(times, 50),
        "tick_time_p99_s": _percentile(times, 99),
        "cpu_fraction": _sum_known(agent["cpu_fraction"] for agent in agents),
        "rss_mb": _sum_known(agent["rss_mb"] for agent in agents),
        "packets": {**packets, "rejected": dict(rejected)},
    }  # fmt: skip


def _lives(directory: Path, agent_id: int, heard: list[Diagnostics]) -> list[Diagnostics]:
    """The last word of every daemon; the last one's own summary is newer than what was heard of it."""
    summary = run_files.record_path(directory, agent_id).with_suffix(run_files.SUMMARY_SUFFIX)
    if not summary.exists():
        return heard
    content = msgspec.json.decode(summary.read_bytes())
    final = Diagnostics(agent_id, content["state"], (), content["counters"], content["gauges"])
    return [*heard[:-1], final]


def _simulator(directory: Path) -> dict[str, Any] | None:
    path = directory / run_files.SIMULATOR_JSON
    content: dict[str, Any] | None = msgspec.json.decode(path.read_bytes()) if path.exists() else None
    return content


def _rms(errors: Floats) -> float | None:
    return rms(errors) if len(errors) else None


def _mean(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def _percentile(values: Floats, percent: float) -> float | None:
    """``None`` too where nothing was measured: virtual time has no computing time."""
    return float(np.percentile(values, percent)) if len(values) and values.any() else None


def root_mean_square(values: Iterable[float | None]) -> float | None:
    """Of those that are known; ``None`` of none."""
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def mean_known(values: Iterable[float | None]) -> float | None:
    """The mean of those that are known; ``None`` of none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _sum_known(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.sum(known)) if known else None


def _shown(value: float | None, digits: int = 3, factor: float = 1.0) -> str:
    """A figure for people."""
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _print(figures: dict[str, Any]) -> None:
    columns = ["agent", "ticks on time", "available %", "RMSE m", "after 10 s", "fleet error", "ANEES"]
    columns += ["tick p50/p99 ms", "CPU %", "MB"]
    rows = [
        [
            str(row.get("id", "fleet")),
            f"{row['ticks_on_time']}/{row['ticks_expected']}",
            _shown(row["availability"], 1, 100.0),
            _shown(row["position_rmse_m"]),
            _shown(row["position_rmse_after_10s_m"]),
            _shown(row["norm_full_rms"]),
            _shown(row["anees"], 2),
            f"{_shown(row['tick_time_p50_s'], 1, 1e3)}/{_shown(row['tick_time_p99_s'], 1, 1e3)}",
            _shown(row["cpu_fraction"], 1, 100.0),
            _shown(row["rss_mb"], 0),
        ]
        for row in (*figures["agents"], figures["fleet"])
    ]
    print_table(columns, rows)
    if figures["targets"]:
        print_table([title for title, _ in TARGET_COLUMNS], [target_cells(row) for row in figures["targets"]])
