"""A replay's estimates against truth and the autopilots' own, read from the records piece by piece."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.fleet.tracking import ABSENT_VARIANCE
from agent.log.estimate_log import covariance_of, record_chunks, variances_of
from estimators.estimator import Status
from estimators.model.layout import STATES_PER_AGENT, Layout, block
from sim_bridge.replay.statistics import Floats, Spread, Thinned
from sim_bridge.replay.tracks import WrittenTrack

MAX_TRUTH_GAP_S = 0.5
MAX_AUTOPILOT_GAP_S = 1.5
LOCATED_SIGMA_M = 30.0
"""An agent that says no more of itself than this has not begun yet."""
PLACE_HOLDER = 0.5
"""Share of the variance of an absent drone above which a variance is that of a place holder."""
CHUNK_NUMBERS = 1_000_000
"""Size of the largest piece of a track that is held at a time, in numbers."""
BLOCK = STATES_PER_AGENT

SERIES = ("t_s", "status", *(f"{kind}_{axis}" for kind in ("own", "sigma", "truth", "autopilot") for axis in "ned"),
          "nees", "own_nees")  # fmt: skip
"""Columns of an agent's series for the plots; the ages of all agents in s follow."""


@dataclass(frozen=True, slots=True)
class Phase:
    """A part of the run over which figures are given, in fleet time."""

    name: str
    from_s: float
    to_s: float


@dataclass(slots=True)
class Errors:
    """Figures of one agent's own position over one phase, m; NEES over the dimension (1 is right).

    The state of the fleet is that of the drones with a log, at ticks where the agent has located all of them.
    """

    position: Spread = field(default_factory=Spread)
    horizontal: Spread = field(default_factory=Spread)
    vertical: Spread = field(default_factory=Spread)
    full_norm: Spread = field(default_factory=Spread)
    nees: Spread = field(default_factory=Spread)
    own_nees: Spread = field(default_factory=Spread)
    to_autopilot_horizontal: Spread = field(default_factory=Spread)
    to_autopilot_vertical: Spread = field(default_factory=Spread)
    autopilot_position: Spread = field(default_factory=Spread)
    autopilot_horizontal: Spread = field(default_factory=Spread)
    autopilot_vertical: Spread = field(default_factory=Spread)
    gps_horizontal: Spread = field(default_factory=Spread)
    gps_vertical: Spread = field(default_factory=Spread)
    gps_received_horizontal: Spread = field(default_factory=Spread)
    gps_received_vertical: Spread = field(default_factory=Spread)


@dataclass(slots=True)
class Compared:
    """One agent's run: figures by phase, thinned series (`SERIES`, then ages), counts of ticks."""

    agent_id: int
    errors: dict[str, Errors]
    series: Thinned
    ticks: int = 0
    without_estimate: int = 0
    statuses: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ComparedTracks:
    """The tracks of one agent."""

    truth: WrittenTrack
    autopilot: WrittenTrack
    gps: WrittenTrack
    """Fixes at the times of their stamps."""
    gps_received: WrittenTrack
    """Fixes at the times of their arrival."""


def first_estimate_s(path: Path, layout: Layout, agent_id: int) -> float | None:
    """Fleet time of the first estimate of a record that locates its agent; ``None`` if there is none."""
    for chunk in record_chunks(path, layout.size):
        known = located(chunk, layout, agent_id, LOCATED_SIGMA_M**2)
        if known.any():
            return float(chunk["t_s"][known][0])
    return None


def compare(
    path: Path,
    layout: Layout,
    agent_id: int,
    references: Mapping[int, ComparedTracks],
    phases: Sequence[Phase],
    period_s: float,
) -> Compared:
    """Put the record of one agent's estimates (`agent.log.estimate_log`) against the tracks of all agents."""
    result = Compared(agent_id, {phase.name: Errors() for phase in phases}, Thinned())
    for chunk in record_chunks(path, layout.size):
        result.ticks += len(chunk)
        known = located(chunk, layout, agent_id)
        result.without_estimate += int(np.count_nonzero(~known))
        for status in np.unique(chunk["status"]):
            name = Status(int(status)).name.lower()
            result.statuses[name] = result.statuses.get(name, 0) + int(np.count_nonzero(chunk["status"] == status))
        if known.any():
            _compare_chunk(result, chunk[known], layout, references, phases, period_s)
    for phase in phases:
        _compare_sensors(result.errors[phase.name], references[agent_id], phase)
    return result


