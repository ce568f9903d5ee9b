"""The body for people: diagnostics, how an agent is doing."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from transport.errors import EncodeError, Reason, Rejected

Text = Annotated[str, msgspec.Meta(max_length=128)]
Name = Annotated[str, msgspec.Meta(max_length=64)]


class Diagnostics(msgspec.Struct, frozen=True, omit_defaults=True):
    """How an agent is doing, as JSON: its state, the reasons for it, and counters and gauges by name.

    ``neighbours`` holds the gauges of each neighbour by id. Units are in the names (``age_s``).
    """

    agent_id: Annotated[int, msgspec.Meta(ge=1, le=999)]
    state: Name
    reasons: Annotated[tuple[Text, ...], msgspec.Meta(max_length=32)] = ()
    counters: Annotated[dict[Name, int], msgspec.Meta(max_length=256)] = {}
    gauges: Annotated[dict[Name, float], msgspec.Meta(max_length=256)] = {}
    neighbours: Annotated[dict[Name, dict[Name, float]], msgspec.Meta(max_length=256)] = {}
    integrity: Text = ""
    """State and reason of what is promised of the own position (docs/integrity.md)."""
    targets: Annotated[dict[Name, Name], msgspec.Meta(max_length=256)] = {}
    """What it knows of each target, by id."""


_DIAGNOSTICS = msgspec.json.Decoder(Diagnostics)


def encode_diagnostics(diagnostics: Diagnostics) -> bytes:
    """JSON; raises `EncodeError` if a field is out of its bounds or a number is not finite."""
    gauges = [diagnostics.gauges, *diagnostics.neighbours.values()]
    if not all(math.isfinite(value) for table in gauges for value in table.values()):
        raise EncodeError("diagnostics: every gauge must be finite; leave out what is not known")
    body = msgspec.json.encode(diagnostics)
    try:
        _DIAGNOSTICS.decode(body)
    except msgspec.ValidationError as error:
        raise EncodeError(f"Diagnostics: {error}") from None
    return body


def decode_diagnostics(body: bytes) -> Diagnostics:
    """The diagnostics in a body; raises `Rejected`."""
    try:
        return _DIAGNOSTICS.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Rejected(Reason.MALFORMED, str(error)) from None
