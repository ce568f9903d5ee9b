"""A replay with its files: estimates and references go to disk as they come.

Beside those of every run (`fleetloc.run.run_files`) and what is made of them for other tools
(`fleetloc.report.replay_exports`) the folder holds

======================  ======================================================================================
``truth_001.track``     what they are compared with (`sim_bridge.replay.tracks`); likewise ``autopilot``, ``gps``
                        and ``gps_received`` (the same fixes at the times of their arrival)
``ranges_001.track``    the ranges that agent 1 got
======================  ======================================================================================
"""

from __future__ import annotations

import gc
import re
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agent.config.tables import FleetConfig
from agent.log.estimate_log import EstimateLogWriter, header_of
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from agent.sensing.samples import AutopilotEstimate, GpsSample
from agent.watch.diagnostics import nis_gauges
from agent.watch.tally import HealthTally
from estimators.factory import make_estimator
from fleetloc.output import progress_bar
from fleetloc.run import run_files
from fleetloc.run.replay_setup import Prepared
from sim_bridge.replay.engine import Replay, ReplayCounts
from sim_bridge.replay.feed import Feed
from sim_bridge.replay.logs.events import TruthSample
from sim_bridge.replay.reading import read_beside
from sim_bridge.replay.side_files.range_files import RangeLine
from sim_bridge.replay.statistics import Thinned
from sim_bridge.replay.tracks import MeasuredRange, MeasuredWriter, TrackWriter, measured_path, track_path

KINDS = ("truth", "autopilot", "gps", "gps_received")
"""References, each with a track per agent."""
UNKNOWN_HEIGHT = float("nan")
LATENCY_EVERY_S = 1.0
FIT_EVERY_S = 1.0
RARE_COLLECTIONS = (100_000, 50, 100)
"""Thresholds of the collector while samples stream through: they leave no cycles, and looking for some is a tenth."""
_OF_A_REPLAY = re.compile(rf"agent_[0-9]{{3}}\.csv|({'|'.join(KINDS)}|ranges)_[0-9]{{3}}\.track")


def refuse_inputs(directory: Path, inputs: Iterable[Path | str]) -> None:
    """Refuse a folder in which `clear` would remove what the replay is to read; raises `InputError`."""
    run_files.refuse_inputs(directory, inputs, also=_OF_A_REPLAY)


def clear(directory: Path) -> None:
    """Make the folder, and remove what an earlier run left in it; raises `OSError` if the folder refuses."""
    run_files.clear(directory)
    for path in directory.iterdir():
        if _OF_A_REPLAY.fullmatch(path.name):
            path.unlink()


@dataclass(slots=True)
class Replayed:
    """What a run leaves besides its files."""

    counts: ReplayCounts
    wall_s: float
    cpu_s: float
    latency: dict[int, Thinned] = field(default_factory=dict)
    """By agent: fleet time, latency of its GPS in s, 1-sigma; empty where it is not estimated."""
    fit: dict[int, FitTotals] = field(default_factory=dict)
    """By agent: how well its measurements fitted."""
    said: dict[int, HealthTally] = field(default_factory=dict)
    """By agent: what its health said."""


@dataclass(slots=True)
class FitTotals:
    """Mean and maximum over a run of figures that come once a second, by name."""

    seconds: Counter[str] = field(default_factory=Counter)
    sums: dict[str, float] = field(default_factory=dict)
    most: dict[str, float] = field(default_factory=dict)

    def add(self, figures: Mapping[str, float]) -> None:
        """Take in those of a second."""
        for name, value in figures.items():
            self.seconds[name] += 1
            self.sums[name] = self.sums.get(name, 0.0) + value
            self.most[name] = max(value, self.most.get(name, value))

    def figures(self) -> dict[str, dict[str, float]]:
        """``mean`` and ``max`` by name."""
        return {
            name: {"mean": self.sums[name] / count, "max": self.most[name]} for name, count in self.seconds.items()
        }


class ReferenceTracks:
    """What estimates will be compared with, on disk."""

    def __init__(self, directory: Path, agents: Sequence[int]) -> None:
        """Make the files anew; raises `OSError`."""
        self._tracks = {
            (kind, agent_id): TrackWriter(track_path(directory, kind, agent_id))
            for kind in KINDS
            for agent_id in agents
        }

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        """Write one; times are fleet time."""
        if isinstance(sample, TruthSample):
            north, east, down = sample.position_m
            place = (north, east, down if sample.has_height else UNKNOWN_HEIGHT)
            self._tracks["truth", agent_id].write(sample.t_s, place, sample.velocity_mps)
        elif isinstance(sample, AutopilotEstimate):
            self._tracks["autopilot", agent_id].write(sample.t_s, sample.position_m, sample.velocity_mps)
        else:
            self._tracks["gps", agent_id].write(sample.t_s, sample.position_m, None)
            self._tracks["gps_received", agent_id].write(arrival_s, sample.position_m, None)

    def close(self) -> None:
        """Close all files, also where one of them refuses; may be called again."""
        with ExitStack() as stack:
            for track in self._tracks.values():
                stack.callback(track.close)


