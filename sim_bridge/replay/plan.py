"""Which vehicle of which log is which agent, and where each log lies in fleet time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from agent.config.tables import FleetConfig
from agent.mavlink.utc_stamps import ROLLOVER_S
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.logs.events import LogSource, LogSurvey, SystemSurvey
from sim_bridge.replay.naming import names_apart

LEAD_S = 10.0
"""Fleet time of the earliest log's beginning: a time of zero would leave no room for stamps before it."""
KNOWN_BY = {"gps": "GPS time", "host": "host's clock"}
WEEK_S = 604_800.0
APART_S = 6 * 3600.0
"""Logs whose beginnings lie further apart are not of one flight."""


@dataclass(frozen=True, slots=True)
class PlannedVehicle:
    """One vehicle of a log as an agent; fleet time is log time plus ``shift_s``."""

    source: LogSource
    survey: SystemSurvey
    agent_id: int
    shift_s: float

    @property
    def first_s(self) -> float:
        """Fleet time of its first message."""
        return self.survey.first_s + self.shift_s

    @property
    def last_s(self) -> float:
        """Fleet time of its last message."""
        return self.survey.last_s + self.shift_s


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """The vehicles by agent, in the order of the configuration; agents without a log are not among them.

    ``epoch_unix_s`` is the Unix time of fleet time 0, ``None`` where no log knows the time; ``clocks`` says how the
    logs were laid side by side, for the report.
    """

    vehicles: tuple[PlannedVehicle, ...]
    epoch_unix_s: float | None
    clocks: str

    @property
    def start_s(self) -> float:
        """Fleet time at which the first vehicle begins."""
        return min(vehicle.first_s for vehicle in self.vehicles)

    @property
    def end_s(self) -> float:
        """Fleet time at which the last vehicle ends."""
        return max(vehicle.last_s for vehicle in self.vehicles)


    @property
    def overlap_s(self) -> tuple[float, float] | None:
        """Fleet times between which all vehicles are there; ``None`` if there is no such time."""
        from_s = max(vehicle.first_s for vehicle in self.vehicles)
        to_s = min(vehicle.last_s for vehicle in self.vehicles)
        return (from_s, to_s) if from_s < to_s else None

    @property
    def span_s(self) -> tuple[float, float]:
        """Fleet times from which people count, and to which from the end: of the overlap, else of everything."""
        return self.overlap_s or (self.start_s, self.end_s)

    @property
    def zero_s(self) -> float:
        """Fleet time of the zero of all times that people give and get."""
        return self.span_s[0]


def make_plan(
    config: FleetConfig, sources: Sequence[LogSource], unix_zero_s: dict[int, float] | None = None
) -> ReplayPlan:
    """Assign and align; raises `ReplayError`, or `LogError` from a log that cannot be read.

    ``unix_zero_s`` gives the Unix time of log time 0 by the index of the source, where it is known better than the
    log does (from a file of truth with both clocks).

    Vehicles go to the agents with their system id, if that makes a different agent of each; else, with as many
    vehicles as agents, in the order in which the logs were given (within a log: of their system ids).
    """
    surveys = [source.survey() for source in sources]
    found = [(k, system) for k, survey in enumerate(surveys) for _, system in sorted(survey.systems.items())]
    if not found:
        raise ReplayError(", ".join(names_apart(s.path for s in sources).values()), "a vehicle", "none")
    agents = _assigned(config, [system.system_id for _, system in found])
    zeros, epoch_s, clocks = _aligned(sources, surveys, unix_zero_s or {})
    begin_s = min(zeros[k] + system.first_s for k, system in found)
    origin_s = math.floor(begin_s) - LEAD_S
    vehicles = [
        PlannedVehicle(sources[k], system, agent, zeros[k] - origin_s)
        for (k, system), agent in zip(found, agents, strict=True)
    ]
    vehicles.sort(key=lambda vehicle: config.ids.index(vehicle.agent_id))
    return ReplayPlan(tuple(vehicles), None if epoch_s is None else origin_s, clocks)


