"""What a flight log holds: the texts at its begin and end, and how inputs are laid down in channels.

docs/replay.md describes the files for users. Every input is a JSON message of its own channel, numbered in
the order of taking in (``sequence``). Bytes are base64. MAVLink bytes are not here but in the .tlog: an input
says where there, and holds only what belongs to no whole frame.
"""

from __future__ import annotations

from typing import Any

import msgspec
from nacl.signing import VerifyKey

from agent.errors import LogFileError
from agent.inputs import Due, Gone, HouseKept, Input, MavlinkIn, PacketIn, Served, UwbIn
from agent.log.estimate_mcap import agent_key
from transport.security.auth import UNSIGNED, Trust, Unsigned, public_hex

FORMAT = "fleetloc-flight/1"
START, END = "fleetloc.start", "fleetloc.end"
CLOSED, CUT_OFF = "closed", "cut off"


class FlightStart(msgspec.Struct, frozen=True, kw_only=True):
    """How the run began; ``unix_s`` and ``host_s`` are the instant from which its fleet clock goes."""

    format: str = FORMAT
    agent: int
    config: str
    """The configuration in effect, TOML."""
    trust: str
    """Public keys by agent as JSON, or ``unsigned``; no secret is ever recorded."""
    unix_s: float
    host_s: float
    software: str

    def texts(self) -> dict[str, str]:
        """As MCAP metadata, numbers with all their digits."""
        return {name: value if isinstance(value, str) else repr(value) for name, value in _fields(self).items()}


class MavlinkLaid(msgspec.Struct, frozen=True, omit_defaults=True):
    """A `MavlinkIn` as it is laid down.

    Its bytes are ``size`` bytes of frames in the .tlog from the stamp at ``offset``, the first ``skip`` of them left
    out (they came with the read before), and then ``rest``.
    """

    host_s: float
    offset: int = 0
    size: int = 0
    skip: int = 0
    rest: bytes = b""


Laid = MavlinkLaid | Served | PacketIn | UwbIn | Gone | Due | HouseKept
NAMES: dict[type[Laid], str] = {
    MavlinkLaid: "mavlink",
    Served: "served",
    PacketIn: "packet",
    UwbIn: "uwb",
    Gone: "gone",
    Due: "due",
    HouseKept: "clock",
}
KINDS = {name: kind for kind, name in NAMES.items()}


def input_topic(agent_id: int, name: str) -> str:
    """Topic of one sort of input of an agent."""
    return f"/{agent_key(agent_id)}/input/{name}"


def input_schema(kind: type[Laid]) -> dict[str, Any]:
    """JSON schema of one sort of input, without references, which not every viewer follows."""
    _, components = msgspec.json.schema_components([kind])
    return dict(components[kind.__name__])


def lay(event: Input, offset: int, waiting: int) -> tuple[Laid, int]:
    """An input as it is laid down, its frames at ``offset`` of the .tlog, and how many bytes wait for more after it.

    ``waiting``: how many did before, at the end of the last read, of a frame still coming (serial lines and TCP).
    """
    if not isinstance(event, MavlinkIn):
        return event, waiting
    whole = b"".join(event.frames)
    rest = event.data[len(whole) - waiting :] if len(whole) >= waiting else b""
    if event.frames and whole[waiting:] + rest == event.data:
        return MavlinkLaid(event.host_s, offset, len(whole), waiting, rest), len(rest)
    if not event.frames:
        return MavlinkLaid(event.host_s, rest=event.data), waiting + len(event.data)
    last = event.data.rfind(event.frames[-1])
    after = len(event.data) - last - len(event.frames[-1]) if last >= 0 else 0
    return MavlinkLaid(event.host_s, rest=event.data), after


def trust_text(trust: Trust) -> str:
    """Public keys as JSON text, or ``unsigned``."""
    if isinstance(trust, Unsigned):
        return "unsigned"
    keys = {str(agent_id): [public_hex(key) for key in keys] for agent_id, keys in trust.items()}
    return msgspec.json.encode(keys).decode()


def trust_from(text: str) -> Trust:
    """The keys in a text of `trust_text`; raises `LogFileError`."""
    if text == "unsigned":
        return UNSIGNED
    try:
        keys = msgspec.json.decode(text, type=dict[int, list[str]])
        return {agent_id: tuple(VerifyKey(bytes.fromhex(key)) for key in each) for agent_id, each in keys.items()}
    except (msgspec.DecodeError, ValueError) as error:
        raise LogFileError(f"public keys: expected JSON of agent ids and hexadecimal keys: {error}") from error


def start_from(texts: dict[str, str]) -> FlightStart:
    """The begin of a record from its metadata; raises `LogFileError`."""
    try:
        start = msgspec.convert(texts, FlightStart, strict=False)
    except msgspec.ValidationError as error:
        raise LogFileError(f"metadata {START}: {error}") from error
    if start.format != FORMAT:
        raise LogFileError(f"expected {FORMAT}, found {start.format[:40]!r}")
    return start


def _fields(start: FlightStart) -> dict[str, Any]:
    return msgspec.structs.asdict(start)
