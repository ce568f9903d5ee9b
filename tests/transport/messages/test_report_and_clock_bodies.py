"""Diagnostics and clock answers."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.clock_body import (
    ClockAnswer,
    decode_clock_answer,
    decode_clock_question,
    encode_clock_answer,
    encode_clock_question,
)
from transport.messages.report_body import (
    Diagnostics,
    decode_diagnostics,
    encode_diagnostics,
)

names = st.text(max_size=16)
times = st.integers(0, 2**62)


@settings(max_examples=50)
@given(
    st.dictionaries(names, st.integers(-(2**53), 2**53), max_size=5),
    st.dictionaries(names, st.floats(-1e9, 1e9), max_size=5),
    st.lists(names, max_size=4),
)
def test_diagnostics_come_back(counters: dict[str, int], gauges: dict[str, float], why: list[str]) -> None:
    sent = Diagnostics(4, "DEGRADED", tuple(why), counters, gauges, {"2": gauges})
    assert decode_diagnostics(encode_diagnostics(sent)) == sent


def test_diagnostics_are_json_that_people_can_read() -> None:
    body = encode_diagnostics(Diagnostics(4, "NOMINAL", counters={"received": 3}))
    assert json.loads(body) == {"agent_id": 4, "state": "NOMINAL", "counters": {"received": 3}}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_not_reported(value: float) -> None:
    with pytest.raises(EncodeError, match="finite"):
        encode_diagnostics(Diagnostics(4, "NOMINAL", gauges={"age_s": value}))
    with pytest.raises(EncodeError, match="finite"):
        encode_diagnostics(Diagnostics(4, "NOMINAL", neighbours={"2": {"age_s": value}}))


def test_oversized_reports_are_not_sent() -> None:
    with pytest.raises(EncodeError, match=r"Diagnostics: Expected `str` of length <= 64"):
        encode_diagnostics(Diagnostics(4, "x" * 65))
    with pytest.raises(EncodeError, match="counters"):
        encode_diagnostics(Diagnostics(4, "NOMINAL", counters={str(i): i for i in range(257)}))


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[" * 100_000,
        b'{"agent_id": 1, "state": "A", "deep": ' + b"[" * 10_000,
        b'{"agent_id": 1}',
        b'{"agent_id": 1, "state": "\xff"}',
        b'{"agent_id": 1, "state": "A", "gauges": {"a": 1e999}}',
        b'{"agent_id": 1, "state": "A", "gauges": {"a": NaN}}',
    ],
)
def test_bad_diagnostics_are_refused(body: bytes) -> None:
    with pytest.raises(Rejected) as refused:
        decode_diagnostics(body)
    assert refused.value.reason is Reason.MALFORMED


@given(times, times, st.integers(0, 2**61))
def test_clock_packets_come_back(asked_ns: int, received_ns: int, away_ns: int) -> None:
    assert decode_clock_question(encode_clock_question(asked_ns)) == asked_ns
    answer = ClockAnswer(asked_ns, received_ns, received_ns + away_ns)
    assert decode_clock_answer(encode_clock_answer(answer)) == answer


def test_bad_clock_packets_are_refused() -> None:
    for reason, call in (
        (Reason.BAD_LENGTH, lambda: decode_clock_question(b"1234567")),
        (Reason.BAD_LENGTH, lambda: decode_clock_answer(b"")),
        (Reason.OUT_OF_RANGE, lambda: decode_clock_answer(encode_clock_answer(ClockAnswer(1, 3, 2)))),
    ):
        with pytest.raises(Rejected) as refused:
            call()
        assert refused.value.reason is reason
