"""The uwb-range/1 contract: both forms, what is refused as a whole, what is left out of a frame."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.uwb_body import (
    UwbFrame,
    UwbIntake,
    UwbRange,
    decode_uwb,
    encode_uwb_binary,
    encode_uwb_json,
)

share = st.floats(0, 1)
some_range = st.builds(
    UwbRange,
    other=st.integers(1, 65535).filter(lambda other: other != 3),
    range_m=st.floats(0.01, 2000),
    sigma_m=st.one_of(st.none(), st.floats(0.001, 60)),
    nlos=st.one_of(st.none(), share),
    rx_dbm=st.one_of(st.none(), st.integers(-120, 0).map(float)),
    first_path_dbm=st.one_of(st.none(), st.integers(-120, 0).map(float)),
    quality=st.one_of(st.none(), share),
    offset_s=st.floats(-1, 1),
    tag=st.integers(0, 15),
    other_tag=st.integers(0, 15),
)
frames = st.builds(
    UwbFrame,
    seq=st.integers(0, 2**32 - 1),
    clock=st.sampled_from(["mono", "unix", "none"]),
    t_ns=st.integers(0, 2**63 - 1),
    ranges=st.lists(some_range, max_size=64).map(tuple),
    observer=st.just(3),
)

EXAMPLE: dict[str, Any] = {
    "v": 1, "obs": 3, "seq": 123, "clk": "mono", "t": 81794643123,
    "m": [{"id": 1, "r": 12.345, "s": 0.10, "q": 0.93, "rx": -78.0, "fp": -80.5, "nlos": 0.12, "dt": -0.004}],
}  # fmt: skip


@settings(max_examples=60)
@given(frames)
def test_json_comes_back_exactly(frame: UwbFrame) -> None:
    assert decode_uwb(encode_uwb_json(frame)) == frame


@settings(max_examples=60)
@given(frames)
def test_the_binary_form_keeps_what_it_has_room_for(frame: UwbFrame) -> None:
    sent = replace(frame, clock="unix", ranges=tuple(replace(r, offset_s=0.0) for r in frame.ranges))
    came = decode_uwb(encode_uwb_binary(sent))
    assert (came.seq, came.clock, came.t_ns, came.skipped) == (sent.seq, "unix", sent.t_ns, 0)
    for a, b in zip(sent.ranges, came.ranges, strict=True):
        assert (b.other, b.rx_dbm, b.first_path_dbm) == (a.other, a.rx_dbm, a.first_path_dbm)
        assert (b.tag, b.other_tag) == (a.tag, a.other_tag)
        assert b.range_m == pytest.approx(a.range_m, rel=1e-7)
        assert b.nlos == pytest.approx(a.nlos or 0.0, abs=1 / 509)
        assert (b.sigma_m is None) == (a.sigma_m is None)
        if a.sigma_m is not None:
            assert b.sigma_m is not None
            assert a.sigma_m - 1e-9 <= b.sigma_m <= a.sigma_m + 0.001


def test_the_example_of_the_contract() -> None:
    frame = decode_uwb(json.dumps(EXAMPLE).encode())
    expected = UwbRange(1, 12.345, 0.10, 0.12, -78.0, -80.5, 0.93, -0.004)
    assert frame == UwbFrame(123, "mono", 81794643123, (expected,), observer=3)


def test_unusable_measurements_are_left_out_and_counted() -> None:
    good = EXAMPLE["m"][0]
    bad = [{**good, **change} for change in (
        {"r": 0.0}, {"r": -1.0}, {"r": 2000.1}, {"r": None}, {"st": "timeout"}, {"s": 0.0}, {"id": 0},
        {"id": 3}, {"nlos": 1.5}, {"dt": 2.0}, {"rx": 1000.0},
    )]  # fmt: skip
    frame = decode_uwb(json.dumps({**EXAMPLE, "m": [*bad, good]}).encode())
    assert (len(frame.ranges), frame.skipped) == (1, len(bad))


def test_a_nan_range_is_left_out() -> None:
    payload = struct.pack("<4sBBHIQ", b"UWB1", 0, 2, 0, 1, 5)
    payload += struct.pack("<HfHbbBx", 1, float("nan"), 100, -78, -80, 0)
    payload += struct.pack("<HfHbbBx", 2, 5.0, 0, 127, 127, 255)
    frame = decode_uwb(payload)
    assert frame.ranges == (UwbRange(2, 5.0, None, 1.0, None, None),)
    assert frame.skipped == 1


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", Reason.MALFORMED),
        (b"\xff\xfe\x00", Reason.MALFORMED),
        (b"{" * 10_000, Reason.MALFORMED),
        (json.dumps(EXAMPLE)[:-1].encode() + b', "deep": ' + b"[" * 10_000, Reason.MALFORMED),
        (b" " * 20_000, Reason.TOO_LONG),
        (json.dumps({**EXAMPLE, "v": 2}).encode(), Reason.BAD_VERSION),
        (json.dumps({**EXAMPLE, "obs": "d3"}).encode(), Reason.MALFORMED),
        (json.dumps({**EXAMPLE, "obs": 0}).encode(), Reason.OUT_OF_RANGE),
        (json.dumps({**EXAMPLE, "t": -1}).encode(), Reason.OUT_OF_RANGE),
        (json.dumps({**EXAMPLE, "clk": "gps"}).encode(), Reason.MALFORMED),
        (json.dumps({**EXAMPLE, "m": EXAMPLE["m"] * 65}).encode(), Reason.TOO_LONG),
        (b"UWB1", Reason.TOO_SHORT),
        (struct.pack("<4sBBHIQ", b"UWB1", 0, 65, 0, 1, 5), Reason.TOO_LONG),
        (struct.pack("<4sBBHIQ", b"UWB1", 0, 1, 0, 1, 5), Reason.BAD_LENGTH),
        (struct.pack("<4sBBHIQ", b"UWB1", 2, 0, 0, 1, 5), Reason.BAD_FLAGS),
        (struct.pack("<4sBBHIQ", b"UWB1", 0, 0, 0, 1, 2**64 - 1), Reason.OUT_OF_RANGE),
    ],
)
def test_bad_frames_are_refused_with_their_reason(payload: bytes, reason: Reason) -> None:
    with pytest.raises(Rejected) as refused:
        decode_uwb(payload)
    assert refused.value.reason is reason


def test_no_bad_frame_is_sent() -> None:
    good = UwbFrame(1, "unix", 5, (UwbRange(1, 5.0),), observer=3)
    for bad in (
        replace(good, ranges=(UwbRange(1, float("nan")),)),
        replace(good, ranges=(UwbRange(3, 5.0),)),
        replace(good, ranges=(UwbRange(1, 5.0),) * 65),
        replace(good, observer=None),
    ):
        with pytest.raises(EncodeError, match="uwb frame"):
            encode_uwb_json(bad)
    for bad in (replace(good, clock="none"), replace(good, ranges=(UwbRange(1, 5.0, offset_s=0.1),))):
        with pytest.raises(EncodeError, match="use JSON"):
            encode_uwb_binary(bad)


def test_the_intake_refuses_old_repeated_and_foreign_frames() -> None:
    intake = UwbIntake(3)
    times = {"unix_s": 1000.0, "monotonic_s": 50.0}

    def payload(seq: int, clock: str, t_s: float, observer: int = 3) -> bytes:
        return encode_uwb_json(UwbFrame(seq, clock, round(t_s * 1e9), (UwbRange(1, 5.0),), observer))  # type: ignore[arg-type]

    # GIVEN frames on each clock THEN each is aged on its own
    for seq, clock, t_s, age_s in [(1, "unix", 999.5, 0.5), (2, "mono", 49.75, 0.25), (3, "none", 0.0, 0.0)]:
        accepted = intake.accept(payload(seq, clock, t_s), **times)
        assert accepted is not None
        assert accepted[1] == pytest.approx(age_s)
    # WHEN they are old, of the future, repeated, of another drone or garbage THEN refused and counted
    for bad in (
        payload(4, "unix", 998.9),
        payload(5, "mono", 51.1),
        payload(1, "unix", 999.5),
        payload(6, "unix", 1000.0, observer=2),
        b"garbage",
    ):
        assert intake.accept(bad, **times) is None
    assert intake.rejections.as_dict() == {"wrong_key": 1, "duplicate": 1, "stale": 2, "malformed": 1}
    assert intake.received == 3
    # a driver that was restarted counts from one again, at a later time
    assert intake.accept(payload(1, "unix", 1000.0), **times) is not None
