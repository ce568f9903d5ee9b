"""What has to hold of a daemon under attack: its counters, its memory, its ticks and its estimates.

A machine that does other things too makes packets and range frames late and a simulator stand still. That is known
from others than the daemon: a witness that only sleeps and wakes, the simulator's own report, the flight record. What
they say is allowed for; on a machine that does nothing else it is nothing.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent.config.tables import FleetConfig
from agent.inputs import UwbIn
from agent.log.flight_reader import FlightReader, RecordedInput
from agent.uwb.adapter import MAX_AGE_S
from fleetloc.report.fleet_results import load_results
from fleetloc.run import run_files
from tests.fleet.fuzz_attack import Attack, growth
from tests.fleet.fuzz_traffic import NEVER_ARRIVE, REJECTED_UWB, TARGET
from tests.support.fleet_process import FleetProcess
from tests.support.lossnet.delivery import MCAP
from tests.support.machine import Witness
from tests.support.own_error import own_nees, own_position_complaints
from transport.errors import Rejected
from transport.messages.uwb_body import decode_uwb

MAX_GROWTH_MB, MIN_ON_TIME = 8.0, 0.95
OWN_CLOCK = "mono"
"""Of the range frames of a daemon's own module; hostile ones have the time in UTC."""
LATE_S = 0.002
"""An idle machine wakes a process within this."""
SHARED = "timesync rejected"
"""The autopilot's own answers are counted here too, if they take long on a busy machine: one question a second."""
STALE_UWB = "rejected uwb stale"
AGES = ("uwb unusable", "skipped uwb not a neighbour")
"""What is wrong with these range frames is seen only if they arrive while they are fresh."""


def figures(config: FleetConfig, fleet: FleetProcess, attack: Attack, witness: Witness) -> dict[str, Any]:
    """What the run's files and counters tell, machine-readable."""
    results = load_results(config, fleet.out)
    begin_s, end_s = (t - results.start_unix_s for t in (attack.begin_s, attack.end_s))
    simulator = msgspec.json.decode((fleet.out / run_files.SIMULATOR_JSON).read_bytes())
    agents = []
    for track in results.tracks:
        inside = (track.time_s >= begin_s) & (track.time_s < end_s)
        error_m = np.linalg.norm(track.own_error_m[inside & track.known], axis=1)
        squared = own_nees(config, fleet.out, track.agent_id, attack.begin_s, attack.end_s)
        expected = int((end_s - begin_s) / results.period_s)
        agents.append(
            {
                "id": track.agent_id,
                "ticks_expected": expected,
                "ticks_made": int(np.count_nonzero(inside)),
                "ticks_on_time": int(np.count_nonzero(track.on_time & inside)),
                "ticks_without_estimate": int(np.count_nonzero(~track.known & inside)),
                "late_packets": late_packets(fleet, track.agent_id),
                "all_finite": bool(np.isfinite(track.full_error).all() and np.isfinite(track.own_sigma_m).all()),
                "position_rmse_m": float(np.sqrt(np.mean(error_m**2))),
                "own_nees_mean": float(squared.mean()),
                "own_nees_worst": float(squared.max()),
                "own_position_complaints": own_position_complaints(f"agent {track.agent_id}", squared),
                "log_has_traceback": "Traceback" in fleet.log(track.agent_id),
            }
        )
    delta, mb = growth(attack.before, attack.after), attack.resident_mb
    return {
        "duration_s": attack.end_s - attack.begin_s,
        "packets": {"sent": attack.packets.total(), "by_class": dict(attack.packets)},
        "datagrams": {"sent": attack.datagrams.total(), "by_class": dict(attack.datagrams)},
        "counters": {name: {"expected": n, "found": delta[name]} for name, n in sorted(attack.expected.items())},
        "rejected_by_reason": {n: v for n, v in sorted(delta.items()) if n.startswith("rejected ") and v},
        "packets_shed": delta["packets shed"],
        "packets_lost_of_neighbours": delta["packets lost"],
        "packets_of_neighbours": delta["packets received"],
        "program_faults": delta["program faults"],
        "reboots": delta["mavlink reboots"],
        "socket_drops": attack.socket_drops,
        "unheard_streams_matched": attack.unheard_matched,
        "resident_mb_before": mb[0],
        "resident_mb_after": mb[-1],
        "resident_mb": mb,
        "watched_s": attack.after_s - attack.before_s,
        "machine_late_s": witness.lost_s(attack.before_s, attack.after_s, beyond_s=LATE_S),
        "simulator_behind_s": simulator["max_behind_s"],
        "window_s": config.estimator.window * results.period_s,
        "own_ranges_aged": own_ranges_aged(fleet.out, attack.before_s - time.time() + time.monotonic()),
        "agents": agents,
    }


