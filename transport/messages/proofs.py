"""Proof of origin: what a relay passes on is provably its owner's, to the last bit.

The owner of records signs, in every packet of its own, the digests of all records of its own that are in it, of
however many ticks. A relay passes that signature on with the records; in place of those of its records that it does
not pass on it puts their digests. So it can leave records out, and nothing else. Proofs stand behind the records of a
body, each, little endian::

    owner u16 | held u8 | absent u8 | places u8 x held | digests 8 bytes x absent | signature 64 bytes

``places`` are those of the covered records among the records of the body. Signed is ``"CLproof1" 0 fleet u32
agreement u32 owner u16`` and the digests in ascending order. A proof holds for records of its own owner alone,
whatever else that signs.

Who proves does not say records back for their owners to know that they have arrived, but acknowledges them by the
beginnings of their digests, behind the proofs: ``0 u16 | 0 u8 | count u8 | beginnings 4 bytes x count``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

from nacl.exceptions import BadSignatureError
from nacl.signing import SigningKey, VerifyKey

from transport.errors import Reason, Rejected
from transport.messages.header import SIGNATURE_BYTES

DIGEST_BYTES = 8
ACK_BYTES = 4
MOST_ACKS = 255
ACKS_AHEAD = 40
"""So many acknowledgements go before records, if there is not room for all of both."""
_HEAD = struct.Struct("<HBB")
_DOMAIN = b"CLproof1\0"
_CONTEXT = struct.Struct("<IIH")
CHECKED_AGAIN = 1024
"""Signatures that are known again: a proof comes from its owner and by several relays."""


@dataclass(frozen=True, slots=True)
class Proof:
    """That its owner measured what has these digests, which are in ascending order."""

    owner: int
    digests: tuple[bytes, ...]
    signature: bytes


Origin = tuple[int, bytes]
"""(owner, digest) of a record."""


class Proven(Protocol):
    """A record as far as proofs go."""

    @property
    def observer(self) -> int:
        """Its owner."""
        ...

    @property
    def digest(self) -> bytes:
        """Eight bytes that stand for the record, its owner and its tick."""
        ...


@dataclass(frozen=True, slots=True)
class Prover:
    """Signs for the records of ``owner``; hashes of fleet and agreement as in the header."""

    owner: int
    fleet: int
    agreement: int
    key: SigningKey

    def prove(self, digests: Iterable[bytes]) -> Proof:
        """The proof of records of its own by their digests."""
        ordered = tuple(sorted(set(digests)))
        signed = signed_bytes(self.owner, ordered, fleet=self.fleet, agreement=self.agreement)
        return Proof(self.owner, ordered, self.key.sign(signed).signature)


def signed_bytes(owner: int, digests: Sequence[bytes], *, fleet: int, agreement: int) -> bytes:
    """What the signature of a proof covers."""
    return b"".join((_DOMAIN, _CONTEXT.pack(fleet, agreement, owner), *digests))


def is_genuine(proof: Proof, keys: tuple[VerifyKey, ...], *, fleet: int, agreement: int) -> bool:
    """Whether one of the owner's keys made the proof, in this fleet and for this agreement."""
    signed = signed_bytes(proof.owner, proof.digests, fleet=fleet, agreement=agreement)
    return _is_signed(keys, signed, proof.signature)


@lru_cache(CHECKED_AGAIN)
def _is_signed(keys: tuple[VerifyKey, ...], message: bytes, signature: bytes) -> bool:
    for key in keys:
        try:
            key.verify(message, signature)
        except BadSignatureError:
            continue
        return True
    return False


def by_origin(proofs: Iterable[Proof]) -> dict[Origin, Proof]:
    """The proof that covers a record, by owner and digest of the record; of several the last."""
    return {(proof.owner, digest): proof for proof in proofs for digest in proof.digests}


def origin(record: Proven) -> Origin:
    """By what `by_origin` finds the proof of a record."""
    return record.observer, record.digest


