"""What each drone of a run knew of the targets, put against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.log.estimate_log import covariance_of
from estimators.estimator import Status
from estimators.integrity.consistency import nees, rms
from estimators.model.layout import position
from fleetloc.run import run_files
from sim_bridge.world.truth import Truth

Floats = NDArray[np.float64]

FOUND_M = 5.0
"""A target is found once its error is below this."""
SETTLED_S = 10.0
"""After a target was found its error is also given from here on."""
COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("target", lambda row: f"{row['id']} {row['name']}".strip()),
    ("seen by", lambda row: str(row["seen_by"])),
    ("available %", lambda row: _number(row["availability"], 1, 100.0)),
    ("below 5 m after s", lambda row: _number(row["below_5m_after_s"], 1)),
    ("RMSE m", lambda row: _number(row["position_rmse_m"], 2)),
    ("10 s after that", lambda row: _number(row["position_rmse_settled_m"], 2)),
    ("ANEES", lambda row: _number(row["anees_settled"], 2)),
    ("ticks ok beyond 5 sigma", lambda row: str(row["ticks_ok_beyond_5_sigma"])),
)
"""Of the tables of a report: heading, and what stands under it for a row of ``report.json``."""


@dataclass(frozen=True, slots=True)
class TargetTrack:
    """A target in the estimates of one drone, at the K ticks in which it was part of them.

    ``time_s`` ``(K,)`` since the start of the truth; ``position_m``, ``sigma_m`` and ``error_m`` ``(K, 3)`` NED;
    ``nees`` ``(K,)`` of the position over its dimension; ``ok`` ``(K,)``: the estimate's status was OK.
    ``ticks_expected`` of the whole run.
    """

    target_id: int
    agent_id: int
    ticks_expected: int
    time_s: Floats
    position_m: Floats
    sigma_m: Floats
    error_m: Floats
    nees: Floats
    ok: NDArray[np.bool_]

    @property
    def found_after_s(self) -> float | None:
        """When its error was below `FOUND_M` first; ``None`` = never."""
        near = np.flatnonzero(np.linalg.norm(self.error_m, axis=1) < FOUND_M)
        return float(self.time_s[near[0]]) if len(near) else None

    def figures(self) -> dict[str, Any]:
        """For ``report.json``; what is not known is null."""
        found_s = self.found_after_s
        settled = self.time_s >= (np.inf if found_s is None else found_s + SETTLED_S)
        distance_m, sigma_m = np.linalg.norm(self.error_m, axis=1), np.linalg.norm(self.sigma_m, axis=1)
        return {
            "seen_by": self.agent_id,
            "availability": len(self.time_s) / self.ticks_expected if self.ticks_expected else None,
            "below_5m_after_s": found_s,
            "position_rmse_m": rms(self.error_m) if len(self.error_m) else None,
            "position_rmse_settled_m": rms(self.error_m[settled]) if settled.any() else None,
            "anees_settled": float(self.nees[settled].mean()) if settled.any() else None,
            "ticks_ok_beyond_5_sigma": int(np.count_nonzero(self.ok & (distance_m > 5.0 * sigma_m))),
        }


def target_tracks(
    config: FleetConfig, directory: Path, truth: Truth, ticks_expected: dict[int, int]
) -> tuple[TargetTrack, ...]:
    """Of every target and drone of a run; ``ticks_expected`` by drone."""
    return tuple(
        _track(config, directory, truth, target.id, agent_id, ticks_expected[agent_id])
        for target in config.targets
        for agent_id in config.ids
    )


def _track(
    config: FleetConfig, directory: Path, truth: Truth, target_id: int, agent_id: int, ticks_expected: int
) -> TargetTrack:
    kept = sorted(_seen(config, directory, truth, target_id, agent_id), key=lambda each: each.unix_s)
    unix_s = np.array([each.unix_s for each in kept], np.float64)
    place_m = np.array([each.position_m for each in kept], np.float64).reshape(-1, 3)
    covariance_m2 = np.array([each.covariance_m2 for each in kept], np.float64).reshape(-1, 3, 3)
    error_m = place_m - truth.at(unix_s)[:, truth.agents.index(target_id), :3]
    squared = [nees(error, covariance) / 3.0 for error, covariance in zip(error_m, covariance_m2, strict=True)]
    return TargetTrack(
        target_id,
        agent_id,
        ticks_expected,
        time_s=unix_s - float(truth.time_unix_s[0]),
        position_m=place_m,
        sigma_m=np.sqrt(np.diagonal(covariance_m2, axis1=1, axis2=2)),
        error_m=error_m,
        nees=np.array(squared, np.float64),
        ok=np.array([each.ok for each in kept], np.bool_),
    )


class _Seen(NamedTuple):
    """A target in one estimate of a drone."""

    unix_s: float
    position_m: Floats
    covariance_m2: Floats
    ok: bool


def _seen(
    config: FleetConfig, directory: Path, truth: Truth, target_id: int, agent_id: int
) -> Iterator[_Seen]:
    """The estimates of a drone, within the time of the truth, that the target was part of."""
    body, bodies, epoch_s = config.bodies.index(target_id), len(config.bodies), config.fleet.epoch_unix_s
    first_s, last_s = float(truth.time_unix_s[0]), float(truth.time_unix_s[-1])
    for part in run_files.readable_entries(directory, agent_id)[0]:
        for entry in part:
            unix_s = float(entry["t_s"]) + epoch_s
            gone = is_absent(entry["age_ticks"][body : body + 1])[0] or entry["status"] == Status.NO_DATA
            if gone or not first_s <= unix_s <= last_s:
                continue
            covariance_m2 = covariance_of(entry, bodies)[position(body), position(body)]
            place_m = np.asarray(entry["mean"][position(body)], np.float64)
            yield _Seen(unix_s, place_m, covariance_m2, bool(entry["status"] == Status.OK))


def target_cells(row: dict[str, Any]) -> list[str]:
    """What is shown of a target in one drone's estimates, under the headings of `COLUMNS`."""
    return [show(row) for _, show in COLUMNS]


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"