class ReplayWriter:
    """Writes the agents' estimates down, and notes what the cores know of their sensors' latency."""

    def __init__(self, directory: Path, config: FleetConfig, agents: Sequence[int]) -> None:
        self.latency: dict[int, Thinned] = {}
        self.fit = {agent_id: FitTotals() for agent_id in agents}
        self.said = {agent_id: HealthTally() for agent_id in agents}
        self._fit_s: dict[int, float] = {}
        self._noted_s: dict[int, float] = {}
        self._recorders: dict[int, EstimateLogWriter] = {}
        self._measured = {agent_id: MeasuredWriter(measured_path(directory, agent_id)) for agent_id in agents}
        for agent_id in agents:
            record = run_files.record_path(directory, agent_id)
            self._recorders[agent_id] = EstimateLogWriter(record, header_of(config, agent_id), sys.maxsize)

    def on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        """Write an estimate, and note now and then the latency, and how well the measurements fit."""
        agent_id = agent.agent_id
        self._recorders[agent_id].write(ready, ready.ready_s, 0.0)
        self.said[agent_id].add(agent.core.health.health, ready.t_s)
        if ready.ready_s >= self._fit_s.get(agent_id, 0.0):
            self._fit_s[agent_id] = ready.ready_s + FIT_EVERY_S
            self.fit[agent_id].add(fit_of_ranges_and_fixes(agent))
        if ready.ready_s < self._noted_s.get(agent_id, 0.0) + LATENCY_EVERY_S:
            return
        known = agent.core.gps_latency
        if known.latency_s is not None and known.sigma_s is not None:
            self._noted_s[agent_id] = ready.ready_s
            row = np.array((ready.ready_s, known.latency_s, known.sigma_s))
            self.latency.setdefault(agent_id, Thinned()).add(row)

    def on_range(self, line: RangeLine) -> None:
        """Write a range down that its observer got."""
        measured = MeasuredRange(line.target, line.range_m, line.sigma_m)
        self._measured[line.observer].write(line.time_s, measured)

    def close(self) -> None:
        """Close the records."""
        with ExitStack() as stack:
            for recorder in self._recorders.values():
                stack.callback(recorder.close)
            for measured in self._measured.values():
                stack.callback(measured.close)


def run_replay(prepared: Prepared, directory: Path) -> Replayed:
    """Replay into a folder."""
    config, inputs = prepared.config, prepared.inputs
    agents = [vehicle.agent_id for vehicle in inputs.plan.vehicles]
    feed = Feed(inputs, ReferenceTracks(directory, agents))
    results = ReplayWriter(directory, config, agents)
    replay = Replay(config, feed, make_estimator, results.on_estimate, results.on_range)
    gc.collect()
    gc.freeze()  # full collections over all modules would take a tenth of the time
    usual = gc.get_threshold()
    gc.set_threshold(*RARE_COLLECTIONS)
    began_s, cpu_s = time.monotonic(), time.process_time()
    try:
        with (
            read_beside(feed) as arrivals,
            progress_bar("seconds of the logs", int(inputs.to_s - inputs.from_s)) as advance,
        ):
            counts = replay.run(lambda _now_s: advance(), arrivals)
    finally:
        results.close()
        gc.set_threshold(*usual)
        gc.unfreeze()
    wall_s, used_s = time.monotonic() - began_s, time.process_time() - cpu_s
    return Replayed(counts, wall_s, used_s, results.latency, results.fit, results.said)


def fit_of_ranges_and_fixes(agent: OnboardAgent) -> dict[str, float]:
    """How well the agent's measurements fit now, and by neighbour the ranges between the two."""
    found = nis_gauges(agent, agent.agent_id)
    for neighbour in agent.core.layout.agents:
        ranges = nis_gauges(agent, neighbour).get("nis_ranges") if neighbour != agent.agent_id else None
        if ranges is not None:
            found[f"nis_ranges_{neighbour}"] = ranges
    return found
