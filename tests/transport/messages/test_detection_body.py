"""The target-detection/1 contract: what is refused as a whole, what is left out of a frame."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.detection_body import (
    Detection,
    DetectionFrame,
    decode_detections,
    encode_detections,
    is_detection_frame,
)
from transport.messages.uwb_body import FrameIntake, UwbFrame, UwbRange, encode_uwb_json

axis = st.floats(-100, 100)
directions = st.tuples(axis, axis, axis).filter(lambda vector: max(map(abs, vector)) > 0.01)
bearings = st.builds(Detection, st.integers(4, 65535), directions, st.floats(1e-4, 1.0), offset_s=st.floats(-1, 1))
places = st.builds(
    Detection, st.integers(4, 65535), directions, st.floats(1e-4, 1.0), st.floats(0.1, 2000), st.floats(0.01, 500)
)
frames = st.builds(
    DetectionFrame,
    seq=st.integers(0, 2**32 - 1),
    clock=st.sampled_from(["mono", "unix", "none"]),
    t_ns=st.integers(0, 2**63 - 1),
    detections=st.lists(bearings | places, max_size=64).map(tuple),
    observer=st.just(3),
    axes=st.sampled_from(["body", "ned"]),
)
EXAMPLE: dict[str, Any] = {
    "schema": "target-detection/1", "obs": 3, "seq": 7, "clk": "mono", "t": 81794643123, "axes": "body",
    "m": [{"id": 101, "dir": [0.8, 0.1, 0.6], "sa": 0.01, "r": 42.0, "sr": 1.5, "dt": -0.02}],
}  # fmt: skip


@settings(max_examples=60)
@given(frames)
def test_a_frame_comes_back_exactly_and_is_known_for_what_it_is(frame: DetectionFrame) -> None:
    payload = encode_detections(frame)
    assert is_detection_frame(payload)
    assert decode_detections(payload) == frame


def test_the_documented_example_is_read() -> None:
    frame = decode_detections(json.dumps(EXAMPLE).encode())
    assert frame.detections == (Detection(101, (0.8, 0.1, 0.6), 0.01, 42.0, 1.5, -0.02),)
    assert (frame.observer, frame.axes, frame.skipped) == (3, "body", 0)


def test_ranges_and_what_is_no_frame_at_all_are_not_taken_for_detections() -> None:
    ranges = encode_uwb_json(UwbFrame(1, "unix", 5, (UwbRange(2, 10.0),), 3))
    assert not any(map(is_detection_frame, (ranges, b"", b"\xff", b'{"schema": 3}', b'{"schema":"uwb-range/1"}')))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"schema": "target-detection/2"}, Reason.BAD_VERSION),
        ({"obs": 0}, Reason.OUT_OF_RANGE),
        ({"seq": -1}, Reason.OUT_OF_RANGE),
        ({"axes": "enu"}, Reason.MALFORMED),
        ({"m": [{"id": 101, "sa": 0.01}]}, Reason.MALFORMED),
        ({"m": [{"id": 101, "dir": [1, 0], "sa": 0.01}]}, Reason.MALFORMED),
        ({"m": EXAMPLE["m"] * 65}, Reason.TOO_LONG),
    ],
)
def test_a_frame_that_is_none_is_refused(change: dict[str, Any], reason: Reason) -> None:
    with pytest.raises(Rejected) as refused:
        decode_detections(json.dumps(EXAMPLE | change).encode())
    assert refused.value.reason is reason


@pytest.mark.parametrize(
    "change",
    [
        {"id": 3},  # itself
        {"id": 0},
        {"dir": [0.0, 0.0, 0.0]},
        {"dir": [1.7e308, 1.7e308, 0.0]},
        {"sa": 0.0},
        {"sa": 2.0},
        {"r": -1.0},
        {"r": None},  # with a sigma
        {"sr": None},  # of a distance
        {"sr": 0.0},
        {"dt": 3.0},
    ],
)
def test_a_detection_that_is_none_is_left_out_and_counted(change: dict[str, Any]) -> None:
    good = EXAMPLE["m"][0]
    frame = decode_detections(json.dumps(EXAMPLE | {"m": [good | change, good]}).encode())
    assert (len(frame.detections), frame.skipped) == (1, 1)


def test_what_is_not_usable_is_not_sent() -> None:
    with pytest.raises(EncodeError, match="not usable"):
        encode_detections(DetectionFrame(1, "unix", 5, (Detection(101, (0.0, 0.0, 0.0), 0.1),), 3))
    with pytest.raises(EncodeError, match="at most"):
        encode_detections(DetectionFrame(1, "unix", 5, (Detection(101, (1.0, 0.0, 0.0), 0.1),) * 65, 3))


@pytest.mark.parametrize(
    ("observer", "at_s", "reason"), [(3, 1.5, Reason.STALE), (4, 0.0, Reason.WRONG_KEY), (3, 0.1, None)]
)
def test_frames_of_others_old_ones_and_repeated_ones_are_refused(
    observer: int, at_s: float, reason: Reason | None
) -> None:
    intake = FrameIntake(observer, decode_detections, "detection")
    payload = encode_detections(DetectionFrame(1, "unix", 0, (), 3))
    accepted = intake.accept(payload, unix_s=at_s, monotonic_s=99.0)
    if reason is not None:
        assert accepted is None
        assert intake.rejections.as_dict() == {str(reason): 1}
        return
    assert accepted is not None
    assert accepted[1] == pytest.approx(0.1)
    assert intake.accept(payload, unix_s=at_s, monotonic_s=99.0) is None
    assert intake.rejections.as_dict() == {str(Reason.DUPLICATE): 1}
