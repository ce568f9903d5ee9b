"""What a fleet has to share, by the name of its setting: hashed into every packet, told in full where hashes differ.

The body is JSON of names and values, and beside them who is heard twice. A value is told by its beginning and a hash
if it is long, so that any two can be told from each other and the body fits into a datagram.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import msgspec

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES

LONGEST_VALUE = 48
_HASH_BYTES = 4
_TWICE = "twice"
"""The name under which a body tells of whom two daemons are heard; no setting has it."""

_Text = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_VALUE)]
_DECODER = msgspec.json.Decoder(Annotated[dict[_Text, _Text], msgspec.Meta(max_length=24)])


@dataclass(frozen=True, slots=True)
class Agreement:
    """What an agent shares with its fleet: short values by the name of their setting."""

    settings: Mapping[str, str]
    twice: tuple[int, ...] = ()
    """Agents of whom two daemons are heard, in the eyes of who says so; not a part of what is hashed."""

    def differences(self, other: Agreement) -> tuple[str, ...]:
        """The names of which both say different things, or one says nothing, in order."""
        names = sorted({*self.settings, *other.settings})
        return tuple(name for name in names if self.settings.get(name) != other.settings.get(name))


def agreement_of(settings: Mapping[str, str]) -> Agreement:
    """An agreement about whole values, however long."""
    return Agreement({name: _shortened(value) for name, value in settings.items()})


def agreement_hash(agreement: Agreement) -> int:
    """Four bytes that stand for all of it, as in the header."""
    told = msgspec.json.encode(dict(agreement.settings), order="sorted")
    return int.from_bytes(hashlib.blake2b(told, digest_size=_HASH_BYTES).digest(), "little")


def encode_agreement(agreement: Agreement) -> bytes:
    """Body of an agreement packet; raises `EncodeError` for names and values that do not fit."""
    twice = {_TWICE: " ".join(map(str, agreement.twice))} if agreement.twice else {}
    body = msgspec.json.encode(dict(agreement.settings) | twice, order="sorted")
    try:
        _DECODER.decode(body)
    except msgspec.ValidationError as error:
        raise EncodeError(f"agreement: {error}") from None
    if len(body) > MAX_DATAGRAM_BODY_BYTES:
        raise EncodeError(f"agreement of {len(body)} bytes, at most {MAX_DATAGRAM_BODY_BYTES}")
    return body


def decode_agreement(body: bytes) -> Agreement:
    """The agreement in a body; raises `Rejected`."""
    try:
        settings = _DECODER.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Rejected(Reason.MALFORMED, f"agreement: {error}") from None
    if not all(text.isprintable() for pair in settings.items() for text in pair):
        raise Rejected(Reason.MALFORMED, "agreement with characters that cannot be shown")
    return Agreement(settings, _ids(settings.pop(_TWICE, "")))


def _ids(text: str) -> tuple[int, ...]:
    names = text.split()
    if not all(name.isascii() and name.isdecimal() for name in names):
        raise Rejected(Reason.MALFORMED, f"agreement: expected ids, found {text!r}")
    return tuple(int(name) for name in names)


def _shortened(value: str) -> str:
    if len(value) <= LONGEST_VALUE:
        return value
    digest = hashlib.blake2b(value.encode(), digest_size=8).hexdigest()
    return f"{value[: LONGEST_VALUE - len(digest) - 3]}...{digest}"
