"""The tables of a replay's report, for the terminal and the page."""

from __future__ import annotations

from typing import Any

from fleetloc.report.replay_figures import ALL, SETTLED
from fleetloc.run.replay_setup import NO_PLACE

ANEES_EXPLAINED = (
    "fleet ANEES: the squared error of all drones' positions and velocities, as this drone sees them, over what "
    "it claims; own ANEES: of its own alone. 1 is right, above it the drone is too sure, below too cautious. A drone "
    "may know itself well and claim too much of the others: then the two differ"
)
SPELLED = {SETTLED: "after 10 s"}
MOSTLY = 0.9
"""Share of the estimates with a truth below which a reader is told."""


def log_table(figures: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: what was used and skipped of each vehicle's log."""
    columns = ["log", "system", "agent", "s", "imu", "attitude", "gps", "ranges", "skipped", "why"]
    rows = []
    logs = {log["file"]: log for log in figures["logs"]}
    for agent in figures["agents"]:
        log = logs[agent["log"]]
        used = log["used"].get(str(agent["system_id"]), {})
        counted = {k.removeprefix("skipped "): n for k, n in agent["counters"].items() if k.startswith("skipped ")}
        skipped = log["skipped"] | {reason: n for reason, n in counted.items() if n}
        why = sorted(skipped.items(), key=lambda item: -item[1])[:3]
        rows.append(
            [
                agent["log"],
                f"{agent['system_id']} {agent['autopilot']}",
                str(agent["id"]),
                f"{log['duration_s']:.0f}",
                *(str(used.get(kind, 0)) for kind in ("imu", "attitude", "gps")),
                str(agent["sensors"]["range"]["used"]),
                str(sum(skipped.values())),
                "; ".join(f"{n} {reason}" for reason, n in why) or "-",
            ]
        )
    return columns, rows


def error_table(figures: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: errors in m by agent and phase."""
    columns = ["agent, phase", "RMSE", "horiz.", "median", "95 %", "fleet ANEES", "own ANEES", "autopilot horiz.",
               "GPS as received", "to autopilot"]  # fmt: skip
    rows = []
    for agent in figures["agents"]:
        for name, phase in agent["phases"].items():
            if name == ALL and phase["ticks_with_truth"] == agent["phases"][SETTLED]["ticks_with_truth"] != 0:
                continue
            if name == SETTLED and not phase["ticks_with_truth"] and agent["phases"][ALL]["ticks_with_truth"]:
                continue  # it ended before
            rows.append(
                [
                    f"{agent['id']}, {SPELLED.get(name, name)}",
                    *(
                        shown(phase[key])
                        for key in ("position_rmse_m", "horizontal_rmse_m", "position_median_m", "position_p95_m")
                    ),
                    shown(phase["anees"], 2),
                    shown(phase["anees_own"], 2),
                    shown(phase["autopilot_horizontal_rmse_m"]),
                    shown(phase["gps_as_received_horizontal_rmse_m"]),
                    shown(phase["to_autopilot_horizontal_rms_m"]),
                ]
            )
    return columns, rows


def fit_table(figures: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: normalised squared residuals by agent and sensor, mean and largest."""
    names = sorted({name for agent in figures["agents"] for name in agent["fit"]})
    columns = ["agent", *(name.removeprefix("nis_").replace("_", " ") for name in names), "ticks with alarm"]
    rows = [
        [
            str(agent["id"]),
            *(
                f"{shown(fit['mean'], 2)} / {shown(fit['max'], 2)}" if fit is not None else "-"
                for fit in (agent["fit"].get(name) for name in names)
            ),
            str(agent["ticks_alarm"]),
        ]
        for agent in figures["agents"]
    ]
    return columns, rows


def cautions(figures: dict[str, Any]) -> list[str]:
    """What a reader of the figures must know of them."""
    sentences = []
    if figures["origin"] == NO_PLACE:
        sentences.append("no log tells a place: there is no origin, no home and no fix in them")
    for agent in figures["agents"]:
        if agent["first_estimate_s"] is None:
            sentences.append(f"drone {agent['id']} ({agent['log']}) never had an estimate: no fixes, or none in time")
        gps = agent["sensors"]["gps"]
        if gps["late"]:
            window_s = figures["config"]["estimator"]["window"] * figures["config"]["fleet"]["period_s"]
            sentences.append(
                f"{gps['late']} of {gps['received']} fixes of drone {agent['id']} came later than the window of "
                f"{window_s:.1f} s: --arrival stamped, or a larger estimator.window"
            )
        estimated = agent["ticks_expected"] - agent["ticks_without_estimate"]
        if 0 < agent["ticks_with_truth"] < MOSTLY * estimated:
            known = f"{agent['ticks_with_truth']} of its {estimated} estimates"
            sentences.append(f"errors of drone {agent['id']} are of {known}: there is no truth for the others")
    if figures["all_there_s"] is None:
        sentences.append("the logs are never there all at once: times count from the start of the first")
    if figures["faults"]:
        kinds = ", ".join(fault["kind"] for fault in figures["faults"])
        sentences.append(f"faults were injected ({kinds}): this is not what the fleet flew")
    if figures["fleet"]["silences_left_out"]:
        sentences.append(f"{figures['fleet']['silences_left_out']} long silence(s) of the logs were left out")
    return sentences


def shown(value: float | None, digits: int = 3, factor: float = 1.0) -> str:
    """A figure for people."""
    return "-" if value is None else f"{factor * value:.{digits}f}"
