"""Where a fleet found the fixed targets of its configuration: anchors for its next flights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.log.estimate_log import covariance_of
from estimators.estimator import Status
from estimators.model.layout import position
from fleetloc.run import run_files

MILLIMETRES = 3
"""Digits of a place in metres."""


@dataclass(frozen=True, slots=True)
class SurveyedAnchor:
    """A fixed target as the drone had it at the end that knew it best; NED m, 1-sigma per axis."""

    id: int
    name: str
    position_m: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    agent_id: int

    @property
    def total_sigma_m(self) -> float:
        """Over the three axes."""
        return float(np.linalg.norm(self.sigma_m))


def surveyed(config: FleetConfig, directory: Path) -> tuple[list[SurveyedAnchor], list[str]]:
    """The fixed targets that a run's estimates have at its end, and a line for each record that cannot be read."""
    found: dict[int, SurveyedAnchor] = {}
    unread: list[str] = []
    for agent_id in config.ids:
        parts, lines = run_files.readable_entries(directory, agent_id)
        unread += lines
        if not parts or not len(parts[-1]):
            continue
        for each in _known(config, parts[-1][-1], agent_id):
            best = found.get(each.id)
            if best is None or each.total_sigma_m < best.total_sigma_m:
                found[each.id] = each
    return [found[each] for each in sorted(found)], unread


def _known(config: FleetConfig, entry: np.void, agent_id: int) -> Iterator[SurveyedAnchor]:
    """The fixed targets of one estimate."""
    if entry["status"] == Status.NO_DATA:
        return
    covariance = covariance_of(entry, len(config.bodies))
    for target in config.targets:
        slot = config.bodies.index(target.id)
        if target.motion == "fixed" and not is_absent(entry["age_ticks"][slot : slot + 1])[0]:
            north, east, down = (round(float(axis), MILLIMETRES) for axis in entry["mean"][position(slot)])
            sigma = np.sqrt(covariance.diagonal()[position(slot)])
            of_axes = float(sigma[0]), float(sigma[1]), float(sigma[2])
            yield SurveyedAnchor(target.id, target.name, (north, east, down), of_axes, agent_id)


def as_toml(anchors: Iterable[SurveyedAnchor]) -> str:
    """``[[anchors]]`` for a configuration, in place of the ``[[targets]]`` that they were."""
    parts = []
    for each in anchors:
        north, east, down = each.position_m
        sigma = "/".join(f"{axis:.2f}" for axis in each.sigma_m)
        label = f"{each.name}, " if each.name else ""
        parts.append(
            f"[[anchors]]   # {label}surveyed by drone {each.agent_id}: sigma {sigma} m\n"
            f"id = {each.id}\nposition_m = [{north}, {east}, {down}]\n"
        )
    return "\n".join(parts)
