"""Measurement records: round trips, honesty of the rounding, the cut at the size limit, refusals."""

from __future__ import annotations

import math
import struct
from dataclasses import fields, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES
from transport.messages.measurement_body import (
    RECORD_BYTES,
    AccelerationMeasurement,
    AnchorRangeMeasurement,
    AntennaSpeedMeasurement,
    GroundHeightMeasurement,
    HeightMeasurement,
    Measurement,
    MeasurementKind,
    Measurements,
    OdometryMeasurement,
    OrientationMeasurement,
    PositionMeasurement,
    RangeMeasurement,
    SightingMeasurement,
    SpeedMeasurement,
    TagRangeMeasurement,
    VelocityMeasurement,
    as_sent,
    decode_measurements,
    encode_measurements,
)

ROSTER = frozenset(range(1, 1000))
TICK = 5000

ids = st.integers(1, 999)
ticks = st.integers(TICK - 255, TICK)


def numbers(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit)


def triples(of: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(of, of, of)


variances = st.floats(1e-12, 1e8)
widths = st.one_of(st.just(math.inf), st.floats(1e-6, 1e6))
offsets = st.floats(-10, 10)

positions = st.builds(
    PositionMeasurement, ids, ticks, triples(numbers(1e6)), triples(variances), triples(widths), offsets
)
velocities = st.builds(
    VelocityMeasurement, ids, ticks, triples(numbers(1e4)), triples(variances), triples(widths), offsets
)
speeds = st.builds(SpeedMeasurement, ids, ticks, numbers(1e4), variances, widths, offsets)
ranges = st.builds(RangeMeasurement, ids, ticks, ids, numbers(1e5), variances, widths, offsets).filter(
    lambda record: record.observer != record.other
)
anchors = st.builds(
    AnchorRangeMeasurement, ids, ticks, triples(numbers(1e6)), numbers(1e5), variances, widths, offsets
)
accelerations = st.builds(AccelerationMeasurement, ids, ticks, triples(numbers(1e4)), triples(variances))
tags = st.integers(0, 15)
tag_ranges = st.builds(
    TagRangeMeasurement, ids, ticks, ids, numbers(1e5), variances, widths, offsets, tags, tags
).filter(lambda record: record.observer != record.other)
antenna_speeds = st.builds(
    AntennaSpeedMeasurement, ids, ticks, numbers(1e4), variances, widths, offsets, triples(numbers(60.0))
)
orientations = st.builds(OrientationMeasurement, ids, ticks, triples(numbers(3.2)), triples(numbers(60.0)))
heights = st.builds(HeightMeasurement, ids, ticks, numbers(1e6), variances, offsets)
ground_heights = st.builds(GroundHeightMeasurement, ids, ticks, numbers(1e6), variances, offsets)
odometries = st.builds(
    OdometryMeasurement, ids, ticks, triples(numbers(1e4)), triples(variances), offsets
)
directions = triples(numbers(1.0)).filter(lambda vector: math.hypot(*vector) > 0.1).map(
    lambda vector: tuple(axis / math.hypot(*vector) for axis in vector)
)
sightings = st.builds(
    SightingMeasurement, ids, ticks, ids, st.floats(1e-3, 1e5), variances, st.just(math.inf), offsets, directions,
    variances,
).filter(lambda record: record.observer != record.other)
records = st.one_of(
    positions, velocities, speeds, ranges, anchors, accelerations, tag_ranges, antenna_speeds, orientations, heights,
    ground_heights, odometries, sightings,
)  # fmt: skip

RANGE = RangeMeasurement(1, TICK, 2, 10.0, 0.01, 0.3, 0.02)
SPEED = SpeedMeasurement(1, TICK, 1.5, 0.04)


def flat(value: object) -> list[float]:
    return list(value) if isinstance(value, tuple) else [value]  # type: ignore[list-item]


def round_trip(*given_records: Measurement) -> tuple[Measurement, ...]:
    encoded = encode_measurements(Measurements(TICK, given_records), limit_bytes=100_000)
    assert encoded.left_out == 0
    return decode_measurements(encoded.body, tick=TICK, count=encoded.count, roster=ROSTER).records


@settings(max_examples=400)
@given(records)
def test_a_record_comes_back_close_and_never_more_trusted(record: Measurement) -> None:
    # WHEN a record crosses the wire
    (received,) = round_trip(record)
    # THEN ids and ticks are exact, values float32-close, and noise and bounds not smaller than they were
    assert type(received) is type(record)
    for field in fields(record):
        sent, came = getattr(record, field.name), getattr(received, field.name)
        if field.name in ("observer", "other", "tick", "tag", "other_tag"):
            assert sent == came
        elif field.name.startswith("variance"):
            for a, b in zip(flat(sent), flat(came), strict=True):
                assert a * (1 - 1e-12) <= b <= max(a * 1.0025, (math.sqrt(a) + 6e-8) ** 2)
        elif field.name.startswith("half_width"):
            for a, b in zip(flat(sent), flat(came), strict=True):
                assert b >= a
                assert b <= a * 1.001 + 6e-8 or a > 65504
        elif field.name in ("shift_mps", "rotation_rad", "rate_radps"):  # float16 will do: they turn short arms
            for a, b in zip(flat(sent), flat(came), strict=True):
                assert b == pytest.approx(a, rel=5e-4, abs=3e-8)
        else:
            for a, b in zip(flat(sent), flat(came), strict=True):
                assert b == pytest.approx(a, rel=1e-7, abs=1e-37)


@settings(max_examples=200)
@given(records)
def test_rounding_happens_once(record: Measurement) -> None:
    # GIVEN a record as its receivers see it
    rounded = as_sent(record)
    # THEN relaying it changes nothing any more, and it is still the same measurement
    assert round_trip(rounded) == (rounded,)
    assert rounded.identity == record.identity


IDENTITY_ENDS = dict.fromkeys(MeasurementKind, 8) | {
    MeasurementKind.RANGE: 10,
    MeasurementKind.ANCHOR_RANGE: 20,
    MeasurementKind.ACCELERATION: 4,
    MeasurementKind.ORIENTATION: 4,
    MeasurementKind.TAG_RANGE: 11,
    MeasurementKind.SIGHTING: 10,
}
"""Byte of a record at which its values begin: up to there it says which measurement it is."""


@settings(max_examples=400)
@given(records, st.data())
def test_a_record_of_changed_bytes_is_another_one(record: Measurement, data: st.DataObject) -> None:
    # GIVEN a record that was sent and received, and is known again
    body = encode_measurements(Measurements(TICK, (record,))).body
    (known,) = decode_measurements(body, tick=TICK, count=1, roster=ROSTER).records
    assert decode_measurements(body, tick=TICK, count=1, roster=ROSTER).records == (known,)
    # WHEN one of its bytes is changed
    place, change = data.draw(st.integers(0, len(body) - 1)), data.draw(st.integers(1, 255))
    forged = bytearray(body)
    forged[place] ^= change
    try:
        received = decode_measurements(bytes(forged), tick=TICK, count=1, roster=ROSTER)
    except Rejected:
        return
    # THEN what comes out says what the changed bytes say, and is the same measurement only by the same name
    assert encode_measurements(received).body == forged
    assert encode_measurements(Measurements(TICK, (replace(received.records[0]),))).body == forged
    same = received.records[0].identity == known.identity
    assert same == (place >= IDENTITY_ENDS[known.kind])


@given(records, st.integers(0, 100))
def test_the_same_bytes_in_a_packet_of_another_tick_are_another_measurement(record: Measurement, later: int) -> None:
    body = encode_measurements(Measurements(TICK, (record,))).body
    (known,) = decode_measurements(body, tick=TICK, count=1, roster=ROSTER).records
    (shifted,) = decode_measurements(body, tick=TICK + later, count=1, roster=ROSTER).records
    assert shifted.tick == known.tick + later
    assert (shifted.identity == known.identity) == (later == 0)


@given(records)
def test_a_record_of_someone_unknown_is_refused_however_often_it_came(record: Measurement) -> None:
    body = encode_measurements(Measurements(TICK, (record,))).body
    decode_measurements(body, tick=TICK, count=1, roster=ROSTER)
    for stranger in {record.observer, record.other if isinstance(record, RangeMeasurement) else record.observer}:
        with pytest.raises(Rejected) as refusal:
            decode_measurements(body, tick=TICK, count=1, roster=ROSTER - {stranger})
        assert refusal.value.reason is Reason.UNKNOWN_AGENT


@settings(max_examples=100)
@given(st.lists(records, max_size=60))
def test_the_first_records_that_fit_are_sent(given_records: list[Measurement]) -> None:
    encoded = encode_measurements(Measurements(TICK, tuple(given_records)))
    received = decode_measurements(encoded.body, tick=TICK, count=encoded.count, roster=ROSTER).records
    # THEN the body keeps its limit, what came is the beginning of what was given, and nothing vanished uncounted
    assert len(encoded.body) <= MAX_DATAGRAM_BODY_BYTES
    assert encoded.count + encoded.left_out == len(given_records)
    assert [record.identity for record in received] == [r.identity for r in given_records[: encoded.count]]
    if encoded.left_out:
        left_out = given_records[encoded.count]
        kind = left_out.identity[0]
        assert len(encoded.body) + RECORD_BYTES[kind] > MAX_DATAGRAM_BODY_BYTES


def test_one_packet_holds_several_ticks_of_a_mesh_of_five() -> None:
    # GIVEN an agent that measures position, speed, four ranges and its acceleration every tick
    ticks_of_records: list[Measurement] = []
    for tick in range(TICK - 9, TICK + 1):
        ticks_of_records += [
            PositionMeasurement(1, tick, (1.0, 2.0, 3.0), (1.0, 1.0, 1.0)),
            SpeedMeasurement(1, tick, 1.0, 0.01),
            *(RangeMeasurement(1, tick, other, 7.0, 0.01) for other in (2, 3, 4, 5)),
            AccelerationMeasurement(1, tick, (0.1, 0.2, 0.3), (0.01, 0.01, 0.01)),
        ]
    # THEN one datagram repairs the loss of six others
    encoded = encode_measurements(Measurements(TICK, tuple(ticks_of_records)))
    assert encoded.count >= 7 * 7


def test_no_older_record_slips_in_where_a_newer_one_did_not_fit() -> None:
    # GIVEN room for a speed and a bit more, then a position, then another speed, each a tick older
    older = replace(SPEED, tick=TICK - 2)
    position = PositionMeasurement(1, TICK - 1, (1.0, 2.0, 3.0), (1.0, 1.0, 1.0))
    limit = 2 * RECORD_BYTES[MeasurementKind.SPEED]
    encoded = encode_measurements(Measurements(TICK, (older, position, SPEED)), limit_bytes=limit)
    assert (encoded.count, encoded.left_out) == (1, 2)


def test_what_says_nothing_or_is_too_old_is_left_out_and_counted() -> None:
    hopeless = replace(SPEED, variance_m2ps2=1e12)
    old = replace(SPEED, tick=TICK - 256)
    encoded = encode_measurements(Measurements(TICK, (SPEED, hopeless, old)))
    assert (encoded.count, encoded.left_out) == (1, 2)


@pytest.mark.parametrize(
    "bad",
    [
        replace(SPEED, speed_mps=math.nan),
        replace(SPEED, speed_mps=math.inf),
        replace(SPEED, variance_m2ps2=math.nan),
        replace(SPEED, variance_m2ps2=0.0),
        replace(SPEED, variance_m2ps2=math.inf),
        replace(SPEED, half_width_mps=math.nan),
        replace(SPEED, half_width_mps=-1.0),
        replace(SPEED, offset_s=math.nan),
        replace(SPEED, offset_s=11.0),
        replace(SPEED, tick=TICK + 1),
        replace(SPEED, tick=-1),
        replace(SPEED, observer=0),
        replace(SPEED, observer=1000),
        replace(RANGE, other=1),
        replace(RANGE, other=1000),
        SightingMeasurement(1, TICK, 2, 0.0, 0.01),
        SightingMeasurement(1, TICK, 2, 10.0, 0.01, direction=(1.0, 0.1, 0.0)),
        SightingMeasurement(1, TICK, 2, 10.0, 0.01, variance_across_m2=0.0),
        SightingMeasurement(1, TICK, 1, 10.0, 0.01),
        TagRangeMeasurement(1, TICK, 2, 10.0, 0.01, tag=16),
        TagRangeMeasurement(1, TICK, 2, 10.0, 0.01, other_tag=-1),
        OrientationMeasurement(1, TICK, (65.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        OrientationMeasurement(1, TICK, (0.0, 0.0, 0.0), (math.nan, 0.0, 0.0)),
        AntennaSpeedMeasurement(1, TICK, 1.0, 0.1, shift_mps=(math.inf, 0.0, 0.0)),
        AnchorRangeMeasurement(1, TICK, (math.nan, 0.0, 0.0), 1.0, 1.0),
        PositionMeasurement(1, TICK, (0.0, 0.0, 2e6), (1.0, 1.0, 1.0)),
    ],
)
def test_no_bad_record_is_sent(bad: Measurement) -> None:
    with pytest.raises(EncodeError, match="Measurement"):
        encode_measurements(Measurements(TICK, (bad,)))


SPEED_WIRE = "<BHBffee"
RANGE_WIRE = "<BHBfHfee"
SIGHTING_WIRE = "<BHBfHf3fee"


@pytest.mark.parametrize(
    ("body", "count", "reason"),
    [
        (struct.pack(SIGHTING_WIRE, 12, 1, 0, 0, 1, 5, 1, 0, 0, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SIGHTING_WIRE, 12, 1, 0, 0, 2, 0, 1, 0, 0, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SIGHTING_WIRE, 12, 1, 0, 0, 2, 5, 1, 0.1, 0, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SIGHTING_WIRE, 12, 1, 0, 0, 2, 5, math.nan, 0, 0, 1, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SIGHTING_WIRE, 12, 1, 0, 0, 2, 5, 1, 0, 0, 1, 0), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, math.nan, 1, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, math.inf, 1, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, math.nan, 1, 1, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, math.nan, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, math.inf, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, 1, math.nan), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, 0, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, 1, -1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1e5, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 99, 1, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 3, 4, 0, 0, 1, 1, 1), 1, Reason.UNKNOWN_AGENT),
        (struct.pack(RANGE_WIRE, 4, 1, 0, 0, 4, 1, 1, 1), 1, Reason.UNKNOWN_AGENT),
        (struct.pack(RANGE_WIRE, 4, 1, 0, 0, 1, 1, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 3, 1, 200, 0, 1, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack(SPEED_WIRE, 10, 1, 0, 0, 1, 1, 1), 1, Reason.MALFORMED),
        (struct.pack("<BHB6e", 7, 1, 0, math.nan, 0, 0, 0, 0, 0), 1, Reason.NOT_FINITE),
        (struct.pack("<BHB6e", 7, 1, 0, 0, 0, 0, 0, 0, 65), 1, Reason.OUT_OF_RANGE),
        (struct.pack("<BHBfHBfee", 8, 1, 0, 0, 1, 0, 1, 1, 1), 1, Reason.OUT_OF_RANGE),
        (struct.pack("<BHBfHBfee", 8, 1, 0, 0, 4, 0, 1, 1, 1), 1, Reason.UNKNOWN_AGENT),
        (struct.pack("<BHBff3eee", 9, 1, 0, 0, 1, math.inf, 0, 0, 1, 1), 1, Reason.NOT_FINITE),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, 1, 1)[:-1], 1, Reason.MALFORMED),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, 1, 1), 2, Reason.MALFORMED),
        (struct.pack(SPEED_WIRE, 3, 1, 0, 0, 1, 1, 1), 0, Reason.MALFORMED),
        (b"", 1, Reason.MALFORMED),
    ],
)
def test_bad_bodies_are_refused_with_their_reason(body: bytes, count: int, reason: Reason) -> None:
    with pytest.raises(Rejected) as refused:
        decode_measurements(body, tick=100, count=count, roster={1, 2, 3})
    assert refused.value.reason is reason


def test_an_empty_packet_is_a_sign_of_life() -> None:
    assert decode_measurements(b"", tick=3, count=0, roster={1}) == Measurements(3, ())


def test_the_wire_form_is_frozen() -> None:
    # GIVEN a record whose numbers are exact in the wire form; THEN its bytes are those of version 1
    encoded = encode_measurements(Measurements(TICK, (replace(RANGE, variance_m2=0.25, half_width_m=0.5),)))
    assert encoded.body == struct.pack("<BHBfHfee", MeasurementKind.RANGE, 1, 0, 0.02, 2, 10.0, 0.5, 0.5)
