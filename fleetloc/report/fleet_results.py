"""What a run's files hold, put against the truth: one track per agent.

Every tick counts. One without an estimate in time counts with the last estimate before it, which is what its
user had; ticks before the first estimate have none, and count in the availability alone.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.log.estimate_log import covariance_of, entry_dtype, variances_of
from estimators.estimator import Status
from estimators.integrity.consistency import nees
from estimators.model.layout import STATES_PER_AGENT, Layout, position
from fleetloc.report.target_results import TargetTrack, target_tracks
from fleetloc.run import run_files
from sim_bridge.world.truth import Truth, load_truth

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
ROUNDING_S = 1e-6
NO_STATISTICS = np.nan


@dataclass(frozen=True, slots=True)
class ServedTicks:
    """What an agent's user had at each of the E ticks of a run that were after its first estimate.

    ``time_s`` ``(E,)`` since the start of the truth; ``own_error_m`` ``(E, 3)`` and ``full_error`` ``(E, 6n)`` of the
    newest estimate of that tick or before; ``available`` ``(E,)``: whether it was the tick's own, in time.
    ``expected_s`` of all ticks, those before the first estimate too.
    """

    expected_s: Floats
    time_s: Floats
    own_error_m: Floats
    full_error: Floats
    available: Flags

    def availability(self, from_s: float = 0.0) -> float | None:
        """Share of the ticks from a time on that had an estimate in time; ``None`` if there was no tick."""
        expected = np.count_nonzero(self.expected_s >= from_s - ROUNDING_S)
        in_time = np.count_nonzero(self.available & (self.time_s >= from_s - ROUNDING_S))
        return in_time / expected if expected else None


@dataclass(frozen=True, slots=True)
class AgentTrack:
    """One agent's estimates at K ticks, those of nothing (status "no data") among them, and what it ``served``.

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
    served: ServedTicks


@dataclass(frozen=True, slots=True)
class FleetResults:
    """A run against its truth; of ``targets`` one track per target and drone."""

    truth: Truth
    start_unix_s: float
    duration_s: float
    period_s: float
    tracks: tuple[AgentTrack, ...]
    targets: tuple[TargetTrack, ...] = ()
    unread: tuple[str, ...] = ()
    """A line for each record that could not be read, or is not there."""


def load_results(config: FleetConfig, directory: Path) -> FleetResults:
    """Read the truth and what there is of records; raises `TruthError` naming the file that cannot be used."""
    truth = load_truth(directory / run_files.TRUTH)
    start_unix_s, end_unix_s = float(truth.time_unix_s[0]), float(truth.time_unix_s[-1])
    unread: list[str] = []
    tracks = tuple(_track(config, directory, agent_id, truth, unread) for agent_id in config.ids)
    targets = target_tracks(config, directory, truth, {track.agent_id: track.ticks_expected for track in tracks})
    duration_s = end_unix_s - start_unix_s
    return FleetResults(truth, start_unix_s, duration_s, config.fleet.period_s, tracks, targets, tuple(unread))


