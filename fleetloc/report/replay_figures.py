"""The figures of a replay: what goes into its ``report.json``, and the series that its plots show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.config.reading import effective
from estimators.model.layout import Layout
from fleetloc.report.fleet_report import counted_packets, counted_sensors, mean_known, root_mean_square
from fleetloc.run import run_files
from fleetloc.run.replay_run import Replayed
from fleetloc.run.replay_setup import Prepared
from sim_bridge.replay.comparison import Compared, ComparedTracks, Errors, Phase, compare, first_estimate_s
from sim_bridge.replay.logs.events import LogSource
from sim_bridge.replay.naming import names_apart
from sim_bridge.replay.tracks import WrittenTrack, track_path

SETTLED_S = 10.0
"""Figures are also given from here on after an agent's first estimate, when its start is forgotten."""
USELESS = ("not located", "beyond the joint state", "heard: not used", "heard: too old")
"""Measurements that are left out although nothing is wrong with them."""
ALL, SETTLED = "all", "after_10s"


@dataclass(frozen=True, slots=True)
class ReplayResults:
    """A replay against what it can be compared with, by agent."""

    compared: dict[int, Compared]
    references: dict[int, ComparedTracks]
    phases: dict[int, list[Phase]]
    first_s: dict[int, float | None]
    """Fleet time of the first estimate; ``None`` where there never was one."""


def load_results(prepared: Prepared, directory: Path) -> ReplayResults:
    """Compare the records in a folder with the tracks beside them, agent by agent."""
    config, layout = prepared.config, Layout(prepared.config.ids)
    agents = [vehicle.agent_id for vehicle in prepared.inputs.plan.vehicles]
    references = {
        agent_id: ComparedTracks(
            *(
                WrittenTrack(track_path(directory, kind, agent_id))
                for kind in ("truth", "autopilot", "gps", "gps_received")
            )
        )
        for agent_id in agents
    }
    compared, phases, first_s = {}, {}, {}
    for agent_id in agents:
        record = run_files.record_path(directory, agent_id)
        first_s[agent_id] = first_estimate_s(record, layout, agent_id)
        phases[agent_id] = _phases(prepared, first_s[agent_id])
        compared[agent_id] = compare(record, layout, agent_id, references, phases[agent_id], config.fleet.period_s)
    return ReplayResults(compared, references, phases, first_s)


def _phases(prepared: Prepared, first_s: float | None) -> list[Phase]:
    """The parts of one agent's run; that of a drop of GPS or a fault is given for every agent."""
    inputs = prepared.inputs
    begin_s = inputs.from_s if first_s is None else first_s
    phases = [Phase(ALL, begin_s, inputs.to_s), Phase(SETTLED, begin_s + SETTLED_S, inputs.to_s)]
    for agent_id, windows in inputs.drops.windows.items():
        for from_s, to_s in windows:
            zero_s = inputs.plan.zero_s
            name = f"gps of {agent_id} dropped {from_s - zero_s:.0f}..{to_s - zero_s:.0f} s"
            phases.append(Phase(name, max(from_s, begin_s), to_s))
    for fault in inputs.injection.faults:
        from_s, to_s = inputs.plan.zero_s + fault.from_s, min(inputs.plan.zero_s + fault.end_s, inputs.to_s)
        name = f"{fault.__struct_config__.tag} {fault.from_s:.0f}..{to_s - inputs.plan.zero_s:.0f} s"
        phases.append(Phase(name, max(from_s, begin_s), to_s))
    return phases


