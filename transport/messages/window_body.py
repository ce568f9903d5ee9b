"""Window bodies: the states of a whole window, of estimators that agree on states instead of on information pairs.

Wire form, little endian::

    state age u16 | degree u16 | slots u16 | reserved u16 | ids u16[n] | states f32[slots][6n]

The slots are those of successive ticks, the oldest first; the state age is the packet's tick minus the oldest's.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import MAX_AGENT_ID, MIN_AGENT_ID
from transport.messages.header import MAX_BODY_BYTES, PacketKind
from transport.messages.information_body import STATES_PER_AGENT

_PREFIX = struct.Struct("<HHHH")
MAX_STATE = 1e9
"""Largest number of a state, m or m/s."""
_LARGEST_FIELD = 0xFFFF


@dataclass(frozen=True, slots=True, eq=False)
class WindowStates:
    """What one agent says in one consensus round on states.

    Attributes
    ----------
    tick, round : int
        The round it is meant for (header).
    state_tick : int
        Tick of the oldest states.
    degree : int
        Neighbours that the sender heard in the round before.
    agents : tuple of int
        Ids of the bodies in the order of their blocks of six.
    path : array ``(S, 6n)``
        NED m and m/s, the oldest first.
    """

    tick: int
    round: int
    state_tick: int
    degree: int
    agents: tuple[int, ...]
    path: NDArray[np.float64]


def window_bytes(agents: int, slots: int) -> int:
    """Length of the body."""
    return _PREFIX.size + 2 * agents + 4 * slots * STATES_PER_AGENT * agents


def encode_window(message: WindowStates) -> bytes:
    """Body of a window; raises `EncodeError` for anything but finite states of distinct bodies that fit a packet."""
    ids, path, age = message.agents, message.path, message.tick - message.state_tick
    if not ids or len(set(ids)) != len(ids) or not all(MIN_AGENT_ID <= each <= MAX_AGENT_ID for each in ids):
        raise EncodeError(f"window: bodies {ids}, expected distinct ids up to {MAX_AGENT_ID}")
    if path.ndim != 2 or not len(path) or path.shape[1] != STATES_PER_AGENT * len(ids):
        raise EncodeError(f"window: states of shape {path.shape} for {len(ids)} bodies")
    if window_bytes(len(ids), len(path)) > MAX_BODY_BYTES[PacketKind.WINDOW]:
        raise EncodeError(f"window: {len(path)} slots of {len(ids)} bodies do not fit a packet")
    if not (len(path) - 1 <= age <= _LARGEST_FIELD and 0 <= message.degree <= _LARGEST_FIELD):
        raise EncodeError(f"window: {len(path)} slots from {age} ticks ago, degree {message.degree}")
    if not (np.abs(path) <= MAX_STATE).all():  # also refuses NaN
        raise EncodeError(f"window: states must be finite and at most {MAX_STATE:g}")
    head = _PREFIX.pack(age, message.degree, len(path), 0)
    return head + np.asarray(ids, "<u2").tobytes() + path.astype("<f4").tobytes()


def decode_window(body: bytes, *, tick: int, round_: int, agents: int, roster: Collection[int]) -> WindowStates:
    """The states of a body; the header says tick, round and number of bodies. Raises `Rejected` unless sound."""
    if not 1 <= agents <= len(roster) or len(body) < _PREFIX.size:
        raise Rejected(Reason.WRONG_DIMENSION, f"window of {agents} bodies in {len(body)} bytes")
    age, degree, slots, reserved = _PREFIX.unpack_from(body)
    if not slots or len(body) != window_bytes(agents, slots):
        raise Rejected(Reason.WRONG_DIMENSION, f"{len(body)} bytes for {slots} slots of {agents} bodies")
    if reserved or not slots - 1 <= age <= tick:
        raise Rejected(Reason.OUT_OF_RANGE, f"window of {slots} slots from {age} ticks before tick {tick}")
    ids = tuple(np.frombuffer(body, "<u2", agents, _PREFIX.size).tolist())
    if len(set(ids)) != agents or not all(each in roster for each in ids):
        raise Rejected(Reason.UNKNOWN_AGENT, f"window of bodies {ids}")
    with np.errstate(invalid="ignore"):  # a signalling NaN may not warn before it is refused
        path = np.frombuffer(body, "<f4", offset=_PREFIX.size + 2 * agents).astype(np.float64)
    if not np.isfinite(path).all():
        raise Rejected(Reason.NOT_FINITE, "window")
    if (np.abs(path) > 1.001 * MAX_STATE).any():
        raise Rejected(Reason.OUT_OF_RANGE, f"window with states beyond {MAX_STATE:g}")
    return WindowStates(tick, round_, tick - age, degree, ids, path.reshape(slots, -1))
