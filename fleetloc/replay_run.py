"""A replay with its files: estimates and references go to disk as they come.

Beside those of every run (`fleetloc.run_files`) the folder holds

======================  ======================================================================================
``estimates.mcap``      the estimates of all agents, for Foxglove and PlotJuggler
``agent_001.csv``       the estimates of agent 1, a line per tick
``truth_001.track``     what they are compared with (`sim_bridge.replay.tracks`); likewise ``autopilot``, ``gps``
                        and ``gps_received`` (the same fixes at the times of their arrival)
======================  ======================================================================================
"""

from __future__ import annotations

import gc
import re
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from agent.config_tables import FleetConfig
from agent.mcap_record import EstimateMcap
from agent.outputs import EstimateReady
from agent.recording import EstimateRecorder, RecordHeader
from agent.samples import AutopilotEstimate, GpsSample
from estimators.factory import make_estimator
from estimators.layout import STATES_PER_AGENT
from fleetloc import run_files
from fleetloc.output import progress_bar
from fleetloc.replay_setup import Prepared
from sim_bridge.lockstep_members import ObjectMember
from sim_bridge.logs.events import TruthSample
from sim_bridge.replay.comparison import is_known
from sim_bridge.replay.engine import Replay, ReplayCounts
from sim_bridge.replay.reading import read_beside
from sim_bridge.replay.statistics import Thinned
from sim_bridge.replay.tracks import TrackWriter


class _Closable(Protocol):
    def close(self) -> None: ...


Closing = TypeVar("Closing", bound=_Closable)
KINDS = ("truth", "autopilot", "gps", "gps_received")
"""References, each with a track per agent."""
UNKNOWN_HEIGHT = float("nan")
MCAP = "estimates.mcap"
TABLE_SUFFIX = ".csv"
LATENCY_EVERY_S = 1.0
RARE_COLLECTIONS = (100_000, 50, 100)
"""Thresholds of the collector while samples stream through: they leave no cycles, and looking for some is a tenth."""
_OF_A_REPLAY = re.compile(rf"agent_[0-9]{{3}}\.csv|({'|'.join(KINDS)})_[0-9]{{3}}\.track|{re.escape(MCAP)}")


def clear(directory: Path) -> None:
    """Make the folder, and remove what an earlier run left in it; raises `OSError` if the folder refuses."""
    run_files.clear(directory)
    for path in directory.iterdir():
        if _OF_A_REPLAY.fullmatch(path.name):
            path.unlink()


def track_path(directory: Path, kind: str, agent_id: int) -> Path:
    """The track of one kind of reference of one agent."""
    return directory / f"{kind}_{agent_id:03d}.track"


@dataclass(slots=True)
class Replayed:
    """What a run leaves besides its files."""

    counts: ReplayCounts
    wall_s: float
    cpu_s: float
    latency: dict[int, Thinned] = field(default_factory=dict)
    """By agent: fleet time, latency of its GPS in s, 1-sigma; empty where it is not estimated."""


class CsvWriter:
    """One agent's estimates of the fleet, a line per tick; ticks without an estimate are left out."""

    def __init__(self, path: Path, agents: Sequence[int], epoch_unix_s: float | None, start_s: float) -> None:
        self._file = path.open("w", encoding="ascii")
        self._count = len(agents)
        self._epoch_unix_s, self._start_s = epoch_unix_s, start_s
        names = [f"{name}_{agent}" for agent in agents for name in (
            "n_m", "e_m", "d_m", "vn_mps", "ve_mps", "vd_mps",
            "sigma_n_m", "sigma_e_m", "sigma_d_m", "sigma_vn_mps", "sigma_ve_mps", "sigma_vd_mps", "age_ticks",
        )]  # fmt: skip
        self._file.write(",".join(("time_s", "time_unix_s", "status", *names)) + "\n")
        self._format = ",".join(["%.3f,%s,%d", *[",".join(["%.4f"] * 12 + ["%d"])] * len(agents)]) + "\n"

    def write(self, ready: EstimateReady) -> None:
        """One line; times are those of the estimated state."""
        estimate = ready.estimate
        unix = "" if self._epoch_unix_s is None else f"{self._epoch_unix_s + ready.t_s:.3f}"
        row = np.empty((self._count, 2 * STATES_PER_AGENT + 1))
        row[:, :STATES_PER_AGENT] = estimate.mean.reshape(self._count, -1)
        row[:, STATES_PER_AGENT:-1] = np.sqrt(estimate.covariance.diagonal()).reshape(self._count, -1)
        row[:, -1] = estimate.age_ticks
        self._file.write(self._format % (ready.t_s - self._start_s, unix, estimate.status, *row.ravel().tolist()))

    def close(self) -> None:
        """Write out what is buffered."""
        self._file.close()


