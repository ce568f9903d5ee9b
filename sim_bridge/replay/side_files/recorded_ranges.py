"""The ranges in a daemon's flight log (.mcap): the ``uwb-range/1`` frames that its own module sent."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from agent.inputs import HouseKept, UwbIn
from agent.log.flight_reader import FlightReader, RecordedInput
from sim_bridge.replay.side_files.range_files import RangeCounts, RangeLine, in_order, ranges_at
from transport.errors import Rejected
from transport.messages.uwb_body import decode_uwb


def ranges_of_record(path: Path, counts: RangeCounts) -> Iterator[RangeLine]:
    """The ranges of a flight log on Unix time; frames that cannot be read are counted.

    A frame without a stamp of its own has the time of its arrival. Raises `LogFileError` for a file that is no
    flight log.
    """
    return in_order(_lines(path, counts), counts)


def _lines(path: Path, counts: RangeCounts) -> Iterator[tuple[int, RangeLine]]:
    reader = FlightReader(path)
    unix_of_host_s = reader.start.unix_s - reader.start.host_s
    for entry in reader:
        if not isinstance(entry, RecordedInput):
            continue
        event = entry.event
        if isinstance(event, HouseKept):
            unix_of_host_s = event.unix_s - event.host_s
        elif isinstance(event, UwbIn):
            try:
                frame = decode_uwb(event.data)
            except Rejected as rejected:
                counts.skip(f"frame: {rejected.reason}", entry.number)
                continue
            time_s = frame.t_ns * 1e-9 if frame.clock == "unix" else unix_of_host_s + (
                frame.t_ns * 1e-9 if frame.clock == "mono" else event.host_s
            )
            for line in ranges_at(frame, reader.start.agent if frame.observer is None else frame.observer, time_s):
                yield entry.number, line
