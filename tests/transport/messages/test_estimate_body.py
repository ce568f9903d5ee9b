"""Estimate bodies: round trips, honest variances, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.estimate_body import FleetEstimate, decode_estimate, encode_estimate, estimate_bytes
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES


def estimate(agents: tuple[int, ...], seed: int = 0) -> FleetEstimate:
    rng = np.random.default_rng(seed)
    n = len(agents)
    root = rng.standard_normal((6, 6))
    return FleetEstimate(
        tick=7,
        status=2,
        agents=agents,
        mean=rng.uniform(-1e3, 1e3, 6 * n),
        variance=rng.uniform(0, 10, 6 * n),
        age_ticks=tuple(int(age) for age in rng.integers(0, 70_000, n)),
        own_covariance=root @ root.T,
    )


GOOD = estimate((1, 2, 3))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 999), min_size=1, max_size=12, unique=True), st.integers(0, 999), st.booleans()
)
def test_an_estimate_comes_back_and_claims_no_more(agents: list[int], seed: int, double: bool) -> None:
    sent = estimate(tuple(agents), seed)
    body = encode_estimate(sent, double=double)
    assert len(body) == estimate_bytes(len(agents), double=double)
    came = decode_estimate(body, tick=7, agents=len(agents), double=double, roster=range(1, 1000))
    assert (came.tick, came.status, came.agents) == (7, 2, sent.agents)
    assert came.age_ticks == tuple(min(age, 65535) for age in sent.age_ticks)
    np.testing.assert_allclose(came.mean, sent.mean, rtol=0 if double else 1e-7)
    np.testing.assert_allclose(came.variance, sent.variance, rtol=3e-7)
    assert (came.variance >= sent.variance).all()
    np.testing.assert_allclose(came.own_covariance, sent.own_covariance, rtol=1e-7)
    assert (came.own_covariance == came.own_covariance.T).all()


def test_nineteen_agents_fit_a_datagram() -> None:
    assert estimate_bytes(19, double=False) <= MAX_DATAGRAM_BODY_BYTES < estimate_bytes(20, double=False)


@pytest.mark.parametrize(
    "bad",
    [
        replace(GOOD, mean=GOOD.mean * np.nan),
        replace(GOOD, mean=GOOD.mean * 1e12),
        replace(GOOD, variance=-GOOD.variance),
        replace(GOOD, variance=GOOD.variance * np.nan),
        replace(GOOD, own_covariance=GOOD.own_covariance * np.nan),
        replace(GOOD, own_covariance=-GOOD.own_covariance),
        replace(GOOD, mean=GOOD.mean[:-1]),
        replace(GOOD, age_ticks=(1, 2)),
        replace(GOOD, age_ticks=(1, 2, -1)),
        replace(GOOD, agents=(1, 2, 2)),
        replace(GOOD, agents=(0, 1, 2)),
        replace(GOOD, status=5),
    ],
)
def test_no_bad_estimate_is_sent(bad: FleetEstimate) -> None:
    with pytest.raises(EncodeError, match="estimate"):
        encode_estimate(bad)


def patched(at: int, value: bytes) -> bytes:
    body = encode_estimate(GOOD)
    return body[:at] + value + body[at + len(value) :]


MEAN_AT, VARIANCE_AT, OWN_AT = 4 + 12, 4 + 12 + 72, 4 + 12 + 144


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (encode_estimate(GOOD)[:-1], Reason.WRONG_DIMENSION),
        (encode_estimate(GOOD) + b"\0", Reason.WRONG_DIMENSION),
        (b"", Reason.WRONG_DIMENSION),
        (patched(0, b"\x05"), Reason.OUT_OF_RANGE),
        (patched(1, b"\x01"), Reason.OUT_OF_RANGE),
        (patched(4, b"\x09\x00"), Reason.UNKNOWN_AGENT),
        (patched(4, b"\x02\x00"), Reason.UNKNOWN_AGENT),
        (patched(MEAN_AT, np.float32(np.nan).tobytes()), Reason.NOT_FINITE),
        (patched(MEAN_AT, b"\x01\x00\x80\x7f"), Reason.NOT_FINITE),  # signalling NaN
        (patched(MEAN_AT, np.float32(1e20).tobytes()), Reason.OUT_OF_RANGE),
        (patched(VARIANCE_AT, np.float32(np.inf).tobytes()), Reason.NOT_FINITE),
        (patched(VARIANCE_AT, np.float32(-1).tobytes()), Reason.OUT_OF_RANGE),
        (patched(VARIANCE_AT, np.float32(1e30).tobytes()), Reason.OUT_OF_RANGE),
        (patched(OWN_AT, np.float32(-1).tobytes()), Reason.NOT_POSITIVE_DEFINITE),
    ],
)
def test_bad_bodies_are_refused_with_their_reason(body: bytes, reason: Reason) -> None:
    with pytest.raises(Rejected) as refused:
        decode_estimate(body, tick=7, agents=3, double=False, roster={1, 2, 3})
    assert refused.value.reason is reason


@pytest.mark.parametrize("agents", [0, 2, 4, 65535])
def test_a_wrong_number_of_agents_is_refused(agents: int) -> None:
    with pytest.raises(Rejected) as refused:
        decode_estimate(encode_estimate(GOOD), tick=7, agents=agents, double=False, roster={1, 2, 3})
    assert refused.value.reason is Reason.WRONG_DIMENSION
