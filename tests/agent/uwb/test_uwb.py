"""``uwb-range/1`` frames to range samples."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.tables import SensorsTable
from agent.sensing.samples import RangeSample
from agent.uwb.adapter import UwbAdapter
from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_binary, encode_uwb_json

NOW_S, HOST_S, UNIX_S = 1000.0, 50.0, 1_767_226_600.0


def adapter(**sensors: Any) -> UwbAdapter:
    return UwbAdapter(1, (1, 2, 3), SensorsTable(**sensors))


def receive(made: UwbAdapter, payload: bytes) -> list[RangeSample]:
    return made.receive(payload, now_s=NOW_S, host_s=HOST_S, unix_s=UNIX_S)


def frame(*ranges: UwbRange, clock: Any = "mono", age_s: float = 0.02, seq: int = 1) -> UwbFrame:
    now_s = {"mono": HOST_S, "unix": UNIX_S, "none": 0.0}[clock]
    return UwbFrame(seq, clock, max(round((now_s - age_s) * 1e9), 0), ranges, observer=1)


@pytest.mark.parametrize("clock", ["mono", "unix"])
def test_ranges_get_the_time_of_their_frame_whichever_its_clock(clock: str) -> None:
    for encode in (encode_uwb_json, encode_uwb_binary):
        samples = receive(adapter(), encode(frame(UwbRange(2, 12.345, 0.05), clock=clock)))
        assert len(samples) == 1
        assert samples[0].t_s == pytest.approx(NOW_S - 0.02, abs=1e-6)
        assert (samples[0].observer, samples[0].target) == (1, 2)
        assert samples[0].range_m == pytest.approx(12.345, abs=1e-5)
        assert samples[0].sigma_m == pytest.approx(0.05)


def test_without_a_clock_arrival_counts_and_offsets_and_latency_apply() -> None:
    payload = encode_uwb_json(frame(UwbRange(2, 5.0, offset_s=-0.004), clock="none"))
    sample = receive(adapter(uwb_latency_s=0.01), payload)[0]
    assert sample.t_s == pytest.approx(NOW_S - 0.014)
    assert sample.sigma_m == 0.1


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (UwbRange(9, 5.0), "not a neighbour"),
        (UwbRange(2, 5.0, offset_s=0.5), "wrong time"),
        (UwbRange(2, 5.0, rx_dbm=-78.0, first_path_dbm=-90.0), "no line of sight"),
    ],
)
def test_a_range_that_cannot_be_used_is_counted_and_the_others_stand(entry: UwbRange, reason: str) -> None:
    made = adapter()
    samples = receive(made, encode_uwb_json(frame(entry, UwbRange(3, 7.0))))
    assert [sample.target for sample in samples] == [3]
    assert dict(made.skipped) == {reason: 1}


@pytest.mark.parametrize(
    ("entry", "factor"),
    [
        (UwbRange(2, 5.0, 0.1, rx_dbm=-78.0, first_path_dbm=-80.0), 1.0),
        (UwbRange(2, 5.0, 0.1, rx_dbm=-78.0, first_path_dbm=-85.0), 3.0),
        (UwbRange(2, 5.0, 0.1, nlos=0.9), 3.0),
    ],
)
def test_a_suspect_range_is_trusted_less(entry: UwbRange, factor: float) -> None:
    assert receive(adapter(), encode_uwb_json(frame(entry)))[0].sigma_m == pytest.approx(0.1 * factor)


def test_no_driver_is_believed_below_the_floor() -> None:
    payload = encode_uwb_json(frame(UwbRange(2, 5.0, 0.05)))
    assert receive(adapter(uwb_sigma_floor_m=0.4), payload)[0].sigma_m == 0.4


def test_old_repeated_and_foreign_frames_are_refused() -> None:
    made = adapter()
    good = encode_uwb_json(frame(UwbRange(2, 5.0)))
    assert len(receive(made, good)) == 1
    assert receive(made, good) == []
    assert receive(made, encode_uwb_json(frame(UwbRange(2, 5.0), age_s=1.5))) == []
    foreign = UwbFrame(5, "none", 0, (UwbRange(3, 1.0),), observer=2)
    assert receive(made, encode_uwb_json(foreign)) == []
    assert sum(made.intake.rejections.as_dict().values()) == 3


@given(st.binary(max_size=200))
def test_no_payload_raises_or_gives_a_range(payload: bytes) -> None:
    made = adapter()
    for prefix in (b"", b"UWB1", b'{"v":1,'):
        assert receive(made, prefix + payload) == [] or payload.startswith(b"\x00")
