"""Ed25519 over key expression, header and body: proof of origin that survives relays and recordings.

Signed is ``"CLv1" 0 key 0 header blake2b256(body)``. The key in it keeps a packet from being replayed as
another stream's, the fleet and sender in the header from being another fleet's or agent's.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

from nacl.encoding import HexEncoder
from nacl.exceptions import BadSignatureError
from nacl.signing import SigningKey, VerifyKey

from transport.errors import Reason, Rejected
from transport.messages.header import HEADER_BYTES, SIGNATURE_BYTES

_DOMAIN = b"CLv1\0"


class Unsigned:
    """Stands in for keys where a laboratory explicitly asks for packets without signatures."""


UNSIGNED = Unsigned()

Signing = SigningKey | Unsigned
"""What an agent signs with."""
Trust = Mapping[int, tuple[VerifyKey, ...]] | Unsigned
"""Whose signatures are accepted: public keys by agent id, newest first (two while a key is being rotated)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Who an agent is on the radio.

    ``signing`` is its own key, ``trust`` whom it believes, ``boot`` the number of this start: greater than at every
    earlier one (`transport.security.keys.next_boot`).
    """

    signing: Signing = field(default=UNSIGNED, repr=False)
    trust: Trust = UNSIGNED
    boot: int = 1


def signed_bytes(key: str, header: bytes, body: bytes) -> bytes:
    """What the signature covers; of fixed length but for the key, however long the body is."""
    return b"".join((_DOMAIN, key.encode(), b"\0", header, hashlib.blake2b(body, digest_size=32).digest()))


def sign(signing: SigningKey, key: str, header: bytes, body: bytes) -> bytes:
    """The 64-byte signature of a packet."""
    return signing.sign(signed_bytes(key, header, body)).signature


def verify(public_keys: tuple[VerifyKey, ...], key: str, packet: bytes) -> None:
    """Raises `Rejected` unless one of the keys signed this packet for this key expression."""
    header, body = packet[:HEADER_BYTES], packet[HEADER_BYTES:-SIGNATURE_BYTES]
    message, signature = signed_bytes(key, header, body), packet[-SIGNATURE_BYTES:]
    for public_key in public_keys:
        try:
            public_key.verify(message, signature)
        except BadSignatureError:
            continue
        return
    raise Rejected(Reason.BAD_SIGNATURE)


def fingerprint(public_key: VerifyKey) -> str:
    """Sixteen hexadecimal digits that tell keys apart for people."""
    return hashlib.blake2b(public_key.encode(), digest_size=8).hexdigest()


def public_hex(public_key: VerifyKey) -> str:
    """The 32 bytes of a public key as text."""
    return public_key.encode(HexEncoder).decode("ascii")
