"""Sealed UWB frames: how an agent on links without TLS knows that ranges come from its own drone's driver.

Layout: magic ``UWBs``, tag of 16 bytes, the frame (`transport.uwb_body`). The tag is keyed BLAKE2b over ``"CLuwb1" 0
host_start 0 key 0 frame``, with a key that both make of the drone's signing key, which nobody else has. So frames of
an earlier start of the computer are refused; within their age, frames taken down on the way are told from new ones
by their numbers (`transport.messages.uwb_body.UwbIntake`).
"""

from __future__ import annotations

import hashlib
import hmac

from nacl.signing import SigningKey

from transport.errors import Reason, Rejected

MAGIC = b"UWBs"
TAG_BYTES = 16
OVERHEAD_BYTES = len(MAGIC) + TAG_BYTES
"""What sealing adds to a frame."""
_DOMAIN = b"CLuwb1\0"
_PERSON = b"fleetloc-uwb-1"


def uwb_key(secret: SigningKey) -> bytes:
    """The 32-byte key that goes with an agent's signing key."""
    return hashlib.blake2b(secret.encode(), digest_size=32, person=_PERSON).digest()


class UwbSeal:
    """Closes and opens the UWB frames of one drone; ``secret`` is its signing key. Sans-I/O.

    ``host_start`` tells one start of the companion computer, on which driver and daemon run, from another: its
    monotonic clock, which most frames are stamped with, begins anew, and old frames would be young again.
    """

    def __init__(self, secret: SigningKey, host_start: bytes = b"") -> None:
        self._key, self._host_start = uwb_key(secret), host_start

    def close(self, key: str, frame: bytes) -> bytes:
        """The sealed frame for a key expression."""
        return MAGIC + self._tag(key, frame) + frame

    def open(self, key: str, data: bytes) -> bytes:
        """The frame in what came under a key expression; raises `Rejected` unless our driver sealed it."""
        if data[: len(MAGIC)] != MAGIC:
            raise Rejected(Reason.UNSIGNED, f"uwb frame of {len(data)} bytes without a seal")
        frame = data[OVERHEAD_BYTES:]
        if not hmac.compare_digest(data[len(MAGIC) : OVERHEAD_BYTES], self._tag(key, frame)):
            raise Rejected(Reason.BAD_SIGNATURE, f"uwb frame of {len(data)} bytes, sealed with another key")
        return frame

    def _tag(self, key: str, frame: bytes) -> bytes:
        covered = b"".join((_DOMAIN, self._host_start, b"\0", key.encode(), b"\0", frame))
        return hashlib.blake2b(covered, key=self._key, digest_size=TAG_BYTES).digest()
