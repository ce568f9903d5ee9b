"""Encrypted payloads for links without TLS: a signed packet inside authenticated encryption with the group key.

Layout, little endian: magic ``CE``, version, one byte of zero, boot u32, number u32, salt 8 bytes, then
XChaCha20-Poly1305 of the packet with its tag of 16 bytes; the key expression is authenticated with it. The nonce of
24 bytes is sender u16, boot, number, salt and zeros: the sender comes from the key expression, boots rise with
every start, numbers with every packet, and the salt, drawn at the start, keeps nonces apart even where a drone
lost its start numbers and its clock together. That packets are new and from whom they say is checked inside, by
`transport.security.opening`.
"""

from __future__ import annotations

import struct

from nacl.bindings import (
    crypto_aead_xchacha20poly1305_ietf_ABYTES as TAG_BYTES,
)
from nacl.bindings import (
    crypto_aead_xchacha20poly1305_ietf_decrypt as decrypt,
)
from nacl.bindings import (
    crypto_aead_xchacha20poly1305_ietf_encrypt as encrypt,
)
from nacl.bindings import (
    crypto_aead_xchacha20poly1305_ietf_NPUBBYTES as NONCE_BYTES,
)
from nacl.exceptions import CryptoError

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import check_agent_id, parse_key
from transport.messages.header import MAX_PACKET_BYTES

SALT_BYTES = 8
_HEAD = struct.Struct(f"<2sBxII{SALT_BYTES}s")
_NONCE = struct.Struct(f"<HII{SALT_BYTES}s6x")
_DOMAIN = b"CLe1\0"
MAGIC, VERSION = b"CE", 1
OVERHEAD_BYTES = _HEAD.size + TAG_BYTES
"""What an envelope adds to a packet."""
MAX_NUMBER = 2**32 - 1
assert _NONCE.size == NONCE_BYTES


class Envelopes:
    """Closes one agent's packets and opens everybody's; sans-I/O.

    ``group_keys`` of 32 bytes: the first closes, all open. ``agent_id`` is ``None`` for those who only listen.
    ``boot`` rises with every start, ``salt`` is 8 random bytes of this start.
    """

    def __init__(
        self, group_keys: tuple[bytes, ...], agent_id: int | None, *, boot: int = 0, salt: bytes = b""
    ) -> None:
        if agent_id is not None and len(salt) != SALT_BYTES:
            raise ValueError(f"salt of {len(salt)} bytes, expected {SALT_BYTES}")
        self._keys = group_keys
        self._agent_id = None if agent_id is None else check_agent_id(agent_id)
        self._boot, self._salt = boot, salt
        self._number = 0

    def close(self, key: str, packet: bytes) -> bytes:
        """The envelope of a packet that is put on a key expression of our own; raises `EncodeError`."""
        if self._agent_id is None:
            raise EncodeError("who only listens closes no envelopes")
        if self._number >= MAX_NUMBER:
            raise EncodeError(f"{MAX_NUMBER} envelopes since the start, more would repeat a nonce; restart the agent")
        self._number += 1
        nonce = _NONCE.pack(self._agent_id, self._boot, self._number, self._salt)
        head = _HEAD.pack(MAGIC, VERSION, self._boot, self._number, self._salt)
        return head + encrypt(packet, _associated(key, head), nonce, self._keys[0])

    def open(self, key: str, data: bytes) -> bytes:
        """The packet that came under a key expression; raises `Rejected` for everything else."""
        parsed = parse_key(key)
        if parsed is None:
            raise Rejected(Reason.WRONG_KEY, f"{key!r}")
        if data[:2] != MAGIC:
            raise Rejected(Reason.UNENCRYPTED, f"{len(data)} bytes under {key!r}")
        if len(data) < OVERHEAD_BYTES:
            raise Rejected(Reason.BAD_ENVELOPE, f"{len(data)} bytes, an envelope alone has {OVERHEAD_BYTES}")
        if len(data) > MAX_PACKET_BYTES + OVERHEAD_BYTES:
            raise Rejected(Reason.BAD_ENVELOPE, f"{len(data)} bytes, at most {MAX_PACKET_BYTES + OVERHEAD_BYTES}")
        head, closed = data[: _HEAD.size], data[_HEAD.size :]
        _, version, boot, number, salt = _HEAD.unpack(head)
        if version != VERSION:
            raise Rejected(Reason.BAD_ENVELOPE, f"version {version}, expected {VERSION}")
        nonce = _NONCE.pack(parsed[1], boot, number, salt)
        for group_key in self._keys:
            try:
                return decrypt(closed, _associated(key, head), nonce, group_key)
            except CryptoError:
                continue
        raise Rejected(Reason.WRONG_GROUP_KEY, f"under {key!r}")


def _associated(key: str, head: bytes) -> bytes:
    return b"".join((_DOMAIN, key.encode(), b"\0", head))
