"""MAVLink bytes to messages and back: the ardupilotmega dialect of MAVLink 2, codec only.

pymavlink's connection helpers (mavutil) are not used: they block, read clocks and default to MAVLink 1.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from agent.mavlink.dialect import mavlink
from agent.mavlink.signing import LinkSigning

__all__ = ["Decoder", "Encoder", "Message", "mavlink"]

Message = Any
"""A pymavlink message of the dialect; pymavlink has no useful common type."""

_KEEP_BYTES = 4096
_NEAR = 16


class Decoder:
    """Bytes of one remote endpoint to messages; bad bytes are counted, never raised.

    A datagram holds whole frames, so what a datagram leaves unparsed is dropped and counted: a stray 0xFD
    cannot swallow the frames of the next one. A stream (serial, TCP) keeps it. With ``signing`` only frames that
    it accepts are good.
    """

    def __init__(self, *, datagrams: bool, signing: LinkSigning | None = None) -> None:
        self._datagrams = datagrams
        self.signing = signing
        self._parser = _parser()
        self._sequence: dict[tuple[int, int], int] = {}
        self.received = 0
        """Good messages."""
        self.lost = 0
        """Messages missing by gaps in the senders' sequence numbers; those of unknown ids are not missing."""
        self.bad: Counter[str] = Counter()
        """Frames and stretches of bytes refused, by reason."""
        self.frames: tuple[bytes, ...] = ()
        """The good messages of the last `feed` as they came."""

    def feed(self, data: bytes) -> list[Message]:
        """The good messages in ``data``, and in what earlier calls left of a stream."""
        good = []
        for message in self._parser.parse_buffer(data) or ():
            if isinstance(message, mavlink.MAVLink_bad_data):
                self.bad[_reason(message.reason)] += 1
            elif isinstance(message, mavlink.MAVLink_unknown):
                self.bad["unknown message"] += 1  # its checksum could not be verified either
                self._pass(message)
            elif self.signing is not None and not self.signing.accepts(bytes(message.get_msgbuf())):
                self.bad["not authentic"] += 1  # why is counted by `signing`
            else:
                self._count(message)
                good.append(message)
        self.frames = tuple(bytes(message.get_msgbuf()) for message in good)
        self._trim()
        return good

    def _count(self, message: Message) -> None:
        self.received += 1
        source = (message.get_srcSystem(), message.get_srcComponent())
        last = self._sequence.get(source)
        gap = 0 if last is None else (message.get_seq() - last - 1) % 256
        if gap < 128:  # more is a message overtaken, not a hundred lost
            self.lost += gap
        self._sequence[source] = message.get_seq()

    def _pass(self, message: Message) -> None:
        """Take an unknown message's number for sent, if it is near the last one: nobody vouches for its frame."""
        source, number = _header(bytes(message.get_msgbuf()))
        last = self._sequence.get(source)
        gap = _NEAR if last is None else (number - last - 1) % 256
        if gap < _NEAR:
            self.lost += gap
            self._sequence[source] = number

    def _trim(self) -> None:
        """Bound the parser's buffer, which pymavlink frees only when a read ends on a frame's end."""
        if self._datagrams and self._parser.buf_len():
            self.bad["truncated"] += 1
            self._parser = _parser()
        elif self._parser.buf_index > _KEEP_BYTES:
            self._parser.buf = self._parser.buf[self._parser.buf_index :]
            self._parser.buf_index = 0


def _header(frame: bytes) -> tuple[tuple[int, int], int]:
    """(system, component) and sequence number of a frame, of either version of MAVLink."""
    at = 4 if frame[0] == mavlink.PROTOCOL_MARKER_V2 else 2
    return (frame[at + 1], frame[at + 2]), frame[at]


def _parser() -> Any:
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    return parser


def _reason(text: str) -> str:
    """pymavlink's reason without its numbers, so that garbage cannot grow the table of counters."""
    for known in ("prefix", "CRC", "length", "incompat_flags", "signature", "instantiate"):
        if known in text:
            return f"bad {known}"
    return "bad frame"


class Encoder:
    """Messages of one component to MAVLink 2 frames, numbered in sequence, and signed with ``signing``."""

    def __init__(self, system_id: int, component_id: int, signing: LinkSigning | None = None) -> None:
        self._signing = signing
        self._packer = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self.sent = 0

    @property
    def system_id(self) -> int:
        """System id of the frames; the autopilot's own once it is known."""
        return int(self._packer.srcSystem)

    @system_id.setter
    def system_id(self, system_id: int) -> None:
        self._packer.srcSystem = system_id

    @property
    def component_id(self) -> int:
        """Component id of the frames."""
        return int(self._packer.srcComponent)

    def encode(self, message: Message) -> bytes:
        """The message as one frame."""
        if self._signing is not None:
            self._signing.prepare(self._packer)
        frame = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256
        self.sent += 1
        return frame
