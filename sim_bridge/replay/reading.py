"""Logs read by processes beside the one that replays them.

Finding frames, checking and converting them costs about as much as half of what the agents do with them, and nothing
of it depends on the agents. One process reads ahead of them, as far as its pipe holds (a few thousand samples,
whatever the length of the logs); before that, the logs are surveyed side by side. What comes out is the same.
"""

from __future__ import annotations

import marshal
import pickle
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any

from agent.sensing.samples import AttitudeSample, ImuSample
from sim_bridge import side_process
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.feed import Arrival, Feed, Tallies
from sim_bridge.replay.logs.events import LogSource
from sim_bridge.replay.naming import names_apart
from sim_bridge.replay.side_files.range_files import RangeLine

BATCH = 500
"""Arrivals that cross the pipe together; a batch is about as large as the pipe's buffer."""
END_S = 5.0
"""How long the reader may take to end once nobody listens to it."""
STREAMED = ("tlog", "dataflash")
"""Formats whose survey is a pass over the file that leaves nothing large behind."""

_FREQUENT: tuple[tuple[type[Any], Callable[[Any], tuple[Any, ...]]], ...] = (
    (ImuSample, lambda s: (s.t_s, s.specific_force_mps2, s.gyro_radps)),
    (AttitudeSample, lambda s: (s.t_s, s.quaternion, s.aided, s.receiver_frozen)),
    (RangeLine, lambda r: (r.time_s, r.observer, r.target, r.range_m, r.sigma_m, r.true_m)),
    (type(None), lambda _: ()),
)
"""What crosses the pipe as its fields: `pickle` alone would cost more than reading the log."""
_PICKLED = len(_FREQUENT)
_PLACE_OF = {kind: place for place, (kind, _) in enumerate(_FREQUENT)}


def surveyed(sources: Sequence[LogSource]) -> list[LogSource]:
    """The sources with their surveys made, side by side where that is possible.

    Raises `LogError` of the first log that cannot be read.
    """
    alike = all(source.format in STREAMED for source in sources)
    if len(sources) > 1 and alike and side_process.may_fork():
        try:
            with side_process.workers(len(sources)) as pool:
                return list(pool.map(_surveyed, sources))
        except side_process.Killed:
            names = ", ".join(names_apart(source.path for source in sources).values())
            raise ReplayError(names, "to be surveyed", "the surveying process was killed") from None
    return [_surveyed(source) for source in sources]


@contextmanager
def read_beside(feed: Feed) -> Iterator[Iterator[Arrival]]:
    """The arrivals of a feed, made by a second process where that is possible.

    The feed's tallies are complete once the stream has ended. The reader ends with the context at the latest.
    """
    if not side_process.may_fork():
        yield feed.arrivals()
        return
    context = side_process.CONTEXT
    receiving, sending = context.Pipe(duplex=False)
    reader = context.Process(target=_read, args=(receiving, sending, feed), name="log reader", daemon=True)
    with side_process.forking():
        reader.start()
    sending.close()
    feed.references.close()  # the reader has its own
    try:
        yield _received(receiving, feed)
    finally:
        receiving.close()
        reader.join(END_S)
        if reader.is_alive():
            reader.kill()
            reader.join()
        reader.close()


def _surveyed(source: LogSource) -> LogSource:
    source.survey()
    return source


# --- over the pipe -------------------------------------------------------------------------------------------


def _read(receiving: Connection, sending: Connection, feed: Feed) -> None:
    """The second process: batches, an empty message, then what was counted or what was raised."""
    side_process.ignore_interrupts()  # it ends when the replay closes the pipe
    receiving.close()  # else it would keep its own pipe open
    arrivals = feed.arrivals()
    end: Tallies | Exception
    try:
        try:
            while batch := [_packed(arrival) for arrival in islice(arrivals, BATCH)]:
                sending.send_bytes(marshal.dumps(batch))
            end = feed.tallies()
        except BrokenPipeError:
            raise
        except Exception as fault:  # noqa: BLE001 - whatever it is, the replay is to raise it
            fault.add_note(f"in the process that reads the logs:\n{traceback.format_exc()}")
            end = fault
        sending.send_bytes(b"")
        sending.send_bytes(pickle.dumps(end))
    except BrokenPipeError:
        return  # the replay has ended before the logs


def _received(receiving: Connection, feed: Feed) -> Iterator[Arrival]:
    makers = [kind for kind, _ in _FREQUENT]
    while data := _message(receiving, feed):
        for arrival_s, agent_id, place, fields in marshal.loads(data):
            heard = pickle.loads(fields) if place == _PICKLED else makers[place](*fields)
            yield arrival_s, agent_id, heard
    end = pickle.loads(_message(receiving, feed))
    if isinstance(end, Exception):
        raise end
    feed.absorb(end)


def _message(receiving: Connection, feed: Feed) -> bytes:
    try:
        return receiving.recv_bytes()
    except (EOFError, OSError):  # the second in the midst of a message
        names = ", ".join(names_apart(vehicle.source.path for vehicle in feed.inputs.plan.vehicles).values())
        raise ReplayError(names, "to be read to the end", "the reading process was killed") from None


def _packed(arrival: Arrival) -> tuple[float, int, int, Any]:
    arrival_s, agent_id, heard = arrival
    place = _PLACE_OF.get(type(heard), _PICKLED)
    fields = pickle.dumps(heard) if place == _PICKLED else _FREQUENT[place][1](heard)
    return arrival_s, agent_id, place, fields
