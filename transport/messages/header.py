"""The fixed 40-byte header in front of every packet.

Little endian ``<2sBBHBBIIIHHqII``: magic ``CL``, version, kind, sender, flags, round, boot, sequence number (per
sender and kind), tick, n, body length, time, fleet, agreement. ``n`` counts what the body holds: records of a
measurement body, agents of an information, window or estimate body, reports of a far-field body, 0 otherwise. Magic
and version stand where they stood in every version, so that each can tell another one.

Version 1, ``<2sBBHHIIIHHqII`` with flags, boot, sequence number, tick, round, n, time, body length, fleet behind the
sender, had no agreement. No daemon talks it any more; flight logs that hold it can be repeated.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID, Stream

HEADER = struct.Struct("<2sBBHBBIIIHHqII")
_HEADER_1 = struct.Struct("<2sBBHHIIIHHqII")
HEADER_BYTES = HEADER.size
SIGNATURE_BYTES = 64
MAX_DATAGRAM_BYTES = 1200
"""Header, body and signature of a packet that crosses a radio unfragmented."""
MAX_DATAGRAM_BODY_BYTES = MAX_DATAGRAM_BYTES - HEADER_BYTES - SIGNATURE_BYTES

MAGIC = b"CL"
VERSION = 2
VERSION_AT = 2
"""Where the version stands in a packet."""
RECORDED_VERSIONS = (1, VERSION)
"""What flight logs may hold."""
MAX_TICK = 2**32 - 1
FLAG_FLOAT64 = 0b1
"""The body's numbers are float64 instead of float32."""
KNOWN_FLAGS = FLAG_FLOAT64


class PacketKind(IntEnum):
    """What the body is; its stream is that of its name, but that windows travel as information. 4 is not used."""

    MEAS = 1
    INFO = 2
    EST = 3
    CLOCK = 5
    DIAG = 6
    FAR = 7
    WINDOW = 8
    AGREE = 9


STREAM_OF_KIND = {kind: Stream.INFO if kind is PacketKind.WINDOW else Stream[kind.name] for kind in PacketKind}

MAX_BODY_BYTES = {
    PacketKind.MEAS: MAX_DATAGRAM_BODY_BYTES,
    PacketKind.INFO: MAX_DATAGRAM_BODY_BYTES,
    PacketKind.EST: 64 * 1024 - 1,
    PacketKind.CLOCK: 64,
    PacketKind.DIAG: 16 * 1024,
    PacketKind.FAR: MAX_DATAGRAM_BODY_BYTES,
    PacketKind.WINDOW: 8 * 1024,
    PacketKind.AGREE: MAX_DATAGRAM_BODY_BYTES,
}
MAX_PACKET_BYTES = HEADER_BYTES + max(MAX_BODY_BYTES.values()) + SIGNATURE_BYTES


@dataclass(frozen=True, slots=True)
class Header:
    """Who sent what, when and in which order.

    Attributes
    ----------
    kind : Kind
    sender : int
        Agent id.
    boot : int
        Rises with every start of the sender (u32).
    seq : int
        Rises with every packet of this kind since the start (u32).
    tick : int
        Fleet tick the packet belongs to (u32).
    round : int
        Consensus round, or exchange of measurements of the tick; 0 where there is none (u8).
    n : int
        What the body holds (u16), see the module.
    t_ns : int
        Sender's UTC clock when it sent, ns since 1970 (i64).
    body_bytes : int
        Length of the body (u16).
    fleet : int
        `fleet_hash` of the fleet's name.
    flags : int
        `FLAG_FLOAT64` or 0.
    agreement : int
        `transport.messages.agreement_body.agreement_hash` of what the sender shares with the fleet.
    version : int
        Of the packet.
    """

    kind: PacketKind
    sender: int
    boot: int
    seq: int
    tick: int
    round: int
    n: int
    t_ns: int
    body_bytes: int
    fleet: int
    flags: int = 0
    agreement: int = 0
    version: int = VERSION


def fleet_hash(fleet: str) -> int:
    """The first four bytes of BLAKE2b of the fleet's name, as in the header."""
    return int.from_bytes(hashlib.blake2b(fleet.encode(), digest_size=4).digest(), "little")


def pack_header(header: Header) -> bytes:
    """The 40 bytes; raises `EncodeError` if a field does not fit."""
    h = header
    try:
        return HEADER.pack(
            MAGIC, VERSION, h.kind, h.sender, h.flags, h.round, h.boot, h.seq, h.tick, h.n, h.body_bytes,
            h.t_ns, h.fleet, h.agreement,
        )  # fmt: skip
    except struct.error as error:
        raise EncodeError(f"packet header {h}: {error}") from None


def unpack_header(packet: bytes, *, fleet: int, signed: bool, versions: Collection[int] = (VERSION,)) -> Header:
    """The header of a packet whose size, version, kind, flags, fleet and length are as they must be.

    Nothing of the body is looked at, and agreement is for the caller to judge. Raises `Rejected`.
    """
    if len(packet) < HEADER_BYTES:
        raise Rejected(Reason.TOO_SHORT, f"{len(packet)} bytes, header alone has {HEADER_BYTES}")
    if len(packet) > MAX_PACKET_BYTES:
        raise Rejected(Reason.TOO_LONG, f"{len(packet)} bytes, at most {MAX_PACKET_BYTES}")
    if packet[:VERSION_AT] != MAGIC:
        raise Rejected(Reason.BAD_MAGIC)
    version, agreement = packet[VERSION_AT], 0
    if version not in versions:
        raise Rejected(Reason.BAD_VERSION, f"version {version}, expected {VERSION}")
    if version == 1:
        _, _, kind_code, sender, flags, boot, seq, tick, round_, n, t_ns, body_bytes, fleet_found = (
            _HEADER_1.unpack_from(packet)
        )
    else:
        _, _, kind_code, sender, flags, round_, boot, seq, tick, n, body_bytes, t_ns, fleet_found, agreement = (
            HEADER.unpack_from(packet)
        )
    try:
        kind = PacketKind(kind_code)
    except ValueError:
        raise Rejected(Reason.UNKNOWN_KIND, f"kind {kind_code}") from None
    if fleet_found != fleet:
        raise Rejected(Reason.WRONG_FLEET, f"fleet hash {fleet_found:08x}, expected {fleet:08x}")
    if flags & ~KNOWN_FLAGS:
        raise Rejected(Reason.BAD_FLAGS, f"flags {flags:#06x}")
    if body_bytes > MAX_BODY_BYTES[kind]:
        raise Rejected(Reason.TOO_LONG, f"{kind.name} body of {body_bytes}, at most {MAX_BODY_BYTES[kind]}")
    expected = HEADER_BYTES + body_bytes + (SIGNATURE_BYTES if signed else 0)
    if signed and len(packet) == HEADER_BYTES + body_bytes:
        raise Rejected(Reason.UNSIGNED, f"from sender {sender}")
    if len(packet) != expected:
        raise Rejected(Reason.BAD_LENGTH, f"{len(packet)} bytes, expected {expected}")
    if not MIN_AGENT_ID <= sender <= MAX_AGENT_ID:
        raise Rejected(Reason.UNKNOWN_SENDER, f"id {sender}")
    return Header(kind, sender, boot, seq, tick, round_, n, t_ns, body_bytes, fleet_found, flags, agreement, version)
