"""Window bodies: round trips, sizes, refusals."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from transport.errors import EncodeError, Reason, Rejected
from transport.link.streams import Stream
from transport.messages.window_body import MAX_STATE, WindowStates, decode_window, encode_window, window_bytes
from transport.security.auth import UNSIGNED
from transport.security.sealing import Sealer

ROSTER = frozenset(range(1, 1000))
TICK = 70_000
GOOD = WindowStates(TICK, 3, TICK - 2, 2, (4, 9), np.arange(36.0).reshape(3, 12))


@st.composite
def windows(draw: st.DrawFn) -> WindowStates:
    agents = draw(st.lists(st.integers(1, 999), min_size=1, max_size=9, unique=True))
    slots = draw(st.integers(1, 9))
    numbers = st.floats(-MAX_STATE, MAX_STATE, width=32)
    path = draw(hnp.arrays(np.float64, (slots, 6 * len(agents)), elements=numbers))
    age = draw(st.integers(slots - 1, 0xFFFF))
    degree = draw(st.integers(0, 0xFFFF))
    return WindowStates(TICK, draw(st.integers(0, 16)), TICK - age, degree, tuple(agents), path)


def decoded(body: bytes, message: WindowStates = GOOD, roster: frozenset[int] = ROSTER) -> WindowStates:
    return decode_window(body, tick=message.tick, round_=message.round, agents=len(message.agents), roster=roster)


@given(windows())
def test_a_window_comes_back(sent: WindowStates) -> None:
    body = encode_window(sent)
    assert len(body) == window_bytes(len(sent.agents), len(sent.path))
    found = decoded(body, sent)
    np.testing.assert_array_equal(found.path, sent.path)
    for name in ("tick", "round", "state_tick", "degree", "agents"):
        assert getattr(found, name) == getattr(sent, name)


def test_it_travels_on_the_stream_of_information() -> None:
    (packet,) = Sealer("f", 1, boot=1, signing=UNSIGNED).seal(GOOD, t_ns=1)
    assert packet.stream is Stream.INFO


@pytest.mark.parametrize(
    "wrong",
    [
        {"agents": ()},
        {"agents": (4, 4)},
        {"agents": (4, 1000)},
        {"agents": (4,)},
        {"path": np.zeros((0, 12))},
        {"path": np.zeros((200, 12))},
        {"path": np.full((3, 12), np.nan)},
        {"path": np.full((3, 12), 1e10)},
        {"state_tick": TICK - 1},
        {"state_tick": TICK + 1},
        {"degree": -1},
    ],
)
def test_what_is_no_window_is_not_sent(wrong: dict[str, Any]) -> None:
    with pytest.raises(EncodeError, match="window"):
        encode_window(replace(GOOD, **wrong))


@pytest.mark.parametrize(
    ("at", "form", "value", "reason"),
    [
        (0, "<H", 1, Reason.OUT_OF_RANGE),
        (4, "<H", 0, Reason.WRONG_DIMENSION),
        (4, "<H", 4, Reason.WRONG_DIMENSION),
        (6, "<H", 1, Reason.OUT_OF_RANGE),
        (8, "<H", 9, Reason.UNKNOWN_AGENT),
        (8, "<H", 1000, Reason.UNKNOWN_AGENT),
        (12, "<f", float("nan"), Reason.NOT_FINITE),
        (12, "<f", 2e9, Reason.OUT_OF_RANGE),
    ],
)
def test_what_is_no_window_is_refused(at: int, form: str, value: float, reason: Reason) -> None:
    body = bytearray(encode_window(GOOD))
    struct.pack_into(form, body, at, value)
    with pytest.raises(Rejected) as refused:
        decoded(bytes(body))
    assert refused.value.reason is reason


@pytest.mark.parametrize("length", [0, 7, 20])
def test_a_body_that_is_cut_is_refused(length: int) -> None:
    with pytest.raises(Rejected) as refused:
        decoded(encode_window(GOOD)[:length])
    assert refused.value.reason is Reason.WRONG_DIMENSION
