"""Reads flight logs back, as far as they go: a record that was cut off anywhere gives its beginning."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader

from agent.errors import LogFileError
from agent.inputs import Input, MavlinkIn
from agent.log.estimate_mcap import EstimateMessage, estimate_topic
from agent.log.flight_format import CUT_OFF, END, KINDS, START, FlightStart, MavlinkLaid, input_topic, start_from
from agent.log.tlog import SUFFIX as TLOG_SUFFIX
from agent.log.tlog import read_frames

MAX_RECORD_BYTES = 64 * 1024 * 1024
_BROKEN = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error, ValueError, KeyError, OverflowError,
    MemoryError,  # a length that a flipped bit has made huge
)  # fmt: skip
"""What a file that is cut off or damaged makes the reader raise."""


class _Gap(Exception):
    """The record does not go on from here; the message says why."""


@dataclass(frozen=True, slots=True)
class RecordedInput:
    """An input and its number, from 1 on."""

    number: int
    event: Input


RecordedEntry = RecordedInput | EstimateMessage


class FlightReader:
    """One agent's flight log.

    ``start`` says how the run began. Iterating gives inputs and estimates in the order in which the agent took them
    in and gave them out; after that ``ended`` says why there are no more (`agent.flight_format.CLOSED`,
    the reason for an early end, or that the file is cut off).
    """

    def __init__(self, path: Path) -> None:
        """Open ``path`` (.mcap); the .tlog is beside it. Raises `LogFileError` if it is no flight log."""
        self.path = path
        self.ended = ""
        try:
            with path.open("rb") as stream:
                self.start = self._start(stream)
        except OSError as error:
            raise LogFileError(f"record {path}: cannot be read: {error.strerror}") from error

    def __iter__(self) -> Iterator[RecordedEntry]:
        self.ended = CUT_OFF
        try:
            with self.path.open("rb") as stream, self.path.with_suffix(TLOG_SUFFIX).open("rb") as tlog:
                yield from self._entries(stream, tlog)
        except OSError as error:
            raise LogFileError(f"record {self.path}: cannot be read: {error.filename}: {error.strerror}") from error
        except _Gap as gap:
            self.ended = f"{CUT_OFF}: {gap}"
        except _BROKEN as error:
            self.ended = f"{CUT_OFF}: {type(error).__name__}"

    def _start(self, stream: IO[bytes]) -> FlightStart:
        where = f"record {self.path}: expected a flight log"
        try:
            for record in _records(stream):
                if isinstance(record, Metadata) and record.name == START:
                    return start_from(record.metadata)
                if isinstance(record, Message):
                    break
        except LogFileError as error:
            raise LogFileError(f"{where}: {error}") from error
        except _BROKEN as error:
            raise LogFileError(f"{where} (MCAP): {type(error).__name__}") from error
        raise LogFileError(f"{where}, found MCAP without metadata {START!r}")

    def _entries(self, stream: IO[bytes], tlog: IO[bytes]) -> Iterator[RecordedEntry]:
        agent_id = self.start.agent
        kinds = {input_topic(agent_id, name): kind for name, kind in KINDS.items()}
        topics: dict[int, str] = {}
        ended, number = CUT_OFF, 0
        for record in _records(stream):
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata) and record.name == END:
                ended = record.metadata.get("reason", CUT_OFF)  # ahead of the last chunk
            elif isinstance(record, Message):
                topic = topics[record.channel_id]
                if topic in kinds:
                    number += 1
                    if record.sequence != number & 0xFFFFFFFF:
                        raise _Gap(f"input {record.sequence} where {number} was expected")
                    laid = msgspec.json.decode(record.data, type=kinds[topic])
                    yield RecordedInput(number, _with_frames(laid, tlog) if isinstance(laid, MavlinkLaid) else laid)
                elif topic == estimate_topic(agent_id):
                    yield msgspec.json.decode(record.data, type=EstimateMessage)
        self.ended = ended


def _records(stream: IO[bytes]) -> Iterator[object]:
    return iter(StreamReader(stream, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES).records)


def _with_frames(laid: MavlinkLaid, tlog: IO[bytes]) -> MavlinkIn:
    """The bytes of a read put together again; raises `_Gap` if the .tlog does not have them."""
    frames: list[bytes] = []
    size = 0
    if laid.size:
        for frame in read_frames(tlog, laid.offset):
            frames.append(frame)
            size += len(frame)
            if size >= laid.size:
                break
    if size != laid.size:
        raise _Gap(f"the {TLOG_SUFFIX} ends at {laid.offset + size} bytes or is another one")
    return MavlinkIn(laid.host_s, b"".join(frames)[laid.skip :] + laid.rest, tuple(frames))
