"""Information bodies: one consensus round's information pair, split over datagrams where it is too large.

The content is ``ids u16[n] | vector[6n] | upper triangle[6n(6n+1)/2]`` (row-major), numbers float32 or
float64. Each datagram carries ``index u16 | count u16 | rank u16 | state age u16`` and its share of the
content; the shares follow from n and the number format alone, so no part can claim another size.

One datagram holds three agents in float32; four and five need two, six need three.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

PART_PREFIX = struct.Struct("<HHHH")
PART_BYTES = MAX_DATAGRAM_BODY_BYTES - PART_PREFIX.size
STATES_PER_AGENT = 6
MAX_MAGNITUDE = 1e18
"""Largest entry of an information pair: beyond it, arithmetic with the pair loses all meaning."""
MAX_CONDITION_FOR_FLOAT32 = 1e6
"""A float32 pair moves the mean by about 6e-8 times the condition number, relatively."""
CONTENTS_KNOWN_AGAIN = 32
"""How many contents that were checked are known again: in virtual time those who hear a pair are in one process."""


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What one agent says in one consensus round.

    Attributes
    ----------
    tick, round : int
        The round it is meant for (header).
    state_tick : int
        Tick of the state that the pair speaks of, at most ``tick`` (start of the sender's window).
    rank : int
        Rank of the sender's regional observability matrix.
    agents : tuple of int
        Agent ids in the order of their blocks of six.
    information : Matrix ``(6n, 6n)``
        Symmetric positive definite.
    vector : Vector ``(6n,)``
        ``information @ mean``.
    """

    tick: int
    round: int
    state_tick: int
    rank: int
    agents: tuple[int, ...]
    information: Matrix
    vector: Vector


@dataclass(frozen=True, slots=True)
class InformationPart:
    """One datagram's share of an information pair, its place checked but its numbers not yet looked at."""

    index: int
    count: int
    rank: int
    state_tick: int
    agents: int
    double: bool
    share: bytes