def report_figures(prepared: Prepared, replayed: Replayed, results: ReplayResults) -> dict[str, Any]:
    """The content of ``report.json`` but for how long it all took; units are in the names, what is not known is null.

    Times are seconds from where all logs are there; without such a time, from the start of the first.
    """
    inputs, counts = prepared.inputs, replayed.counts
    zero_s = inputs.plan.zero_s
    duration_s = max(counts.last_s - inputs.from_s - counts.left_out_s, prepared.config.fleet.period_s)
    names = names_apart(source.path for source in prepared.sources)
    agents = [_of_agent(prepared, replayed, results, agent_id) for agent_id in results.compared]
    return {
        "config": effective(prepared.config),
        "mode": "replay",
        "seed": prepared.seed,
        "from_s": inputs.from_s - zero_s,
        "to_s": max(counts.last_s, inputs.from_s) - zero_s,
        "duration_s": duration_s,
        "all_there_s": None if inputs.plan.overlap_s is None else inputs.plan.overlap_s[1] - zero_s,
        "truth": prepared.truth_from,
        "ranges": prepared.ranges_from,
        "synthetic_ranges": prepared.synthetic,
        "origin": prepared.origin_from,
        "clocks": inputs.plan.clocks,
        "arrival": "stamped" if inputs.at_stamps else "logged",
        "gps_dropped": [
            {"agent": agent_id, "from_s": from_s - zero_s, "to_s": to_s - zero_s}
            for agent_id, windows in inputs.drops.windows.items()
            for from_s, to_s in windows
        ],
        "faults": inputs.injection.described(),
        "agents": agents,
        "fleet": _pooled(agents)
        | {
            "engine_wall_s": replayed.wall_s,
            "engine_cpu_s": replayed.cpu_s,
            "silences_left_out": counts.leaps,
            "left_out_s": counts.left_out_s,
            "ranges": dict(counts.ranges) | _range_lines(prepared) | _synthetic(prepared),
            "truth_lines_skipped": {
                str(agent_id): dict(file.skipped) for agent_id, file in prepared.truth_files.items() if file.skipped
            },
        },
        "logs": [_of_log(source, names[source.path]) for source in prepared.sources],
    }


