"""Whether a run was as wanted: one line, and what follows for the exit code."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleetloc.errors import InputError

OVERLOADED_BELOW = 0.9
"""Share of ticks on time below which a live run says more of the machine than of the fleet."""


@dataclass(frozen=True, slots=True)
class Limit:
    """What ``--require`` may ask of a figure of the fleet."""

    figure: str
    """In ``report.json``, of the fleet."""
    at_least: bool
    words: str


LIMITS = {
    "availability": Limit("availability", True, "availability"),
    "on_time": Limit("ticks_on_time_fraction", True, "share of ticks on time"),
    "rmse": Limit("position_rmse_m", False, "position RMSE in m"),
    "rmse_after_10s": Limit("position_rmse_after_10s_m", False, "position RMSE after 10 s in m"),
    "fleet_error": Limit("norm_full_rms", False, "fleet error"),
    "anees": Limit("anees", False, "ANEES"),
}


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """``line`` says how the run was; ``failed``, that it was not as wanted."""

    line: str
    failed: bool


def read_requirements(text: str) -> dict[str, float]:
    """Limits from ``availability=0.99,rmse=0.5``; raises `InputError`."""
    found: dict[str, float] = {}
    for part in filter(None, (each.strip() for each in text.split(","))):
        name, _, value = part.partition("=")
        if name not in LIMITS:
            raise InputError("--require", name, f"one of {', '.join(LIMITS)}", repr(part))
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = math.nan
        if not math.isfinite(found[name]):
            raise InputError("--require", name, f"a number, as {name}=0.9", repr(part))
    return found


def verdict(figures: Mapping[str, Any], required: Mapping[str, float]) -> RunVerdict:
    """Of the figures of a run, as ``report.json`` has them."""
    fleet, agents = figures["fleet"], figures["agents"]
    failures: list[str] = []
    notes: list[str] = []
    silent = [str(agent["id"]) for agent in agents if agent["ticks_without_estimate"] >= agent["ticks_expected"]]
    if len(silent) == len(agents):
        # whoever breaks a run off in its first second wants no estimate
        (notes if fleet["interrupted"] else failures).append("no drone had a single estimate")
    elif silent:
        notes.append(f"no estimate at all of {', '.join(silent)}")
    for name, limit in required.items():
        found = fleet[LIMITS[name].figure]
        if found is None:
            failures.append(f"{LIMITS[name].words} unknown, {_bound(name, limit)} required")
        elif found < limit if LIMITS[name].at_least else found > limit:
            failures.append(f"{LIMITS[name].words} {found:.4g}, {_bound(name, limit)} required")
    on_time = fleet["ticks_on_time_fraction"]
    if figures["mode"] == "live" and on_time is not None and on_time < OVERLOADED_BELOW:
        notes.append(f"overloaded: {100 * on_time:.0f} % of the ticks on time")
    dead = [death["name"] for death in fleet["deaths"]]
    if all(f"agent {agent['id']}" in dead for agent in agents):
        failures.append("no daemon was left")
    elif dead:
        notes.append(f"ended in flight: {', '.join(dead)}")
    notes += said_of_drones(agents)
    if fleet["interrupted"]:
        notes.append("interrupted")
    word = "FAILED" if failures else "passed"
    available = fleet["availability"]
    shown = "" if available is None else f"available {100 * available:.1f} %"
    return RunVerdict(f"{word}: {'; '.join(filter(None, (*failures, *notes, shown)))}", bool(failures))


def said_of_drones(agents: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the drones of a replay said of themselves: alarms, doubts, and what was not used, a part for each kind."""
    alarms, doubts, refusals = [], [], []
    for agent in agents:
        said, expected = agent.get("said"), agent["ticks_expected"]
        if said is None or not expected:
            continue
        if said["alarm"]["ticks"]:
            alarms.append(f"{agent['id']} in {_share(said['alarm']['ticks'], expected)}")
        if said["doubts"]:
            doubts.append(f"{agent['id']} ({_listed(said['doubts'], expected)})")
        count = sum(agent["refused"].values()) + sum(agent["packets"]["rejected"].values())
        told = [_listed(said["refusals"], expected)] if said["refusals"] else []
        told += [f"{count} item(s)"] if count else []
        if told:
            refusals.append(f"{agent['id']} ({', '.join(told)})")
    kinds = {"alarm of": alarms, "doubts of": doubts, "not used by": refusals}
    return [f"{words} {', '.join(found)}" for words, found in kinds.items() if found]


def _listed(said: Mapping[str, Any], expected: int) -> str:
    """The commonest of what was said first."""
    ordered = sorted(said.items(), key=lambda each: -each[1]["ticks"])
    return ", ".join(f"{name.replace('_', ' ')} {_share(spell['ticks'], expected)}" for name, spell in ordered)


def _share(ticks: int, expected: int) -> str:
    return f"{100 * ticks / expected:.1f} %"


def _bound(name: str, limit: float) -> str:
    return f"{'at least' if LIMITS[name].at_least else 'at most'} {limit:g}"