def content_bytes(agents: int, *, double: bool) -> int:
    """Length of the content for a number of agents."""
    dimension = STATES_PER_AGENT * agents
    return 2 * agents + (8 if double else 4) * (dimension + dimension * (dimension + 1) // 2)


def part_count(agents: int, *, double: bool) -> int:
    """Datagrams that one pair takes."""
    return -(-content_bytes(agents, double=double) // PART_BYTES)


def float32_suffices(information: Matrix) -> bool:
    """Whether a pair ``(6n, 6n)`` may travel in float32: well conditioned and still definite when rounded.

    The condition number is that of the matrix scaled to a unit diagonal, since rounding is relative to each
    entry; the units of the states then do not matter.
    """
    scale = np.sqrt(np.diag(information))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return False
    with np.errstate(over="ignore"):
        rounded = information.astype(np.float32).astype(np.float64)
    if not np.isfinite(rounded).all():
        return False
    eigenvalues = np.linalg.eigvalsh(rounded / np.outer(scale, scale))
    return bool(eigenvalues[0] > 0 and eigenvalues[-1] < MAX_CONDITION_FOR_FLOAT32 * eigenvalues[0])


def encode_information(message: Information, *, double: bool) -> list[bytes]:
    """Bodies of the datagrams that carry a pair; raises `EncodeError` for anything but a sound pair."""
    agents, dimension = len(message.agents), STATES_PER_AGENT * len(message.agents)
    age = message.tick - message.state_tick
    _check_sendable(message, dimension, age)
    number = np.dtype("<f8" if double else "<f4")
    numbers = np.concatenate((message.vector, message.information[_triangle(dimension)])).astype(number)
    content = np.asarray(message.agents, "<u2").tobytes() + numbers.tobytes()
    count = part_count(agents, double=double)
    return [
        PART_PREFIX.pack(index, count, message.rank, age)
        + content[index * PART_BYTES : (index + 1) * PART_BYTES]
        for index in range(count)
    ]


def decode_part(body: bytes, *, tick: int, agents: int, double: bool, fleet_size: int) -> InformationPart:
    """The place of a datagram's share; raises `Rejected` unless the length is exactly what n demands."""
    if not 1 <= agents <= fleet_size:
        raise Rejected(Reason.WRONG_DIMENSION, f"pair of {agents} agents, fleet has {fleet_size}")
    if len(body) < PART_PREFIX.size:
        raise Rejected(Reason.MALFORMED, f"information part of {len(body)} bytes")
    index, count, rank, age = PART_PREFIX.unpack_from(body)
    expected_count = part_count(agents, double=double)
    if count != expected_count or index >= count:
        raise Rejected(Reason.WRONG_DIMENSION, f"part {index} of {count}, expected {expected_count}")
    share = body[PART_PREFIX.size :]
    expected = min(PART_BYTES, content_bytes(agents, double=double) - index * PART_BYTES)
    if len(share) != expected:
        raise Rejected(Reason.WRONG_DIMENSION, f"share of {len(share)} bytes, expected {expected}")
    if age > tick or rank > STATES_PER_AGENT * agents:
        raise Rejected(Reason.OUT_OF_RANGE, f"state {age} ticks before tick {tick}, rank {rank}")
    return InformationPart(index, count, rank, tick - age, agents, double, share)


def decode_content(
    content: bytes, part: InformationPart, *, tick: int, round_: int, roster: Collection[int]
) -> Information:
    """The pair from its joined shares; raises `Rejected` unless finite, definite and of known agents.

    ``part`` is any of the parts; they agree on everything but index and share.
    """
    ids, numbers = _checked(content, part.agents, part.double)
    if not all(agent_id in roster for agent_id in ids):
        raise Rejected(Reason.UNKNOWN_AGENT, f"pair of agents {ids}")
    dimension = STATES_PER_AGENT * part.agents
    information, vector = numbers[_places(dimension)], numbers[:dimension].copy()
    return Information(tick, round_, part.state_tick, part.rank, ids, information, vector)


@lru_cache(CONTENTS_KNOWN_AGAIN)
def _checked(content: bytes, agents: int, double: bool) -> tuple[tuple[int, ...], Vector]:
    """Ids and numbers of a content, whose matrix is definite; the numbers are shared, and to be copied."""
    dimension = STATES_PER_AGENT * agents
    ids = tuple(np.frombuffer(content, "<u2", agents).tolist())
    if len(set(ids)) != agents:
        raise Rejected(Reason.UNKNOWN_AGENT, f"pair of agents {ids}")
    number = np.dtype("<f8" if double else "<f4")
    with np.errstate(invalid="ignore"):  # a signalling NaN may not warn before it is refused
        numbers = np.frombuffer(content, number, offset=2 * agents).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise Rejected(Reason.NOT_FINITE, "information pair")
    if (np.abs(numbers) > MAX_MAGNITUDE).any():
        raise Rejected(Reason.OUT_OF_RANGE, f"information pair beyond {MAX_MAGNITUDE:g}")
    if not _is_definite(numbers[_places(dimension)]):
        raise Rejected(Reason.NOT_POSITIVE_DEFINITE, "information matrix")
    return ids, numbers


@lru_cache(maxsize=8)
def _triangle(dimension: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.triu_indices(dimension)


@lru_cache(maxsize=8)
def _places(dimension: int) -> NDArray[np.intp]:
    """Where each entry of the symmetric matrix stands among a content's numbers, behind the vector."""
    places = np.zeros((dimension, dimension), np.intp)
    places[_triangle(dimension)] = np.arange(dimension, dimension + dimension * (dimension + 1) // 2)
    return np.maximum(places, places.T)


def _is_definite(matrix: Matrix) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _check_sendable(message: Information, dimension: int, age: int) -> None:
    m = message
    if not m.agents or len(set(m.agents)) != len(m.agents):
        raise EncodeError(f"information: agents {m.agents}, expected distinct ids")
    if not all(MIN_AGENT_ID <= agent_id <= MAX_AGENT_ID for agent_id in m.agents):
        raise EncodeError(f"information: agents {m.agents}, expected ids up to {MAX_AGENT_ID}")
    if m.information.shape != (dimension, dimension) or m.vector.shape != (dimension,):
        raise EncodeError(
            f"information: shapes {m.information.shape} and {m.vector.shape}, expected 6n = {dimension}"
        )
    if not (0 <= age <= 0xFFFF and 0 <= m.rank <= dimension):
        raise EncodeError(f"information: state tick {m.state_tick} at tick {m.tick}, rank {m.rank}")
    largest = max(float(np.abs(m.information).max()), float(np.abs(m.vector).max()))
    if not largest <= MAX_MAGNITUDE:  # also refuses NaN
        raise EncodeError(f"information: entries must be finite and at most {MAX_MAGNITUDE:g}")
    if not _is_definite(m.information):
        raise EncodeError("information: the matrix is not positive definite")
