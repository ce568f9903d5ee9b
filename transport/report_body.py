"""Bodies for people and for the books: the card (what an agent is) and the diagnostics (how it is doing)."""

from __future__ import annotations

import math
from typing import Annotated, TypeVar

import msgspec

from transport.errors import EncodeError, Reason, Rejected

Text = Annotated[str, msgspec.Meta(max_length=128)]
Name = Annotated[str, msgspec.Meta(max_length=64)]


class Card(msgspec.Struct, frozen=True, array_like=True):
    """What an agent is. Later versions may append fields; older readers ignore them.

    ``config_hash`` lets neighbours see that they fly different fleet configurations; ``public_key_hash`` is
    `transport.auth.fingerprint` of the key it signs with (empty when unsigned).
    """

    agent_id: Annotated[int, msgspec.Meta(ge=1, le=999)]
    name: Name = ""
    software: Name = ""
    fleet_size: Annotated[int, msgspec.Meta(ge=0, le=999)] = 0
    period_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.0
    config_hash: Name = ""
    public_key_hash: Name = ""
    endpoints: Annotated[tuple[Text, ...], msgspec.Meta(max_length=8)] = ()


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


_CARD = msgspec.msgpack.Decoder(Card)
_DIAGNOSTICS = msgspec.json.Decoder(Diagnostics)
_Body = TypeVar("_Body", Card, Diagnostics)


def encode_card(card: Card) -> bytes:
    """MessagePack; raises `EncodeError` if a field is out of its bounds."""
    return _checked(msgspec.msgpack.encode(card), _CARD)


def decode_card(body: bytes) -> Card:
    """The card in a body; raises `Rejected`."""
    return _decoded(body, _CARD)


def encode_diagnostics(diagnostics: Diagnostics) -> bytes:
    """JSON; raises `EncodeError` if a field is out of its bounds or a number is not finite."""
    gauges = [diagnostics.gauges, *diagnostics.neighbours.values()]
    if not all(math.isfinite(value) for table in gauges for value in table.values()):
        raise EncodeError("diagnostics: every gauge must be finite; leave out what is not known")
    return _checked(msgspec.json.encode(diagnostics), _DIAGNOSTICS)


def decode_diagnostics(body: bytes) -> Diagnostics:
    """The diagnostics in a body; raises `Rejected`."""
    return _decoded(body, _DIAGNOSTICS)


_Decoder = msgspec.msgpack.Decoder[_Body] | msgspec.json.Decoder[_Body]


def _checked(body: bytes, decoder: _Decoder[_Body]) -> bytes:
    try:
        decoder.decode(body)
    except msgspec.ValidationError as error:
        raise EncodeError(f"{decoder.type.__name__}: {error}") from None
    return body


def _decoded(body: bytes, decoder: _Decoder[_Body]) -> _Body:
    try:
        return decoder.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise Rejected(Reason.MALFORMED, str(error)) from None
