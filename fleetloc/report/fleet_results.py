"""What a run's files hold, put against the truth: one track per agent."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.log.estimate_log import covariance_of, entry_dtype, read_entries
from estimators.estimator import Status
from estimators.integrity.consistency import nees
from estimators.model.layout import STATES_PER_AGENT, Layout, position
from fleetloc.run import run_files
from sim_bridge.world.truth import Truth, load_truth

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
ROUNDING_S = 1e-6
NO_STATISTICS = np.nan


@dataclass(frozen=True, slots=True)
class AgentTrack:
    """One agent's estimates at K ticks, those without an estimate (status "no data") left out of the errors.

    ``time_s`` ``(K,)`` since the start of the truth, ``own_m`` and ``own_sigma_m`` ``(K, 3)`` NED position and
    1-sigma, ``own_error_m`` ``(K, 3)``, ``full_error`` ``(K, 6n)`` (zero for drones that were no part of the
    estimate), ``nees`` ``(K,)`` over the states of those who were, divided by their number (NaN where the covariance
    is none), ``latency_s`` ``(K,)`` from a tick's end to its estimate, ``tick_time_s`` ``(K,)`` of computation,
    ``on_time`` ``(K,)`` whether it was out within one period of the tick's end, ``known`` ``(K,)`` whether there was
    an estimate.
    """

    agent_id: int
    ticks_expected: int
    records: int
    """How many daemons wrote them: more than one after a restart."""
    time_s: Floats
    own_m: Floats
    own_sigma_m: Floats
    own_error_m: Floats
    full_error: Floats
    nees: Floats
    latency_s: Floats
    tick_time_s: Floats
    on_time: Flags
    known: Flags


@dataclass(frozen=True, slots=True)
class FleetResults:
    """A run against its truth."""

    truth: Truth
    start_unix_s: float
    duration_s: float
    period_s: float
    tracks: tuple[AgentTrack, ...]


def load_results(config: FleetConfig, directory: Path) -> FleetResults:
    """Read the truth and every record; raises `TruthError` or `LogFileError` naming the file that cannot be used."""
    truth = load_truth(directory / run_files.TRUTH)
    start_unix_s, end_unix_s = float(truth.time_unix_s[0]), float(truth.time_unix_s[-1])
    tracks = tuple(_track(config, directory, agent_id, truth) for agent_id in config.ids)
    return FleetResults(truth, start_unix_s, end_unix_s - start_unix_s, config.fleet.period_s, tracks)


def _track(config: FleetConfig, directory: Path, agent_id: int, truth: Truth) -> AgentTrack:
    period_s, epoch_s = config.fleet.period_s, config.fleet.epoch_unix_s
    start_s, end_s = (float(truth.time_unix_s[i]) - epoch_s for i in (0, -1))
    paths = run_files.records(directory, agent_id)
    parts = [read_entries(path)[1] for path in paths]
    entries = np.concatenate(parts) if parts else np.empty(0, entry_dtype(len(config.ids)))
    # the ticks that began and ended while the world moved
    inside = (entries["t_s"] >= start_s - ROUNDING_S) & (entries["t_s"] + period_s <= end_s + ROUNDING_S)
    entries = entries[inside]
    own = position(Layout(config.ids).slot(agent_id))
    when = np.clip(epoch_s + entries["t_s"], truth.time_unix_s[0], truth.time_unix_s[-1])
    error = entries["mean"] - truth.at(when).reshape(len(entries), STATES_PER_AGENT * len(config.ids))
    absent = np.repeat(is_absent(entries["age_ticks"]), STATES_PER_AGENT, axis=1)
    error[absent] = 0.0  # nothing is said of them
    known = np.asarray(entries["status"] != Status.NO_DATA)
    covariance_diagonal = np.array([covariance_of(entry, len(config.ids)).diagonal()[own] for entry in entries])
    latency_s = entries["published_s"] - entries["t_s"] - period_s
    first_tick = int(np.ceil((start_s - ROUNDING_S) / period_s))
    return AgentTrack(
        agent_id=agent_id,
        ticks_expected=max(int(np.floor((end_s + ROUNDING_S) / period_s)) - first_tick, 0),
        records=len(paths),
        time_s=entries["t_s"] - start_s,
        own_m=entries["mean"][:, own],
        own_sigma_m=np.sqrt(covariance_diagonal).reshape(len(entries), 3),
        own_error_m=error[:, own],
        full_error=error,
        nees=np.array([_nees(entries[k], error[k]) if known[k] else NO_STATISTICS for k in range(len(entries))]),
        latency_s=latency_s,
        tick_time_s=entries["tick_time_s"],
        on_time=np.asarray(latency_s <= period_s + ROUNDING_S),
        known=known,
    )


def _nees(entry: np.void, error: Floats) -> float:
    """Of those who are part of the estimate, over the dimension of their states."""
    present = np.repeat(~is_absent(entry["age_ticks"]), STATES_PER_AGENT)
    covariance = covariance_of(entry, len(error) // STATES_PER_AGENT)[np.ix_(present, present)]
    try:
        return nees(error[present], covariance) / max(int(present.sum()), 1)
    except np.linalg.LinAlgError:
        return NO_STATISTICS


def unbroken(time_s: Floats, *columns: Floats, gap_s: float) -> tuple[Floats, ...]:
    """The same columns with a NaN put where the time leaps by more than ``gap_s``: a line is not drawn across."""
    at = np.flatnonzero(np.diff(time_s) > gap_s) + 1
    return tuple(np.insert(column.astype(float), at, np.nan) for column in itertools.chain((time_s,), columns))