def located(
    chunk: NDArray[np.void], layout: Layout, agent_id: int, below_m2: float = PLACE_HOLDER * ABSENT_VARIANCE
) -> NDArray[np.bool_]:
    """``(K,)``: whether an agent is located in the entries, the variance of its position north below a limit."""
    return np.asarray(variances_of(chunk, layout.size)[:, BLOCK * layout.slot(agent_id)] < below_m2)


def _compare_chunk(
    result: Compared,
    chunk: NDArray[np.void],
    layout: Layout,
    references: Mapping[int, ComparedTracks],
    phases: Sequence[Phase],
    period_s: float,
) -> None:
    t_s = np.asarray(chunk["t_s"], float)
    own = block(layout.slot(result.agent_id))
    truth = np.hstack([_truth_of(references.get(agent), t_s) for agent in layout.agents])
    error = np.asarray(chunk["mean"]) - truth
    covariance = np.array([covariance_of(entry, layout.size) for entry in chunk])
    autopilot = references[result.agent_id].autopilot.at(t_s, MAX_AUTOPILOT_GAP_S)
    to_autopilot = chunk["mean"][:, own] - autopilot
    flown = np.concatenate([np.r_[block(layout.slot(agent))] for agent in references])
    for agent in references:
        error[~located(chunk, layout, agent), block(layout.slot(agent))] = np.nan
    nees = _nees(error[:, flown], covariance[:, flown[:, None], flown])
    own_nees = _nees(error[:, own], covariance[:, own, own])
    full_norm = np.linalg.norm(error[:, flown], axis=1)
    for phase in phases:
        within = (t_s >= phase.from_s) & (t_s <= phase.to_s)
        errors = result.errors[phase.name]
        _add_position(errors.position, errors.horizontal, errors.vertical, error[within, own])
        _add_position(None, errors.to_autopilot_horizontal, errors.to_autopilot_vertical, to_autopilot[within])
        errors.full_norm.add(full_norm[within])
        errors.nees.add(nees[within])
        errors.own_nees.add(own_nees[within])
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, own])
    columns = (t_s[:, None], np.asarray(chunk["status"], float)[:, None], chunk["mean"][:, own][:, :3], sigma[:, :3],
               truth[:, own][:, :3], autopilot[:, :3], nees[:, None], own_nees[:, None],
               period_s * np.asarray(chunk["age_ticks"], float).reshape(len(chunk), -1))  # fmt: skip
    for row in np.hstack(columns):
        result.series.add(row)


def _compare_sensors(errors: Errors, references: ComparedTracks, phase: Phase) -> None:
    """What the autopilot believed and the receiver said, each at its own times, against the truth."""
    for track, whole, horizontal, vertical in (
        (references.autopilot, errors.autopilot_position, errors.autopilot_horizontal, errors.autopilot_vertical),
        (references.gps, None, errors.gps_horizontal, errors.gps_vertical),
        (references.gps_received, None, errors.gps_received_horizontal, errors.gps_received_vertical),
    ):
        for entries in _pieces(track):
            _add_position(whole, horizontal, vertical, _against_truth(entries, references.truth, phase))


def _against_truth(entries: NDArray[np.void], truth: WrittenTrack, phase: Phase) -> Floats:
    entries = entries[(entries["t_s"] >= phase.from_s) & (entries["t_s"] <= phase.to_s)]
    return np.asarray(entries["position_m"] - truth.at(np.asarray(entries["t_s"]), MAX_TRUTH_GAP_S)[:, :3])


def _add_position(whole: Spread | None, horizontal: Spread, vertical: Spread, error: Floats) -> None:
    if whole is not None:
        whole.add(np.linalg.norm(error[:, :3], axis=1))
    horizontal.add(np.hypot(error[:, 0], error[:, 1]))
    vertical.add(np.abs(error[:, 2]))


def _truth_of(references: ComparedTracks | None, t_s: Floats) -> Floats:
    return np.full((len(t_s), BLOCK), np.nan) if references is None else references.truth.at(t_s, MAX_TRUTH_GAP_S)


def _nees(error: Floats, covariance: Floats) -> Floats:
    """``(K,)`` over the dimension; NaN where the truth is not known or the covariance is none."""
    values = np.full(len(error), np.nan)
    complete = np.isfinite(error).all(axis=1)
    if not complete.any():
        return values
    try:
        solved = np.linalg.solve(covariance[complete], error[complete][:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return values
    squared = np.einsum("ij,ij->i", error[complete], solved)
    values[complete] = np.where(squared >= 0.0, squared, np.nan) / error.shape[1]
    return values


def _pieces(track: WrittenTrack) -> Iterator[NDArray[np.void]]:
    count = CHUNK_NUMBERS // 7
    for at in range(0, len(track), count):
        yield track.entries[at : at + count]