def late_packets(fleet: FleetProcess, agent_id: int) -> int:
    """Of neighbours, in the whole run: too late for their tick, so used for a later one or not at all."""
    summary = run_files.record_path(fleet.out, agent_id).with_suffix(run_files.SUMMARY_SUFFIX)
    counters = msgspec.json.decode(summary.read_bytes())["counters"]
    return sum(int(counters.get(f"{kind}: late", 0)) for kind in ("measurements", "information"))


def own_ranges_aged(directory: Path, since_s: float) -> int:
    """Range frames of the attacked daemon's own module that came too old, from a second of the monotonic clock on."""
    entries = FlightReader(run_files.record_path(directory, TARGET).with_suffix(MCAP))
    events = [entry.event for entry in entries if isinstance(entry, RecordedInput)]
    frames = [event for event in events if isinstance(event, UwbIn) and event.host_s >= since_s]
    return sum(event.host_s - measured_s(event.data) > MAX_AGE_S for event in frames)


def measured_s(payload: bytes) -> float:
    """When a frame of the daemon's own module was measured, on the monotonic clock; infinite for a hostile one."""
    try:
        frame = decode_uwb(payload)
    except Rejected:
        return math.inf
    return frame.t_ns * 1e-9 if frame.clock == OWN_CLOCK else math.inf


def complaints(result: dict[str, Any]) -> list[str]:
    """What does not hold; empty for a daemon that withstood."""
    found = []
    counted = {name: dict(counts) for name, counts in result["counters"].items()}
    found += settle_aged(counted, result["rejected_by_reason"].get(STALE_UWB, 0), result["own_ranges_aged"])
    for name, counts in counted.items():
        excess = counts["found"] - counts["expected"]
        may_exceed = 2.0 * result["duration_s"] + 20 if name == SHARED else 0
        if name not in NEVER_ARRIVE and not 0 <= excess <= may_exceed:
            found.append(f"{name}: expected {counts['expected']}, counted {counts['found']}")
    for name in ("packets_shed", "program_faults", "reboots", "socket_drops"):
        if result[name]:
            found.append(f"{name}: {result[name]}")
    lost, came = result["packets_lost_of_neighbours"], result["packets_of_neighbours"]
    if lost * result["watched_s"] > (lost + came) * result["machine_late_s"]:
        late = f"the machine was late for {result['machine_late_s']:.3f} of {result['watched_s']:.1f} s"
        found.append(f"{lost} of {lost + came} packets of neighbours lost, though {late}")
    if result["unheard_streams_matched"]:
        found.append("a stream that no daemon should listen to has a subscriber")
    growth_mb = result["resident_mb_after"] - result["resident_mb_before"]
    if growth_mb > MAX_GROWTH_MB:
        found.append(f"resident memory grew by {growth_mb:.1f} MB, at most {MAX_GROWTH_MB:g} allowed")
    for agent in result["agents"]:
        who = f"agent {agent['id']}"
        if not agent["all_finite"]:
            found.append(f"{who}: estimates not finite")
        if agent["ticks_without_estimate"] and result["simulator_behind_s"] < result["window_s"]:
            found.append(
                f"{who}: {agent['ticks_without_estimate']} ticks without an estimate, though the world moved"
            )
        found += agent["own_position_complaints"]
        if agent["ticks_made"] < agent["ticks_expected"] - 1:
            found.append(f"{who}: {agent['ticks_made']} of {agent['ticks_expected']} ticks made")
        if agent["log_has_traceback"]:
            found.append(f"{who}: a traceback in its log")
    return found


def settle_aged(counted: dict[str, dict[str, int]], stale: int, own_aged: int) -> list[str]:
    """Count the range frames that grew stale on their way to a busy daemon as what they were sent as.

    A hostile one is then refused for its age before what is wrong with it is seen: it is missing from the counters of
    `AGES`, and one too many among the refused. Those of the daemon's own module, at most ``own_aged``, are too many
    among the refused only. Each of all these was counted as stale.
    """
    aged = counted[REJECTED_UWB]["found"] - counted[REJECTED_UWB]["expected"]
    missing = {name: counted[name]["expected"] - counted[name]["found"] for name in AGES if name in counted}
    own = aged - sum(missing.values())
    if 0 <= own <= own_aged and min(missing.values(), default=0) >= 0 and aged <= stale:
        for name in (REJECTED_UWB, *missing):
            counted[name]["found"] = counted[name]["expected"]
        return []
    return [
        f"range frames: {aged} too many refused, {stale} of all for their age, {own_aged} of the own module,"
        f" missing elsewhere: {missing}"
    ]


def lateness(result: dict[str, Any]) -> list[str]:
    """Who was not on time: says something on a machine that does nothing else."""
    return [
        f"agent {agent['id']}: {agent['ticks_on_time']} of {agent['ticks_expected']} ticks on time"
        for agent in result["agents"]
        if agent["ticks_on_time"] < MIN_ON_TIME * agent["ticks_expected"]
    ]
