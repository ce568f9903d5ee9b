"""What can go wrong in transport, and why a packet is refused.

::

    TransportError
    ├── Rejected        a packet from outside is not accepted; carries a Reason, never stops anything
    ├── EncodeError     a value of our own cannot be sent (NaN, wrong shape): a fault of the caller
    ├── KeyFileError    a key file is missing, malformed or readable by others
    │   └── UnwritableError   a key file, or the number of the last start, cannot be written: a full disk
    ├── SettingsError   a setting is contradictory or unsafe
    └── SessionError    the Zenoh session cannot be opened
"""

from __future__ import annotations

from collections import Counter
from enum import StrEnum


class Reason(StrEnum):
    """Why a packet was not accepted; the value is the name under which it is counted and reported."""

    TOO_SHORT = "too_short"
    TOO_LONG = "too_long"
    BAD_MAGIC = "bad_magic"
    BAD_VERSION = "bad_version"
    UNKNOWN_KIND = "unknown_kind"
    BAD_FLAGS = "bad_flags"
    WRONG_FLEET = "wrong_fleet"
    DISAGREES = "disagrees"
    """Its sender was given something else of what the fleet has to share: another origin, period, estimator, ..."""
    BAD_LENGTH = "bad_length"
    WRONG_KEY = "wrong_key"
    """The key expression it came under does not belong to its sender and stream."""
    UNKNOWN_SENDER = "unknown_sender"
    OWN_ID = "own_id"
    """Somebody else sends under our id: two daemons with one id, or an attack."""
    UNENCRYPTED = "unencrypted"
    BAD_ENVELOPE = "bad_envelope"
    """Neither version nor size of an encrypted packet."""
    WRONG_GROUP_KEY = "wrong_group_key"
    """Encrypted with a key we do not have, for another stream, or changed on the way."""
    UNSIGNED = "unsigned"
    BAD_SIGNATURE = "bad_signature"
    BAD_PROOF = "bad_proof"
    """What its sender relays was not made by whom it names as its owner."""
    DUPLICATE = "duplicate"
    """The same packet again; harmless, networks do that."""
    REPLAY = "replay"
    """Older than the replay window, or of an earlier start of its sender."""
    REPEATED = "repeated"
    """Its sender says of one tick after the other the same, bit by bit."""
    STALE = "stale"
    """Its clock is too far from ours."""
    WRONG_ANSWER = "wrong_answer"
    """A clock's answer to another question than ours."""
    MALFORMED = "malformed"
    UNKNOWN_AGENT = "unknown_agent"
    """The body speaks of an agent that is not in the fleet."""
    WRONG_DIMENSION = "wrong_dimension"
    NOT_FINITE = "not_finite"
    OUT_OF_RANGE = "out_of_range"
    NOT_POSITIVE_DEFINITE = "not_positive_definite"
    PART_MISMATCH = "part_mismatch"
    """A part of a split packet contradicts the parts received before."""
    PART_EXPIRED = "part_expired"
    """Parts of a split packet whose rest never came."""


class TransportError(Exception):
    """Root of everything this room raises on purpose."""


class Rejected(TransportError):
    """A packet that is not accepted.

    Attributes
    ----------
    reason : Reason
        What to count it under.
    detail : str
        What was found and what was expected, for the log.
    """

    def __init__(self, reason: Reason, detail: str = "") -> None:
        super().__init__(f"{reason.value}: {detail}" if detail else reason.value)
        self.reason = reason
        self.detail = detail


class EncodeError(TransportError, ValueError):
    """A value cannot be put on the wire."""


class KeyFileError(TransportError):
    """A key file cannot be used; the message names the file, the fault and the remedy."""


class UnwritableError(KeyFileError):
    """A file in the key or state folder cannot be written: the disk is full, say. Trying again may help."""


class SettingsError(TransportError, ValueError):
    """A transport setting cannot be used; the message names it, its value and what was expected."""


class SessionError(TransportError):
    """The Zenoh session could not be opened or has failed."""


class RejectionCounter:
    """Counts rejections by reason."""

    def __init__(self) -> None:
        self._counts: Counter[Reason] = Counter()

    def count(self, reason: Reason, times: int = 1) -> None:
        """Note ``times`` further packets refused for ``reason``."""
        if times:
            self._counts[reason] += times

    def __getitem__(self, reason: Reason) -> int:
        return self._counts[reason]

    @property
    def total(self) -> int:
        """All packets refused."""
        return self._counts.total()

    def as_dict(self) -> dict[str, int]:
        """Counts by reason name, reasons that occurred only, in a fixed order."""
        return {reason.value: self._counts[reason] for reason in Reason if self._counts[reason]}
