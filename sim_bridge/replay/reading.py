"""The logs of a replay as one stream of samples in order of arrival, read here or by a second process.

Finding frames, checking and converting them costs about as much as half of what the agents do with them, and nothing
of it depends on the agents: a second process reads ahead, as far as its pipe holds (a few thousand samples, whatever
the length of the logs). It says the same in the same order, so that results do not depend on who reads.
"""

from __future__ import annotations

import heapq
import marshal
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from multiprocessing.connection import Connection
from operator import itemgetter
from typing import Any

from agent.samples import AttitudeSample, AutopilotEstimate, ImuSample
from sim_bridge.logs.events import LogCounts, LogSample, LogSource, TruthSample
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.plan import Vehicle

LogArrival = tuple[float, int, LogSample]
"""Fleet time of arrival, agent, sample on fleet time."""
BATCH = 500
"""Samples that cross the pipe together; a batch is about as large as the pipe's buffer."""
END_S = 5.0
"""How long the reader may take to end once nobody listens to it."""

_FREQUENT: tuple[tuple[type[Any], Callable[[Any], tuple[Any, ...]]], ...] = (
    (ImuSample, lambda s: (s.t_s, s.specific_force_mps2, s.gyro_radps)),
    (AttitudeSample, lambda s: (s.t_s, s.quaternion)),
    (TruthSample, lambda s: (s.t_s, s.position_m, s.velocity_mps, s.quaternion, s.has_height)),
    (AutopilotEstimate, lambda s: (s.t_s, s.position_m, s.velocity_mps)),
)
"""Kinds of samples that cross the pipe as their fields: `pickle` alone would cost more than reading the log."""
_PICKLED = len(_FREQUENT)
_PLACE_OF = {kind: place for place, (kind, _) in enumerate(_FREQUENT)}


def log_arrivals(vehicles: Sequence[Vehicle], *, to_s: float, with_truth: bool) -> Generator[LogArrival, None, None]:
    """The samples of all vehicles in order of arrival, up to the first one after fleet time ``to_s``.

    Without ``with_truth`` those of the truth are left out. Raises `LogError`.
    """
    by_source: dict[int, list[Vehicle]] = {}
    for vehicle in vehicles:
        by_source.setdefault(id(vehicle.source), []).append(vehicle)
    streams = [_of_log(of_source[0].source, of_source, with_truth) for of_source in by_source.values()]
    try:
        for arrival in heapq.merge(*streams, key=itemgetter(0)):
            yield arrival
            if arrival[0] > to_s:
                return
    finally:
        for stream in streams:
            stream.close()


@contextmanager
def read_beside(vehicles: Sequence[Vehicle], *, to_s: float, with_truth: bool) -> Iterator[Iterator[LogArrival]]:
    """`log_arrivals`, read by a second process where that is possible.

    The sources' ``counts`` are complete once the stream has ended. The reader ends with the context at the latest.
    """
    if not _may_fork():
        yield log_arrivals(vehicles, to_s=to_s, with_truth=with_truth)
        return
    context = multiprocessing.get_context("fork")
    receiving, sending = context.Pipe(duplex=False)
    arguments = (receiving, sending, vehicles, to_s, with_truth)
    reader = context.Process(target=_read, args=arguments, name="log reader", daemon=True)
    with warnings.catch_warnings():
        # of native threads, which Python >= 3.12 warns of: those of BLAS are made for it, and the reader uses none
        warnings.simplefilter("ignore", DeprecationWarning)
        reader.start()
    sending.close()
    try:
        yield _received(receiving, vehicles)
    finally:
        receiving.close()
        reader.join(END_S)
        if reader.is_alive():
            reader.kill()
            reader.join()
        reader.close()


def _may_fork() -> bool:
    """Whether a copy of this process can read: a second processor, and no thread that could hold a lock."""
    return sys.platform == "linux" and (os.cpu_count() or 1) > 1 and threading.active_count() == 1


def _of_log(source: LogSource, vehicles: list[Vehicle], with_truth: bool) -> Generator[LogArrival, None, None]:
    of_system = {vehicle.survey.system_id: vehicle for vehicle in vehicles}
    for event in source.events():
        vehicle = of_system.get(event.system_id)
        if vehicle is None or (not with_truth and isinstance(event.sample, TruthSample)):
            continue
        shift_s = vehicle.shift_s
        yield event.arrival_s + shift_s, vehicle.agent_id, _shifted(event.sample, shift_s)


def _shifted(sample: LogSample, shift_s: float) -> LogSample:
    """A sample on fleet time; the frequent kinds are made directly, as `replace` is slow."""
    if isinstance(sample, ImuSample):
        return ImuSample(sample.t_s + shift_s, sample.specific_force_mps2, sample.gyro_radps)
    if isinstance(sample, AttitudeSample):
        return AttitudeSample(sample.t_s + shift_s, sample.quaternion)
    return replace(sample, t_s=sample.t_s + shift_s)


# --- over the pipe -------------------------------------------------------------------------------------------


def _read(
    receiving: Connection, sending: Connection, vehicles: Sequence[Vehicle], to_s: float, with_truth: bool
) -> None:
    """The second process: batches, an empty message, then the sources' counts or what was raised."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends when the replay closes the pipe
    receiving.close()  # else it would keep its own pipe open
    arrivals = log_arrivals(vehicles, to_s=to_s, with_truth=with_truth)
    end: list[LogCounts] | Exception
    try:
        try:
            while batch := [_packed(arrival) for arrival in islice(arrivals, BATCH)]:
                sending.send_bytes(marshal.dumps(batch))
            end = [vehicle.source.counts for vehicle in vehicles]
        except BrokenPipeError:
            raise
        except Exception as fault:  # noqa: BLE001 - whatever it is, the replay is to raise it
            fault.add_note(f"in the process that reads the logs:\n{traceback.format_exc()}")
            end = fault
        sending.send_bytes(b"")
        sending.send_bytes(pickle.dumps(end))
    except BrokenPipeError:
        return  # the replay has ended before the logs


def _received(receiving: Connection, vehicles: Sequence[Vehicle]) -> Iterator[LogArrival]:
    makers = [kind for kind, _ in _FREQUENT]
    try:
        while data := receiving.recv_bytes():
            for arrival_s, agent_id, place, fields in marshal.loads(data):
                sample = pickle.loads(fields) if place == _PICKLED else makers[place](*fields)
                yield arrival_s, agent_id, sample
        end = pickle.loads(receiving.recv_bytes())
    except EOFError:
        names = ", ".join(dict.fromkeys(vehicle.source.path.name for vehicle in vehicles))
        raise ReplayError(names, "to be read to the end", "the reading process was killed") from None
    if isinstance(end, Exception):
        raise end
    for vehicle, counts in zip(vehicles, end, strict=True):
        vehicle.source.counts = counts


def _packed(arrival: LogArrival) -> tuple[float, int, int, Any]:
    arrival_s, agent_id, sample = arrival
    place = _PLACE_OF.get(type(sample), _PICKLED)
    fields = pickle.dumps(sample) if place == _PICKLED else _FREQUENT[place][1](sample)
    return arrival_s, agent_id, place, fields
