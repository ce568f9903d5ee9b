"""Far-field bodies: round trips, honest sigmas, sizes, refusals."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.far_body import (
    MAX_AGE_TICKS,
    MAX_REPORTS,
    REPORT_BYTES,
    FarReport,
    FarReports,
    decode_far_reports,
    encode_far_reports,
)
from transport.messages.header import HEADER_BYTES, MAX_DATAGRAM_BODY_BYTES, MAX_DATAGRAM_BYTES
from transport.messages.measurement_body import MAX_POSITION_M
from transport.security.auth import UNSIGNED
from transport.security.sealing import Sealer

ROSTER = frozenset(range(1, 1000))
TICK = 70_000
GOOD = FarReport(7, TICK - 3, 0, (1.0, -2.0, -30.0), (0.5, 0.0, -0.25), (0.1, 0.2, 0.3), (0.01, 0.02, 0.03))


def triples(strategy: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(strategy, strategy, strategy)


def reports(agent: int) -> st.SearchStrategy[FarReport]:
    sigmas = triples(st.floats(1e-6, 65504.0))
    return st.builds(
        FarReport,
        agent=st.just(agent),
        tick=st.integers(TICK - MAX_AGE_TICKS, TICK),
        status=st.integers(0, 4),
        position_m=triples(st.floats(-MAX_POSITION_M, MAX_POSITION_M)),
        velocity_mps=triples(st.floats(-1e4, 1e4)),
        position_sigma_m=sigmas,
        velocity_sigma_mps=sigmas,
    )


MESSAGES = (
    st.lists(st.integers(1, 999), min_size=1, max_size=MAX_REPORTS, unique=True)
    .flatmap(lambda agents: st.tuples(*map(reports, agents)))
    .map(lambda found: FarReports(TICK, found))
)


@given(MESSAGES)
def test_reports_come_back_and_claim_no_more(sent: FarReports) -> None:
    body = encode_far_reports(sent)
    got = decode_far_reports(body, tick=TICK, count=len(sent.reports), roster=ROSTER)
    for before, after in zip(sent.reports, got.reports, strict=True):
        assert (after.agent, after.tick, after.status) == (before.agent, before.tick, before.status)
        assert after.position_m == pytest.approx(before.position_m, rel=1e-7, abs=1e-30)
        assert after.velocity_mps == pytest.approx(before.velocity_mps, rel=2**-11, abs=2**-25)
        for name in ("position_sigma_m", "velocity_sigma_mps"):
            for told, known in zip(getattr(after, name), getattr(before, name), strict=True):
                assert known <= told <= known * (1 + 2**-10) + 2**-24
    # what was rounded once is not rounded again
    assert encode_far_reports(got) == body


def test_a_report_has_at_most_forty_bytes_and_a_full_packet_fits_a_datagram() -> None:
    assert REPORT_BYTES <= 40
    full = FarReports(TICK, tuple(replace(GOOD, agent=agent) for agent in range(1, MAX_REPORTS + 1)))
    (packet,) = Sealer("test", 7, boot=1, signing=UNSIGNED).seal(full, t_ns=1)
    assert len(packet.data) == HEADER_BYTES + MAX_REPORTS * REPORT_BYTES
    assert len(packet.data) + 64 <= MAX_DATAGRAM_BYTES  # signed
    assert (MAX_REPORTS + 1) * REPORT_BYTES > MAX_DATAGRAM_BODY_BYTES


@pytest.mark.parametrize(
    "wrong",
    [
        {"agent": 0},
        {"agent": 1000},
        {"tick": TICK + 1},
        {"tick": TICK - MAX_AGE_TICKS - 1},
        {"status": 5},
        {"position_m": (math.nan, 0.0, 0.0)},
        {"position_m": (0.0, 2 * MAX_POSITION_M, 0.0)},
        {"velocity_mps": (0.0, 0.0, math.inf)},
        {"position_sigma_m": (0.0, 1.0, 1.0)},
        {"velocity_sigma_mps": (1.0, math.nan, 1.0)},
        {"velocity_sigma_mps": (1.0, 7e4, 1.0)},
    ],
)
def test_what_is_no_report_is_not_sent(wrong: dict[str, Any]) -> None:
    with pytest.raises(EncodeError):
        encode_far_reports(FarReports(TICK, (replace(GOOD, **wrong),)))


def test_a_packet_speaks_of_each_drone_once_and_not_of_nobody() -> None:
    with pytest.raises(EncodeError):
        encode_far_reports(FarReports(TICK, (GOOD, GOOD)))
    with pytest.raises(EncodeError):
        encode_far_reports(FarReports(TICK, ()))


def refusal(body: bytes, tick: int = TICK, count: int = 1, roster: frozenset[int] = ROSTER) -> Reason:
    with pytest.raises(Rejected) as refused:
        decode_far_reports(body, tick=tick, count=count, roster=roster)
    return refused.value.reason


def test_unsound_bodies_are_refused_by_reason() -> None:
    body = encode_far_reports(FarReports(TICK, (GOOD,)))
    assert refusal(body[:-1]) is Reason.WRONG_DIMENSION
    assert refusal(body, count=2) is Reason.WRONG_DIMENSION
    assert refusal(b"", count=0) is Reason.WRONG_DIMENSION
    assert refusal(body + body, count=2) is Reason.UNKNOWN_AGENT
    assert refusal(body, roster=frozenset((1, 2))) is Reason.UNKNOWN_AGENT
    assert refusal(body, tick=2) is Reason.OUT_OF_RANGE  # older than the fleet
    at = struct.calcsize("<HHB")
    nan, huge, none = struct.pack("<f", math.nan), struct.pack("<f", 1e9), struct.pack("<e", 0.0)
    assert refusal(body[:at] + nan + body[at + 4 :]) is Reason.NOT_FINITE
    assert refusal(body[:at] + huge + body[at + 4 :]) is Reason.OUT_OF_RANGE
    assert refusal(body[:-2] + none) is Reason.OUT_OF_RANGE
    assert refusal(body[: at - 1] + b"\x05" + body[at:]) is Reason.OUT_OF_RANGE