def _assigned(config: FleetConfig, system_ids: list[int]) -> list[int]:
    by_system = {config.system_id(agent_id): agent_id for agent_id in config.ids}
    agents = [by_system.get(system_id) for system_id in system_ids]
    known = [agent for agent in agents if agent is not None]
    if len(known) == len(agents) and len(set(known)) == len(known):
        return known
    if len(agents) == len(config.ids):
        return list(config.ids)
    raise ReplayError(
        "logs",
        f"each vehicle with another agent's system id ({', '.join(map(str, by_system))}), or {len(agents)} agents",
        f"{len(system_ids)} vehicle(s) with the system ids {', '.join(map(str, system_ids))}",
    )


def _rolled_over_s(surveys: Mapping[int, LogSurvey]) -> dict[int, float]:
    """What the week of a log's receiver lacks to the latest log, if it is turns of it and no more.

    A receiver that misses that its ten bits began anew is 1024 weeks behind.
    """
    begins_s = {k: survey.unix.at(survey.first_s) for k, survey in surveys.items()}
    latest_s = max(begins_s.values(), default=0.0)
    turns_s = {k: ROLLOVER_S * round((latest_s - begin_s) / ROLLOVER_S) for k, begin_s in begins_s.items()}
    return {k: turn_s if latest_s - begins_s[k] - turn_s <= APART_S else 0.0 for k, turn_s in turns_s.items()}


def _unix_zeros(surveys: Mapping[int, LogSurvey], rolled_s: Mapping[int, float]) -> dict[int, float]:
    """Unix time less log time of each log, at one Unix instant in the middle of them all.

    Clocks of simulators run slow by up to 2 %: laid side by side at their boots, logs would be apart in flight. Away
    from that instant only the difference of their drifts remains.
    """
    if not surveys:
        return {}
    lines = {k: (survey.unix.unix_s + rolled_s[k], 1.0 + survey.unix.drift) for k, survey in surveys.items()}
    middles_s = [lines[k][0] + lines[k][1] * (s.first_s + s.last_s) / 2 for k, s in surveys.items()]
    instant_s = sum(middles_s) / len(middles_s)
    return {k: instant_s - (instant_s - unix_s) / rate for k, (unix_s, rate) in lines.items()}


def _aligned(
    sources: Sequence[LogSource], surveys: Sequence[LogSurvey], better: dict[int, float]
) -> tuple[list[float], float | None, str]:
    """Time of log time 0 of each log on one clock, the epoch of that clock, and how it was found."""
    told = {k: survey for k, survey in enumerate(surveys) if survey.unix.known_by != "unknown"}
    rolled_s = _rolled_over_s(told)
    known = {k: (zero_s, KNOWN_BY[told[k].unix.known_by]) for k, zero_s in _unix_zeros(told, rolled_s).items()}
    known |= {k: (zero_s, "truth file") for k, zero_s in better.items()}
    if not known:
        zeros = [-survey.first_s for survey in surveys]
        return zeros, None, "no log knows the time: all begin together"
    earliest_s = min(zero + surveys[k].first_s for k, (zero, _) in known.items())
    names = names_apart(source.path for source in sources)
    zeros, how = [], []
    for k, survey in enumerate(surveys):
        zero, by = known.get(k, (earliest_s - survey.first_s, "unknown, laid at the beginning of the others"))
        if zero + survey.first_s - earliest_s > APART_S:
            apart_h = (zero + survey.first_s - earliest_s) / 3600.0
            found = f"one that begins {apart_h:.1f} h after another"
            raise ReplayError(sources[k].path, "a log of the same flight", found)
        zeros.append(zero)
        sigma = f" +- {survey.unix.sigma_s:.3f} s" if by in ("GPS time", "host's clock") else ""
        rolled = f", {rolled_s[k] / WEEK_S:.0f} weeks added" if rolled_s.get(k) and by == "GPS time" else ""
        how.append(f"{names[sources[k].path]}: {by}{sigma}{rolled}")
    return zeros, 0.0, "; ".join(how)