def _track(config: FleetConfig, directory: Path, agent_id: int, truth: Truth, unread: list[str]) -> AgentTrack:
    period_s, epoch_s = config.fleet.period_s, config.fleet.epoch_unix_s
    start_s, end_s = (float(truth.time_unix_s[i]) - epoch_s for i in (0, -1))
    parts, broken = run_files.readable_entries(directory, agent_id)
    unread += broken
    entries = np.concatenate(parts) if parts else np.empty(0, entry_dtype(len(config.bodies)))
    # the ticks that began and ended while the world moved
    inside = (entries["t_s"] >= start_s - ROUNDING_S) & (entries["t_s"] + period_s <= end_s + ROUNDING_S)
    entries = entries[inside]
    own = position(Layout(config.ids).slot(agent_id))
    when = np.clip(epoch_s + entries["t_s"], truth.time_unix_s[0], truth.time_unix_s[-1])
    error = _error(entries, truth, when, len(config.ids))
    absent = np.repeat(is_absent(entries["age_ticks"][:, : len(config.ids)]), STATES_PER_AGENT, axis=1)
    error[absent] = 0.0  # nothing is said of them
    known = np.asarray(entries["status"] != Status.NO_DATA)
    covariance_diagonal = variances_of(entries, len(config.bodies))[:, own]
    latency_s = entries["published_s"] - entries["t_s"] - period_s
    on_time = np.asarray(latency_s <= period_s + ROUNDING_S)
    first_tick = int(np.ceil((start_s - ROUNDING_S) / period_s))
    ticks_expected = max(int(np.floor((end_s + ROUNDING_S) / period_s)) - first_tick, 0)
    ticks = first_tick + np.arange(ticks_expected)
    return AgentTrack(
        agent_id=agent_id,
        ticks_expected=ticks_expected,
        records=len(parts),
        time_s=entries["t_s"] - start_s,
        own_m=entries["mean"][:, own],
        own_sigma_m=np.sqrt(covariance_diagonal).reshape(len(entries), 3),
        own_error_m=error[:, own],
        full_error=error,
        nees=np.array([_nees(entries[k], error[k]) if known[k] else NO_STATISTICS for k in range(len(entries))]),
        latency_s=latency_s,
        tick_time_s=entries["tick_time_s"],
        on_time=on_time,
        known=known,
        served=_served(config, truth, own, entries[known & on_time], ticks),
    )


def _served(
    config: FleetConfig, truth: Truth, own: slice, estimates: NDArray[np.void], ticks: NDArray[np.int64]
) -> ServedTicks:
    """The newest estimate at each tick; ``estimates`` are those that were there in time, in order of their ticks."""
    period_s, start_s = config.fleet.period_s, float(truth.time_unix_s[0]) - config.fleet.epoch_unix_s
    own_ticks = np.round(estimates["t_s"] / period_s).astype(np.int64)
    newest = np.searchsorted(own_ticks, ticks, side="right") - 1
    time_s = np.asarray(ticks * period_s - start_s, np.float64)
    begun = newest >= 0
    newest, of_tick = newest[begun], ticks[begun]
    when = np.clip(config.fleet.epoch_unix_s + of_tick * period_s, truth.time_unix_s[0], truth.time_unix_s[-1])
    error = _error(estimates[newest], truth, when, len(config.ids))
    absent = is_absent(estimates["age_ticks"][newest][:, : len(config.ids)])
    error[np.repeat(absent, STATES_PER_AGENT, axis=1)] = 0.0
    return ServedTicks(time_s, time_s[begun], error[:, own], error, own_ticks[newest] == of_tick)


def _error(entries: NDArray[np.void], truth: Truth, when: Floats, drones: int) -> Floats:
    """Of the drones' states ``(T, 6n)``; targets stand behind them."""
    known = truth.at(when)[:, :drones]
    known = known.reshape(len(entries), math.prod(known.shape[1:]))  # -1 would not do for a drone without ticks
    return np.asarray(entries["mean"][:, : known.shape[1]] - known, np.float64)


def _nees(entry: np.void, error: Floats) -> float:
    """Of the drones that are part of the estimate, over the dimension of their states."""
    drones = len(error) // STATES_PER_AGENT
    present = np.repeat(~is_absent(entry["age_ticks"][:drones]), STATES_PER_AGENT)
    whole = covariance_of(entry, len(entry["age_ticks"]))[: len(error), : len(error)]
    covariance = whole[np.ix_(present, present)]
    try:
        return nees(error[present], covariance) / max(int(present.sum()), 1)
    except np.linalg.LinAlgError:
        return NO_STATISTICS


def unbroken(time_s: Floats, *columns: Floats, gap_s: float) -> tuple[Floats, ...]:
    """The same columns with a NaN put where the time leaps by more than ``gap_s``: a line is not drawn across."""
    at = np.flatnonzero(np.diff(time_s) > gap_s) + 1
    return tuple(np.insert(column.astype(float), at, np.nan) for column in itertools.chain((time_s,), columns))