class ReplayFiles:
    """Everything that a replay writes while it runs; closed by `close`."""

    def __init__(self, directory: Path, config: FleetConfig, agents: Sequence[int], prepared: Prepared) -> None:
        self._stack = ExitStack()
        epoch_unix_s = prepared.inputs.plan.epoch_unix_s
        fleet = config.fleet
        self._own = {agent_id: STATES_PER_AGENT * config.ids.index(agent_id) for agent_id in agents}
        self._recorders: dict[int, EstimateRecorder] = {}
        self._tables: dict[int, CsvWriter] = {}
        self._tracks: dict[tuple[str, int], TrackWriter] = {}
        for agent_id in agents:
            header = RecordHeader(
                fleet=fleet.name,
                agent=agent_id,
                agents=config.ids,
                period_s=fleet.period_s,
                epoch_unix_s=fleet.epoch_unix_s,
            )
            record = run_files.record_path(directory, agent_id)
            self._recorders[agent_id] = self._closed(EstimateRecorder(record, header, sys.maxsize))
            table = CsvWriter(record.with_suffix(TABLE_SUFFIX), config.ids, epoch_unix_s, prepared.inputs.from_s)
            self._tables[agent_id] = self._closed(table)
            for kind in KINDS:
                self._tracks[kind, agent_id] = self._closed(TrackWriter(track_path(directory, kind, agent_id)))
        mcap = EstimateMcap(directory / MCAP, config.ids, fleet.period_s, fleet.epoch_unix_s)
        self._mcap = self._closed(mcap)

    def on_estimate(self, agent_id: int, ready: EstimateReady) -> None:
        """Write an estimate to every format."""
        self._recorders[agent_id].write(ready, ready.ready_s, 0.0)
        own = self._own[agent_id]
        if is_known(ready.estimate.covariance[own, own]):
            self._tables[agent_id].write(ready)
            self._mcap.write(agent_id, ready, ready.ready_s)

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        """Write what estimates will be compared with."""
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
        """Close all files, also where one of them refuses."""
        self._stack.close()

    def _closed(self, file: Closing) -> Closing:
        self._stack.callback(file.close)
        return file


class Watching:
    """Passes everything on to the files and notes what the cores know of their sensors' latency."""

    def __init__(self, files: ReplayFiles) -> None:
        self._files = files
        self.members: dict[int, ObjectMember] = {}
        self.latency: dict[int, Thinned] = {}
        self._noted_s: dict[int, float] = {}
        self.on_reference = files.on_reference

    def on_estimate(self, agent_id: int, ready: EstimateReady) -> None:
        """Write an estimate, and note the latency now and then."""
        self._files.on_estimate(agent_id, ready)
        if ready.ready_s < self._noted_s.get(agent_id, 0.0) + LATENCY_EVERY_S:
            return
        known = self.members[agent_id].core.gps_latency
        if known.latency_s is not None and known.sigma_s is not None:
            self._noted_s[agent_id] = ready.ready_s
            row = np.array((ready.ready_s, known.latency_s, known.sigma_s))
            self.latency.setdefault(agent_id, Thinned()).add(row)


def run_replay(prepared: Prepared, directory: Path) -> Replayed:
    """Replay into a folder."""
    config, inputs = prepared.config, prepared.inputs
    vehicles = inputs.plan.vehicles
    agents = [vehicle.agent_id for vehicle in vehicles]
    files = ReplayFiles(directory, config, agents, prepared)
    listener = Watching(files)
    replay = Replay(config, inputs, make_estimator, listener)
    listener.members = replay.members
    gc.collect()
    gc.freeze()  # full collections over all modules would take a tenth of the time
    usual = gc.get_threshold()
    gc.set_threshold(*RARE_COLLECTIONS)
    began_s, cpu_s = time.monotonic(), time.process_time()
    try:
        with (
            read_beside(vehicles, to_s=inputs.to_s, with_truth=inputs.truth is None) as logs,
            progress_bar("seconds of the logs", int(inputs.to_s - inputs.from_s)) as advance,
        ):
            counts = replay.run(lambda _now_s: advance(), logs)
    finally:
        files.close()
        gc.set_threshold(*usual)
        gc.unfreeze()
    return Replayed(counts, time.monotonic() - began_s, time.process_time() - cpu_s, listener.latency)
