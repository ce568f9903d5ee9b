"""The estimates of a replay for other tools: CSV for tables, MCAP for Foxglove and PlotJuggler."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from operator import itemgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config.tables import FleetConfig
from agent.log.estimate_log import covariance_of, record_chunks
from agent.outputs import EstimateReady
from agent.sensing.samples import Triple
from estimators.estimator import Estimate, Status
from estimators.model.layout import STATES_PER_AGENT, Layout
from fleetloc.errors import InputError
from fleetloc.export.plot_files import PlotFiles
from fleetloc.export.plot_schemas import columns_of
from fleetloc.run import run_files
from sim_bridge import side_process
from sim_bridge.replay.comparison import located
from sim_bridge.replay.tracks import MeasuredRange, WrittenTrack, measured_path, read_measured, track_path

TABLE_SUFFIX = ".csv"


@contextmanager
def exporting(
    directory: Path, config: FleetConfig, agents: Sequence[int], start_s: float, epoch_unix_s: float | None
) -> Iterator[None]:
    """Make the files of `export` beside what is done within; there when it ends.

    Raises `OSError`, `LogFileError`, and `InputError` where the process that makes them was killed.
    """
    task = (directory, config, tuple(agents), start_s, epoch_unix_s)
    if not side_process.may_fork():
        export(*task)
        yield
        return
    with side_process.workers(1) as pool:
        done = pool.submit(export, *task)
        yield
        try:
            done.result()
        except side_process.Killed:
            expected = "the estimates to be written as CSV and MCAP"
            raise InputError(str(directory), "", expected, "the writing process was killed") from None


def export(
    directory: Path, config: FleetConfig, agents: Sequence[int], start_s: float, epoch_unix_s: float | None
) -> None:
    """``agent_001.csv`` of each agent, and what `fleetloc.export.plot_files` makes of all, in the order of time.

    Ticks at which an agent had not located itself are left out. Tables count time from fleet time ``start_s``;
    ``epoch_unix_s``: Unix time of fleet time zero, where it is known.
    """
    with ExitStack() as files:
        plots = files.enter_context(closing(PlotFiles(directory, config, agents, start_s)))
        tables = {}
        for agent_id in agents:
            path = run_files.record_path(directory, agent_id).with_suffix(TABLE_SUFFIX)
            tables[agent_id] = files.enter_context(closing(CsvWriter(path, config.bodies, epoch_unix_s, start_s)))
        streams: list[Iterator[tuple[float, int, np.void | Triple | MeasuredRange]]] = [
            stream
            for agent_id in agents
            for stream in (
                _located_entries(directory, Layout(config.bodies), agent_id),
                _fixes(directory, agent_id),
                _ranges(directory, agent_id),
            )
        ]
        for at_s, agent_id, thing in heapq.merge(*streams, key=itemgetter(0)):
            if isinstance(thing, MeasuredRange):
                plots.range(agent_id, thing.target, at_s, thing.range_m, thing.sigma_m)
            elif isinstance(thing, tuple):
                plots.fix(agent_id, at_s, thing, at_s)
            else:
                ready = _ready(thing, config, at_s)
                tables[agent_id].write(ready)
                plots.estimate(agent_id, ready, at_s)
        for agent_id in agents:
            plots.truth(agent_id, _points(directory, "truth", agent_id))


def _located_entries(directory: Path, layout: Layout, agent_id: int) -> Iterator[tuple[float, int, np.void]]:
    """When published, agent, and entry of its record, where it has located itself."""
    for chunk in record_chunks(run_files.record_path(directory, agent_id), layout.size):
        there: NDArray[np.void] = chunk[located(chunk, layout, agent_id)]
        for entry in there:
            yield float(entry["published_s"]), agent_id, entry


def _points(directory: Path, kind: str, agent_id: int) -> Iterator[tuple[float, Triple]]:
    """Fleet times and places of a track."""
    for entry in WrittenTrack(track_path(directory, kind, agent_id)).entries:
        north, east, down = entry["position_m"].tolist()
        yield float(entry["t_s"]), (north, east, down)


def _fixes(directory: Path, agent_id: int) -> Iterator[tuple[float, int, Triple]]:
    """When it arrived, agent, and place of every fix."""
    for t_s, place_m in _points(directory, "gps_received", agent_id):
        yield t_s, agent_id, place_m


def _ranges(directory: Path, agent_id: int) -> Iterator[tuple[float, int, MeasuredRange]]:
    """When it was measured, by whom, and every range."""
    for t_s, measured in read_measured(measured_path(directory, agent_id)):
        yield t_s, agent_id, measured


def _ready(entry: np.void, config: FleetConfig, published_s: float) -> EstimateReady:
    estimate = Estimate(
        tick=int(entry["tick"]),
        mean=entry["mean"],
        covariance=covariance_of(entry, len(config.bodies)),
        status=Status(int(entry["status"])),
        age_ticks=entry["age_ticks"],
    )
    return EstimateReady(estimate, float(entry["t_s"]), published_s, bool(entry["on_time"]))


class CsvWriter:
    """One agent's estimates of the fleet, a line per tick."""

    def __init__(self, path: Path, agents: Sequence[int], epoch_unix_s: float | None, start_s: float) -> None:
        self._file = path.open("w", encoding="ascii")
        self._count = len(agents)
        self._epoch_unix_s, self._start_s = epoch_unix_s, start_s
        names = columns_of(agents)
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