class ProofBytes:
    """How many bytes the proofs of a growing list of records take; ``owner`` proves its own records itself."""

    def __init__(self, proofs: Iterable[Proof], owner: int) -> None:
        self._proof_of = by_origin(proofs)
        self._owner = owner
        self._seen: set[int] = set()
        self._proves_own = False

    def added_by(self, record: Proven) -> int:
        """What one more record adds, at most one place and a whole proof; less where it stands for a digest."""
        if record.observer == self._owner:
            first, self._proves_own = not self._proves_own, True
            return 1 + (_HEAD.size + SIGNATURE_BYTES if first else 0)
        proof = self._proof_of.get(origin(record))
        if proof is None:
            return 0
        if id(proof) in self._seen:
            return 1 - DIGEST_BYTES
        self._seen.add(id(proof))
        return 1 + _HEAD.size + SIGNATURE_BYTES + DIGEST_BYTES * (len(proof.digests) - 1)


def encode_proofs(records: Sequence[Proven], proofs: Iterable[Proof], prover: Prover) -> bytes:
    """The proofs of a body that holds ``records``: the own one made now, of ``proofs`` those that cover something."""
    proof_of = by_origin(proofs)
    own = [record.digest for record in records if record.observer == prover.owner]
    if own:
        proof_of |= by_origin((prover.prove(own),))
    places: dict[int, list[int]] = {}
    used: dict[int, Proof] = {}
    told: set[bytes] = set()
    for place, record in enumerate(records):
        proof = proof_of.get(origin(record))
        if proof is not None and record.digest not in told:
            told.add(record.digest)
            used[id(proof)] = proof
            places.setdefault(id(proof), []).append(place)
    return b"".join(_encode_proof(proof, places[name], records) for name, proof in used.items())


def _encode_proof(proof: Proof, places: Sequence[int], records: Sequence[Proven]) -> bytes:
    held = {records[place].digest for place in places}
    absent = [digest for digest in proof.digests if digest not in held]
    head = _HEAD.pack(proof.owner, len(places), len(absent))
    return b"".join((head, bytes(places), *absent, proof.signature))


def acknowledged_by(digest: bytes) -> bytes:
    """The bytes that acknowledge the record of a digest."""
    return digest[:ACK_BYTES]


def acks_bytes(acks: int) -> int:
    """What so many acknowledgements take."""
    return _HEAD.size + ACK_BYTES * acks if acks else 0


def encode_acks(acks: Sequence[bytes], room_bytes: int) -> bytes:
    """As many acknowledgements as there is room for."""
    count = min(len(acks), MOST_ACKS, (room_bytes - _HEAD.size) // ACK_BYTES)
    return _HEAD.pack(0, 0, count) + b"".join(acks[:count]) if count > 0 else b""


def decode_proofs(data: bytes, records: Sequence[Proven]) -> tuple[tuple[Proof, ...], tuple[bytes, ...]]:
    """Proofs and acknowledgements behind the records of a body, no signature looked at yet; raises `Rejected`."""
    proofs: list[Proof] = []
    acks: tuple[bytes, ...] = ()
    at, size = 0, len(data)
    while at < size:
        if at + _HEAD.size > size:
            raise Rejected(Reason.MALFORMED, f"proof {len(proofs)} cut off")
        owner, held, absent = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if owner == 0 and held == 0 and at + ACK_BYTES * absent == size:
            acks = tuple(data[start : start + ACK_BYTES] for start in range(at, size, ACK_BYTES))
            break
        end = at + held + DIGEST_BYTES * absent + SIGNATURE_BYTES
        if not held or end > size:
            raise Rejected(Reason.MALFORMED, f"proof {len(proofs)} of {held} records in {size - at} bytes")
        digests = []
        for place in data[at : at + held]:
            if place >= len(records) or records[place].observer != owner:
                raise Rejected(Reason.MALFORMED, f"proof {len(proofs)} of agent {owner} for record {place}")
            digests.append(records[place].digest)
        at += held
        digests += [data[start : start + DIGEST_BYTES] for start in range(at, end - SIGNATURE_BYTES, DIGEST_BYTES)]
        proofs.append(Proof(owner, tuple(sorted(set(digests))), data[end - SIGNATURE_BYTES : end]))
        at = end
    return tuple(proofs), acks


def genuine(
    proofs: Iterable[Proof], trust: Mapping[int, tuple[VerifyKey, ...]], *, fleet: int, agreement: int
) -> tuple[tuple[Proof, ...], int]:
    """The proofs that their owners made, and how many of the others there were."""
    proofs = tuple(proofs)
    good = tuple(
        proof for proof in proofs if is_genuine(proof, trust.get(proof.owner, ()), fleet=fleet, agreement=agreement)
    )
    return good, len(proofs) - len(good)
