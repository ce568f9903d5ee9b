"""The files for other tools of a run that was flown: of the estimate and flight logs in its folder.

Truth comes from ``truth.npz`` where a simulator wrote it, fixes and ranges from the flight logs (.mcap with .tlog).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import closing
from operator import itemgetter
from pathlib import Path

import numpy as np

from agent.config.tables import FleetConfig
from agent.errors import LogFileError
from agent.fleet.membership import is_absent
from agent.inputs import HouseKept, MavlinkIn
from agent.log.estimate_log import covariance_of, header_in, record_chunks
from agent.log.flight_reader import FlightReader, RecordedInput
from agent.mavlink.codec import Decoder, mavlink
from agent.outputs import EstimateReady
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import Triple
from estimators.estimator import Estimate, Status
from fleetloc.errors import InputError
from fleetloc.export.plot_files import PlotFiles
from fleetloc.run import run_files
from sim_bridge.replay.side_files.range_files import RangeCounts
from sim_bridge.replay.side_files.recorded_ranges import ranges_of_record
from sim_bridge.replay.tracks import MeasuredRange
from sim_bridge.world.truth import load_truth

Thing = EstimateReady | MeasuredRange | tuple[float, Triple]
"""What happened at an instant: an estimate was out, a range was measured, a fix (its stamp and place) arrived."""
FIX_2D = 2
"""GPS_RAW_INT's smallest ``fix_type`` with a place."""


def export_run(config: FleetConfig, directory: Path, out: Path) -> list[str]:
    """Write the files into ``out``; a line for each log that could not be read.

    Raises `InputError` where there is no estimate log, `LogFileError` and `OSError` where the disk refuses.
    """
    agents = [agent_id for agent_id in config.ids if run_files.records(directory, agent_id)]
    if not agents:
        raise InputError(str(directory), "", "agent_001.estimates, as a run leaves it", "no such file")
    unread: list[str] = []
    streams = [_things(config, directory, agent_id, unread) for agent_id in agents]
    merged = heapq.merge(*streams, key=itemgetter(0))
    first = next(merged, None)
    start_s = first[0] if first is not None else 0.0
    truth = directory / run_files.TRUTH
    if truth.is_file():
        start_s = float(load_truth(truth).time_unix_s[0]) - config.fleet.epoch_unix_s
    out.mkdir(parents=True, exist_ok=True)
    with closing(PlotFiles(out, config, agents, start_s)) as files:
        for at_s, agent_id, thing in ([first] if first is not None else []):
            _put(files, at_s, agent_id, thing)
        for at_s, agent_id, thing in merged:
            _put(files, at_s, agent_id, thing)
        if truth.is_file():
            _put_truth(files, config, truth)
    return unread


def _put(files: PlotFiles, at_s: float, agent_id: int, thing: Thing) -> None:
    if isinstance(thing, EstimateReady):
        files.estimate(agent_id, thing, at_s)
    elif isinstance(thing, MeasuredRange):
        files.range(agent_id, thing.target, at_s, thing.range_m, thing.sigma_m)
    else:
        stamp_s, place_m = thing
        files.fix(agent_id, stamp_s, place_m, at_s)


def _put_truth(files: PlotFiles, config: FleetConfig, path: Path) -> None:
    truth = load_truth(path)
    states = truth.at(truth.time_unix_s)
    for slot, agent_id in enumerate(config.ids):
        places = states[:, slot, :3].tolist()
        times_s = (truth.time_unix_s - config.fleet.epoch_unix_s).tolist()
        files.truth(agent_id, ((t_s, (n, e, d)) for t_s, (n, e, d) in zip(times_s, places, strict=True)))


def _things(
    config: FleetConfig, directory: Path, agent_id: int, unread: list[str]
) -> Iterator[tuple[float, int, Thing]]:
    """What all logs of one agent hold, in order of time; a log that ends early gives its beginning."""
    streams: list[Iterator[tuple[float, int, Thing]]] = []
    for record in run_files.records(directory, agent_id):
        streams.append(_estimates(config, record, agent_id, unread))
        flight = record.with_suffix(".mcap")
        if flight.is_file():
            streams.append(_readable(_fixes(config, flight, agent_id), unread))
            streams.append(_readable(_ranges(config, flight, agent_id), unread))
    return heapq.merge(*streams, key=itemgetter(0))


def _readable(
    things: Iterator[tuple[float, int, Thing]], unread: list[str]
) -> Iterator[tuple[float, int, Thing]]:
    try:
        yield from things
    except LogFileError as error:
        unread.append(str(error))


def _estimates(
    config: FleetConfig, record: Path, agent_id: int, unread: list[str]
) -> Iterator[tuple[float, int, Thing]]:
    """The estimates of a log in which its agent is located."""
    own, bodies = config.bodies.index(agent_id), len(config.bodies)
    try:
        written = header_in(record).agents
        if written != config.bodies:
            raise LogFileError(f"record {record}: expected {_ids(config.bodies)}, found {_ids(written)}")
        for chunk in record_chunks(record, bodies):
            there = chunk[~is_absent(chunk["age_ticks"][:, own])]
            for entry in there:
                estimate = Estimate(
                    tick=int(entry["tick"]),
                    mean=entry["mean"],
                    covariance=covariance_of(entry, bodies),
                    status=Status(int(entry["status"])),
                    age_ticks=entry["age_ticks"],
                )
                published_s = float(entry["published_s"])
                ready = EstimateReady(estimate, float(entry["t_s"]), published_s, bool(entry["on_time"]))
                yield published_s, agent_id, ready
    except LogFileError as error:
        unread.append(str(error))


def _fixes(config: FleetConfig, flight: Path, agent_id: int) -> Iterator[tuple[float, int, Thing]]:
    """The fixes of a flight log at the times of their arrival; whether they were used is another matter."""
    frame, reader = FleetFrame.of(config), FlightReader(flight)
    unix_of_host_s = reader.start.unix_s - reader.start.host_s
    decoder = Decoder(datagrams=False)
    for entry in reader:
        event = entry.event if isinstance(entry, RecordedInput) else None
        if isinstance(event, HouseKept):
            unix_of_host_s = event.unix_s - event.host_s
        if not isinstance(event, MavlinkIn):
            continue
        for message in decoder.feed(b"".join(event.frames)):
            if message.get_msgId() != mavlink.MAVLINK_MSG_ID_GPS_RAW_INT or message.fix_type < FIX_2D:
                continue
            height_m = frame.height(1e-3 * message.alt, 1e-3 * message.alt_ellipsoid or None)
            if height_m is None:
                continue
            place_m = frame.ned(1e-7 * message.lat, 1e-7 * message.lon, height_m)
            at_s = event.host_s + unix_of_host_s - config.fleet.epoch_unix_s
            yield at_s, agent_id, (at_s, place_m)


def _ranges(config: FleetConfig, flight: Path, agent_id: int) -> Iterator[tuple[float, int, Thing]]:
    """The ranges that an agent's module sent."""
    for line in ranges_of_record(flight, RangeCounts()):
        at_s = line.time_s - config.fleet.epoch_unix_s
        if np.isfinite(line.range_m):
            yield at_s, agent_id, MeasuredRange(line.target, line.range_m, line.sigma_m)


def _ids(agents: tuple[int, ...]) -> str:
    return f"the bodies {', '.join(map(str, agents))}"