def _pooled(agents: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all drones together, as a live run has them."""
    expected, on_time = (sum(agent[key] for agent in agents) for key in ("ticks_expected", "ticks_on_time"))
    without = sum(agent["ticks_without_estimate"] for agent in agents)
    return {
        "ticks_expected": expected,
        "ticks_on_time": on_time,
        "ticks_on_time_fraction": on_time / expected if expected else None,
        "availability": 1.0 - without / expected if expected else None,
        **{name: root_mean_square(agent[name] for agent in agents)
           for name in ("position_rmse_m", "position_rmse_after_10s_m", "norm_full_rms", "norm_full_rms_after_10s")},
        **{name: mean_known(agent[name] for agent in agents)
           for name in ("anees", "anees_own", "anees_after_10s")},
        "interrupted": False,
        "deaths": [],
    }  # fmt: skip


def _refused(counters: Mapping[str, int]) -> dict[str, int]:
    return {name.removeprefix("refused "): n for name, n in sorted(counters.items()) if is_refusal(name) and n}


def is_refusal(name: str) -> bool:
    """Whether a counter is of something that came and was not believed; what is late or of no use is not among it."""
    if name.removeprefix("refused ") in USELESS:
        return False
    return name.startswith(("refused ", "impossible ")) or name.endswith(": refused") or ": refused of" in name


def _of_agent(prepared: Prepared, replayed: Replayed, results: ReplayResults, agent_id: int) -> dict[str, Any]:
    compared, counters = results.compared[agent_id], Counter(replayed.counts.agents[agent_id])
    plan = prepared.inputs.plan
    vehicle = next(v for v in plan.vehicles if v.agent_id == agent_id)
    whole, settled = (_of_errors(compared.errors[name]) for name in (ALL, SETTLED))
    latency, first_s = replayed.latency.get(agent_id), results.first_s[agent_id]
    sensors = counted_sensors(counters)
    if latency is not None:
        _, sensors["gps"]["latency_s"], sensors["gps"]["latency_sigma_s"] = latency.table(3)[-1].tolist()
    return {
        "id": agent_id,
        "log": names_apart(source.path for source in prepared.sources)[vehicle.source.path],
        "system_id": vehicle.survey.system_id,
        "autopilot": vehicle.survey.flavour,
        "autopilot_estimate_frame": vehicle.survey.estimate_frame,
        "ticks_expected": compared.ticks,
        "ticks_on_time": counters["ticks"] - counters["ticks: late"],
        "ticks_without_estimate": compared.without_estimate,
        "first_estimate_s": None if first_s is None else first_s - plan.zero_s,
        "statuses": compared.statuses,
        **whole,
        "position_rmse_after_10s_m": settled["position_rmse_m"],
        "norm_full_rms_after_10s": settled["norm_full_rms"],
        "anees_after_10s": settled["anees"],
        "tick_time_p50_s": None,
        "tick_time_p99_s": None,
        "cpu_fraction": None,
        "rss_mb": None,
        "phases": {
            phase.name: {"from_s": phase.from_s - plan.zero_s, "to_s": phase.to_s - plan.zero_s}
            | _of_errors(compared.errors[phase.name])
            for phase in results.phases[agent_id]
        },
        "ticks_alarm": counters["ticks: alarm"],
        "said": replayed.said[agent_id].figures(plan.zero_s),
        "refused": _refused(counters),
        "integrity": of_integrity(counters),
        "fit": replayed.fit[agent_id].figures(),
        "packets": counted_packets(counters),
        "sensors": sensors,
        "counters": dict(sorted(counters.items())),
    }


def of_integrity(counters: Mapping[str, int]) -> dict[str, Any]:
    """Ticks in each state, and those in which fixes, by their drone, and ranges, by their pair, were found off."""
    begin = "integrity: "
    told = {name.removeprefix(begin): count for name, count in counters.items() if name.startswith(begin)}
    off = {name.split()[2]: count for name, count in told.items() if name.startswith("fixes of ")}
    pairs = {
        name.removeprefix("ranges of ").removesuffix(" off"): n
        for name, n in told.items()
        if name.startswith("ranges of ")
    }
    states = {name: count for name, count in told.items() if " of " not in name}
    return {"ticks": states, "ticks_fixes_off": off, "ticks_ranges_off": pairs}


def _of_errors(errors: Errors) -> dict[str, Any]:
    """One phase of one agent."""
    return {
        "position_rmse_m": errors.position.rms,
        "position_median_m": errors.position.percentile(50),
        "position_p95_m": errors.position.percentile(95),
        "horizontal_rmse_m": errors.horizontal.rms,
        "vertical_rmse_m": errors.vertical.rms,
        "norm_full_rms": errors.full_norm.rms,
        "anees": errors.nees.mean,
        "anees_own": errors.own_nees.mean,
        "ticks_with_truth": errors.horizontal.count,
        "autopilot_horizontal_rmse_m": errors.autopilot_horizontal.rms,
        "autopilot_vertical_rmse_m": errors.autopilot_vertical.rms,
        "gps_as_received_horizontal_rmse_m": errors.gps_received_horizontal.rms,
        "gps_as_received_vertical_rmse_m": errors.gps_received_vertical.rms,
        "gps_as_stamped_horizontal_rmse_m": errors.gps_horizontal.rms,
        "to_autopilot_horizontal_rms_m": errors.to_autopilot_horizontal.rms,
        "to_autopilot_vertical_rms_m": errors.to_autopilot_vertical.rms,
    }


def _range_lines(prepared: Prepared) -> dict[str, Any]:
    counts = prepared.inputs.range_counts
    if not counts.read and not counts.skipped:
        return {}
    return {"lines_read": counts.read, "lines_skipped": dict(counts.skipped), "first_bad_lines": counts.lines}


def _synthetic(prepared: Prepared) -> dict[str, Any]:
    """What became of the ranges to be made of the truth."""
    maker = prepared.inputs.synthesiser
    return {} if maker is None else {"synthetic": dict(maker.made)}


def _of_log(source: LogSource, name: str) -> dict[str, Any]:
    """What became of a log's content."""
    survey, counts = source.survey(), source.counts
    return {
        "file": name,
        "format": source.format,
        "duration_s": survey.last_s - survey.first_s,
        "unix_time_known_by": survey.unix.known_by,
        "systems": {
            str(system_id): {"flavour": system.flavour, "reboots": system.reboots, "truth": system.truth_from}
            for system_id, system in survey.systems.items()
        },
        "used": {str(system_id): dict(kinds) for system_id, kinds in counts.used.items()},
        "skipped": dict(counts.skipped),
        "notes": dict(counts.notes),
    }
