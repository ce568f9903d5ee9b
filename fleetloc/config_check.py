"""Everything that can be told about a configuration before anything is started: mistakes, and what is unwise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agent.config.documents import Document
from agent.config.tables import FleetConfig
from agent.errors import ConfigError
from agent.radio.security import agents_here, expiry_warnings, security_faults, state_warnings
from agent.sensing.clock import require_epoch
from fleetloc.whole_config import read_whole
from sim_bridge.sitl.setup import vehicle_links
from sim_bridge.world.scenario import ScenarioError
from sim_bridge.world.scenario_config import scenario_from_config


@dataclass(slots=True)
class Checked:
    """What was found; ``config`` is there unless a mistake in a single setting leaves nothing to read."""

    where: str
    config: FleetConfig | None = None
    mistakes: list[ConfigError] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        mistakes = [
            {
                "where": error.where,
                "line": error.line,
                "key": error.key,
                "expected": error.expected,
                "found": error.found,
                "did_you_mean": error.meant or None,
                "message": str(error),
            }
            for error in self.mistakes
        ]
        return {"file": self.where, "ok": not mistakes, "mistakes": mistakes, "warnings": self.warnings}


def check_document(
    document: Document, base: Path, agent_id: int | None, *, unix_s: float, keys: bool = True
) -> Checked:
    """Check all tables, the simulated scenario and what the security profile promises.

    ``base`` is the folder that key files are relative to. With ``agent_id`` the keys of that agent are checked, as
    its drone would; else those of every agent where the authority's key is, elsewhere those that are here. Without
    ``keys`` it is the settings alone.
    """
    checked = Checked(document.where)
    checked.config, checked.mistakes = read_whole(document)
    config = checked.config
    if config is None or checked.mistakes:
        if config is not None:
            checked.warnings = list(dict.fromkeys(_warnings(config)))
        return checked
    _check_surroundings(checked, config, document, unix_s)
    if not keys:
        return checked
    here = (agent_id,) if agent_id is not None else agents_here(config, base)
    faults = dict.fromkeys(line for one in here for line in security_faults(config, one, base, unix_s=unix_s))
    checked.mistakes += [ConfigError(document.where, "security", "", "", says=line) for line in faults]
    if not faults:
        for one in here:
            checked.warnings += expiry_warnings(config, one, base, unix_s=unix_s)
    checked.warnings += [*state_warnings(config, base), *_warnings(config)]
    checked.warnings = list(dict.fromkeys(checked.warnings))
    return checked


def _check_surroundings(checked: Checked, config: FleetConfig, document: Document, unix_s: float) -> None:
    """Of the clock, the simulated world and the simulators' addresses."""
    try:
        unset = require_epoch(config, unix_s=unix_s)
        checked.warnings += [] if unset is None else [unset]
    except ConfigError as error:
        checked.mistakes.append(error)
    try:
        scenario_from_config(config)
    except ScenarioError as error:
        checked.mistakes.append(ConfigError(document.where, "", "", "", says=str(error)))
    if "sitl" in document.tables:
        try:
            vehicle_links(config)
        except ConfigError as error:
            checked.mistakes.append(error)


def _warnings(config: FleetConfig) -> Iterator[str]:
    """What may be meant, and seldom is."""
    groups = islands(config)
    for group in groups:
        if len(group) == 1 < len(config.ids):
            yield f"drone {group[0]} is alone: fleet.edges names it in no pair, so it hears and ranges nobody"
    apart = [", ".join(map(str, group)) for group in groups if len(group) > 1]
    if len(apart) > 1:
        yield f"the fleet is in {len(apart)} islands that never hear each other: {' | '.join(apart)} (fleet.edges)"
    if config.security.mode == "unsigned":
        yield "packets are not signed (security.mode is unsigned): who reaches the radio can speak for any drone"


def islands(config: FleetConfig) -> list[tuple[int, ...]]:
    """The agents in groups that hear each other, directly or over others."""
    left, found = list(config.ids), []
    while left:
        group, frontier = set(), {left[0]}
        while frontier:
            group |= frontier
            frontier = {other for one in frontier for other in config.neighbours(one)} - group
        found.append(tuple(agent_id for agent_id in config.ids if agent_id in group))
        left = [agent_id for agent_id in left if agent_id not in group]
    return found
