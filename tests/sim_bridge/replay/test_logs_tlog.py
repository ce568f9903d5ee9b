"""Telemetry logs: frames, vehicles, clocks, and what damage does to them."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections import Counter
from io import BytesIO
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agent.config.tables import SensorsTable
from agent.mavlink.codec import Encoder, mavlink
from agent.sensing.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample, VelocitySample
from sim_bridge.replay.logs import open_log
from sim_bridge.replay.logs.events import LogError, TruthSample
from sim_bridge.replay.logs.stamps import CONFIRM_WITHOUT_EVIDENCE, HALF_WINDOW
from sim_bridge.replay.logs.telemetry.frames import (
    LONGEST_RECORD_BYTES,
    STAMP_BYTES,
    V1,
    V2,
    Frame,
    FrameReader,
    decoded,
)
from tests.support.logs import FRAME, UNIX_S, Flight, attitude, check_refusal, gps, heartbeat, imu, read, record, tlog

IN_ONE_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)


def frames(data: bytes, *wanted: int) -> tuple[list[Frame], Counter[str], Counter[str]]:
    skipped: Counter[str] = Counter()
    notes: Counter[str] = Counter()
    return list(FrameReader(BytesIO(data), frozenset(wanted), skipped, notes)), skipped, notes


# --- frames ----------------------------------------------------------------------------------------------------


@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.floats(width=32, allow_nan=False), min_size=7, max_size=7),
    st.lists(st.floats(width=32, allow_nan=False), min_size=4, max_size=4),
)
def test_decoding_is_the_codecs_own(boot_ms: int, values: list[float], offset: list[float]) -> None:
    """GIVEN a message with an array and cut zeros THEN it is what pymavlink makes of the frame."""
    message = mavlink.MAVLink_attitude_quaternion_message(boot_ms, *values, repr_offset_q=offset)
    frame = Encoder(1, 1).encode(message)
    (found,), _, _ = frames(record(1.0, frame), message.get_msgId())
    assert found[:4] == (1_000_000, 1, 1, message.get_msgId())
    by_codec = mavlink.MAVLink(None).decode(bytearray(frame))
    assert decoded(found.message_id, found.payload).to_dict() == by_codec.to_dict()


@pytest.mark.parametrize("message", [heartbeat(), imu(5.0), gps(6.0), mavlink.MAVLink_home_position_message(
    1, 2, 3, 4, 5, 6, [1, 0, 0, 0], 7, 8, 9)], ids=lambda message: message.get_type())  # fmt: skip
def test_every_kind_of_frame_is_found(message: mavlink.MAVLink_message) -> None:
    two = Encoder(3, 1).encode(message)
    packer = mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
    one = bytes(message.pack(packer, force_mavlink1=True))
    packer.signing.secret_key, packer.signing.sign_outgoing = b"k" * 32, True
    signed = bytes(message.pack(packer))
    assert len(signed) == len(two) + 13
    data = b"".join(record(1.0, frame) for frame in (two, one, signed))
    found, skipped, notes = frames(data, message.get_msgId())
    assert [frame.system_id for frame in found] == [3, 3, 3]
    plain = [decoded(frame.message_id, frame.payload).to_dict() for frame in found]
    assert plain[0] == plain[2]
    assert not skipped
    assert notes == {"MAVLink 1 frames": 1, "signed frames": 1}


RECORDS = Flight().records(0.0, 2.0)
FLIGHT = tlog(RECORDS)
IMU = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
SAMPLES = {IMU, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT}
"""What becomes a sample; heartbeats do not."""
LENGTH, FLAGS = STAMP_BYTES + 1, STAMP_BYTES + 2
"""Places in a record of the bytes that say how long it is."""


class Place(NamedTuple):
    """A record of the flight, as it was written."""

    begin: int
    end: int
    message_id: int


def _places() -> list[Place]:
    ends = list(accumulate((STAMP_BYTES + len(frame) for _, frame in RECORDS), initial=0))
    return [Place(*span, frame[7]) for span, (_, frame) in zip(pairwise(ends), RECORDS, strict=True)]


PLACES = _places()
IMU_PLACES = [place for place in PLACES if place.message_id == IMU]
WHOLE = frames(FLIGHT, IMU)[0]
NO_MAGIC = st.binary(max_size=400).map(lambda data: data.translate(None, bytes((V1, V2))))


def test_an_undamaged_flight_is_found_as_it_was_written() -> None:
    found, skipped, notes = frames(FLIGHT, IMU)
    assert [frame.payload for frame in found] == [FLIGHT[p.begin + STAMP_BYTES + 10 : p.end - 2] for p in IMU_PLACES]
    assert [frame.stamp_us for frame in found] == [round((UNIX_S + t_s) * 1e6) for t_s, f in RECORDS if f[7] == IMU]
    assert not skipped
    assert not notes


@given(st.sampled_from(PLACES), NO_MAGIC)
def test_garbage_between_frames_costs_none(before: Place, garbage: bytes) -> None:
    found, skipped, _ = frames(FLIGHT[: before.begin] + garbage + FLIGHT[before.begin :], IMU)
    assert found == WHOLE
    assert skipped.total() == len(garbage)


@given(st.sampled_from(IMU_PLACES), st.data(), NO_MAGIC.filter(len))
def test_garbage_within_a_frame_costs_that_frame(cut: Place, data: st.DataObject, garbage: bytes) -> None:
    place = data.draw(st.integers(cut.begin + STAMP_BYTES + 10, cut.end - 1))
    found, skipped, _ = frames(FLIGHT[:place] + garbage + FLIGHT[place:], IMU)
    assert found == [frame for frame, of in zip(WHOLE, IMU_PLACES, strict=True) if of is not cut]
    assert skipped.total() == len(garbage) + cut.end - cut.begin


@given(st.integers(0, len(FLIGHT)), st.binary(max_size=400))
def test_a_false_header_costs_at_most_the_frames_in_its_reach(place: int, garbage: bytes) -> None:
    """GIVEN garbage that may look like the begin of a frame THEN what is before and a longest frame behind stays."""
    found, _, _ = frames(FLIGHT[:place] + garbage + FLIGHT[place:], IMU)
    safe = [
        frame
        for frame, of in zip(WHOLE, IMU_PLACES, strict=True)
        if of.end <= place or of.begin >= place + LONGEST_RECORD_BYTES
    ]
    assert [frame for frame in found if frame in safe] == safe
    assert {frame.payload for frame in found} <= {frame.payload for frame in WHOLE}


def test_a_cut_end_loses_only_what_is_not_there() -> None:
    for cut in range(151):
        left = len(FLIGHT) - cut
        found, skipped, _ = frames(FLIGHT[:left], IMU)
        assert found == [frame for frame, of in zip(WHOLE, IMU_PLACES, strict=True) if of.end <= left]
        rest = left - max(place.end for place in PLACES if place.end <= left)
        assert skipped == ({"bytes of a cut last record": rest} if rest else {})


def test_frames_across_chunks_are_found() -> None:
    class Drops:
        """Gives few bytes at a time, as a pipe may."""

        def __init__(self, data: bytes) -> None:
            self.file = BytesIO(data)

        def read(self, size: int, /) -> bytes:
            return self.file.read(min(size, 700))

    skipped: Counter[str] = Counter()
    reader = FrameReader(Drops(FLIGHT), frozenset({105}), skipped, Counter())
    assert list(reader) == WHOLE
    assert not skipped


def test_unknown_messages_are_stepped_over() -> None:
    unknown = b"\xfd\x03\x00\x00\x07\x01\x01\xff\xff\x70abc\x12\x34"
    data = record(1.0, unknown) + record(1.1, Encoder(1, 1).encode(imu(5.0)))
    found, skipped, notes = frames(data, 105)
    assert len(found) == 1
    assert not skipped
    assert notes["unknown messages"] == 1


# --- vehicles and times ------------------------------------------------------------------------------------------


def test_a_flight_becomes_samples_at_the_instants_of_its_boot_clock(tmp_path: Path) -> None:
    """GIVEN a boot clock 1.5 % slow and a link 40 ms late THEN stamps are on log time, less that latency."""
    path = tmp_path / "a.tlog"
    flight = Flight(system_id=7, boot_at_s=-50.0, drift=0.015, latency_s=0.04)
    path.write_bytes(tlog(flight.records(0.0, 20.0)))
    source, events = read(path)
    survey = source.survey()
    (system,) = survey.systems.values()
    assert (system.system_id, system.flavour, system.reboots) == (7, "ardupilot", 0)
    assert survey.unix.known_by == "host"
    assert survey.unix.unix_s == pytest.approx(UNIX_S + 0.04)
    assert source.counts.used == {7: {"imu": 400, "attitude": 400, "gps": 100}}
    shift_s = 0.0
    for event in events:
        if isinstance(event.sample, GpsSample):
            shift_s = max(shift_s, abs(event.sample.t_s - event.arrival_s))
    assert shift_s < 0.002
    assert {type(event.sample) for event in events} == {ImuSample, AttitudeSample, GpsSample}
    assert all(event.system_id == 7 for event in events)


def test_two_vehicles_and_a_ground_station_in_one_log(tmp_path: Path) -> None:
    station = Encoder(255, 190)
    gcs = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    records = Flight(1, -10.0).records(0, 5) + Flight(2, -99.0).records(0, 5)
    records += [(float(t_s), station.encode(gcs)) for t_s in range(5)]
    path = tmp_path / "two.tlog"
    path.write_bytes(tlog(sorted(records, key=lambda pair: pair[0])))
    source, events = read(path)
    assert set(source.survey().systems) == {1, 2}
    assert source.counts.used[1] == source.counts.used[2]
    assert source.counts.skipped["from no autopilot"] == 5
    for event in events:
        assert abs(event.sample.t_s - event.arrival_s) < 0.02


def test_a_reboot_in_the_middle(tmp_path: Path) -> None:
    path = tmp_path / "reboot.tlog"
    path.write_bytes(tlog(Flight(boot_at_s=-500.0).records(0, 5) + Flight(boot_at_s=7.0).records(8, 14)))
    source, events = read(path)
    assert source.survey().systems[1].reboots == 1
    assert source.counts.notes["reboots"] == 1
    assert source.counts.skipped == {"wrong stamp of the recorder": 4}  # until the pause before it is believed
    assert len(events) == 2 * 220 + 55 - 3  # the fourth was a heartbeat
    assert all(abs(event.sample.t_s - event.arrival_s) < 0.02 for event in events)


def test_what_was_dealt_with_in_the_boot_times_is_noted(tmp_path: Path) -> None:
    """GIVEN a boot clock that leaps 100 s ahead, and two stray boot times THEN the report can tell of both."""
    encoder = Encoder(1, 1)
    strays = [(2.512, encoder.encode(imu(70_000.0))), (3.512, encoder.encode(imu(90_000.0)))]
    records = Flight(boot_at_s=-500.0).records(0, 5) + Flight(boot_at_s=-600.0).records(5, 10)
    path = tmp_path / "leap.tlog"
    path.write_bytes(tlog(sorted(records + strays, key=lambda pair: pair[0])))
    source, _ = read(path)
    assert source.counts.notes["jumps of a boot clock"] == 1
    assert source.counts.notes["boot times that fit no clock"] == 2
    assert "reboots" not in source.counts.notes


def test_without_heartbeats_component_one_is_the_autopilot(tmp_path: Path) -> None:
    encoder = Encoder(4, 1)
    path = tmp_path / "silent.tlog"
    path.write_bytes(tlog([(0.05 * i, encoder.encode(imu(9.0 + 0.05 * i))) for i in range(50)]))
    source, events = read(path)
    assert source.survey().systems[4].flavour == "unknown"
    assert len(events) == 50


def test_truth_and_estimates_come_in_the_fleets_frame(tmp_path: Path) -> None:
    """GIVEN an own origin 100 m up THEN LOCAL_POSITION_NED is shifted by it; truth is at the instant beside it."""
    encoder = Encoder(1, 1)
    origin = mavlink.MAVLink_gps_global_origin_message(470_000_000, 80_000_000, 500_000)
    records = [(0.0, encoder.encode(heartbeat())), (0.0, encoder.encode(origin))]
    for i in range(100):
        t_s, boot_s = i * 0.05, 30.0 + i * 0.05
        records.append((t_s, encoder.encode(attitude(boot_s))))
        place = {"lat_int": 470_001_000, "lon_int": 80_000_000}
        state = mavlink.MAVLink_sim_state_message(
            1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 47.0, 8.0, 410.0, 0, 0, 1.0, 2.0, 3.0, **place
        )
        records.append((t_s + 0.003, encoder.encode(state)))
        local = mavlink.MAVLink_local_position_ned_message(round(boot_s * 1e3), 1, 2, 3, 4, 5, 6)
        records.append((t_s, encoder.encode(local)))
    path = tmp_path / "truth.tlog"
    path.write_bytes(tlog(records))
    source, events = read(path)
    assert source.survey().systems[1].truth_from == "SIM_STATE"
    assert source.survey().systems[1].estimate_frame == "fleet"
    truth = next(event for event in events if isinstance(event.sample, TruthSample))
    assert isinstance(truth.sample, TruthSample)
    assert truth.sample.position_m == pytest.approx(FRAME.ned(47.0001, 8.0, 410.0), abs=1e-6)
    assert truth.sample.velocity_mps == (1.0, 2.0, 3.0)
    assert truth.sample.t_s == pytest.approx(truth.arrival_s - 0.003, abs=1e-3)
    estimate = next(event.sample for event in events if isinstance(event.sample, AutopilotEstimate))
    assert estimate.position_m == pytest.approx((1.0, 2.0, -97.0), abs=1e-3)


def test_without_an_origin_the_global_position_serves(tmp_path: Path) -> None:
    encoder = Encoder(1, 1)
    records = [(0.0, encoder.encode(heartbeat()))]
    for i in range(40):
        boot_ms = 30_000 + 50 * i
        place = (470_001_000, 80_000_000, 410_000) if i else (0, 0, 0)  # ArduPilot sends zeros before it knows
        where = mavlink.MAVLink_global_position_int_message(boot_ms, *place, 0, 1, 2, 3, 0)
        records.append((0.05 * i, encoder.encode(where)))
        local = mavlink.MAVLink_local_position_ned_message(boot_ms, 1, 2, 3, 4, 5, 6)
        records.append((0.05 * i, encoder.encode(local)))
    path = tmp_path / "global.tlog"
    path.write_bytes(tlog(records))
    source, events = read(path)
    assert source.counts.used[1]["autopilot estimate"] == 39
    assert source.counts.skipped["global position: none"] == 1
    estimate = events[-1].sample
    assert isinstance(estimate, AutopilotEstimate)
    assert estimate.position_m == pytest.approx(FRAME.ned(47.0001, 8.0, 410.0), abs=1e-6)
    assert estimate.velocity_mps == pytest.approx((0.01, 0.02, 0.03))


def test_without_a_frame_the_log_gives_its_own(tmp_path: Path) -> None:
    path = tmp_path / "own.tlog"
    path.write_bytes(tlog(Flight().records(0, 3)))
    source, events = read(path, None)
    assert (source.frame.lat_deg, source.frame.alt_m) == (47.0, 400.0)
    first = next(event.sample for event in events if isinstance(event.sample, GpsSample))
    assert first.position_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


# --- damage ------------------------------------------------------------------------------------------------------


def attempt(path: Path, data: bytes) -> int:
    """Events of whatever ``data`` is; a `LogError` of one line is an answer too."""
    path.write_bytes(data)
    try:
        source, events = read(path)
    except LogError as error:
        check_refusal(error, path)
        return 0
    arrivals = [event.arrival_s for event in events]
    assert arrivals == sorted(arrivals)
    assert sum(kinds.total() for kinds in source.counts.used.values()) == len(events)
    return len(events)


def whole_samples(length: int) -> int:
    """Of the records that the first ``length`` bytes of the flight hold to their end."""
    return sum(place.end <= length and place.message_id in SAMPLES for place in PLACES)


@IN_ONE_FOLDER
@given(st.integers(0, len(FLIGHT)), st.booleans())
def test_a_log_cut_anywhere_gives_what_is_left(tmp_path: Path, cut: int, packed: bool) -> None:
    part = FLIGHT[:cut]
    assert attempt(tmp_path / "x", gzip.compress(part, 1) if packed else part) == whole_samples(cut)


PACKED = gzip.compress(FLIGHT, 9, mtime=0)


@IN_ONE_FOLDER
@given(st.integers(0, len(PACKED)))
def test_a_cut_gzip_stream_gives_what_can_be_unpacked(tmp_path: Path, kept: int) -> None:
    unpacked = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(PACKED[:kept])
    assert attempt(tmp_path / "x", PACKED[:kept]) == whole_samples(len(unpacked))


def damaged(data: st.DataObject, places: list[int], most: int) -> tuple[bytes, set[int]]:
    """The flight with some of these bytes changed, and which."""
    made = bytearray(FLIGHT)
    hit = data.draw(st.sets(st.sampled_from(places), max_size=most))
    for place in hit:
        made[place] ^= data.draw(st.integers(1, 255))
    return bytes(made), hit


OF_FRAMES = [i for place in PLACES for i in range(place.begin + STAMP_BYTES, place.end)]
OF_LONE_STAMPS = [i for place in PLACES[3:-3:3] for i in range(place.begin, place.begin + STAMP_BYTES)]
"""Of every third record: the two stamps before and behind each are good."""


@IN_ONE_FOLDER
@given(st.data())
def test_damaged_frames_cost_their_samples(tmp_path: Path, data: st.DataObject) -> None:
    """GIVEN up to one percent of damaged bytes THEN all samples are there that these cannot reach.

    A damaged byte reaches its own record; one that says how long the record is, those behind it too.
    """
    log, hit = damaged(data, OF_FRAMES, len(FLIGHT) // 100)
    headers = {place.begin + at for place in PLACES for at in (STAMP_BYTES, LENGTH, FLAGS)} & hit
    reached = [
        place
        for place in PLACES
        if any(place.begin <= i < place.end for i in hit)
        or any(i < place.begin < i + LONGEST_RECORD_BYTES for i in headers)
    ]
    lost = sum(place.message_id in SAMPLES for place in reached)
    assert whole_samples(len(FLIGHT)) - lost <= attempt(tmp_path / "x", log) <= whole_samples(len(FLIGHT))


@IN_ONE_FOLDER
@given(st.data())
def test_damaged_stamps_between_good_ones_cost_nothing(tmp_path: Path, data: st.DataObject) -> None:
    log, _ = damaged(data, OF_LONE_STAMPS, len(FLIGHT) // 100)
    assert attempt(tmp_path / "x", log) == whole_samples(len(FLIGHT))


@IN_ONE_FOLDER
@given(st.binary(max_size=2000))
def test_anything_else_is_one_line(tmp_path: Path, data: bytes) -> None:
    assert attempt(tmp_path / "x", data) == 0


@IN_ONE_FOLDER
@given(st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=20), st.integers(0, 60))
def test_no_stamps_of_the_recorder_break_the_reading(tmp_path: Path, stamps: list[int], first: int) -> None:
    """GIVEN false stamps in a row, believed perhaps THEN the good ones behind them are believed again in time."""
    records = Flight().records(0.0, 6.0)
    parts = [record(UNIX_S + t_s, frame) for t_s, frame in records]
    samples = sum(frame[7] in SAMPLES for _, frame in records)
    for place, stamp in enumerate(stamps, first):
        parts[place] = struct.pack(">Q", stamp) + records[place][1]
    lost = samples - attempt(tmp_path / "x", b"".join(parts))
    assert 0 <= lost <= len(stamps) + (CONFIRM_WITHOUT_EVIDENCE if len(stamps) > HALF_WINDOW else 0)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "an empty file"),
        (gzip.compress(b"", mtime=0), "an empty file"),
        (b"time,lat,lon\n1,2,3\n" * 50, "something else"),
        (b"\xfe" * 100_000, "something else"),
        (b"\x1f\x8b\x08broken", "damaged gzip"),
    ],
    ids=["empty", "empty_gzip", "text", "noise", "damaged_gzip"],
)
def test_foreign_files_are_refused_in_one_line(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "foreign.tlog"
    path.write_bytes(data)
    with pytest.raises(LogError, match=words) as caught:
        open_log(path, frame=FRAME, sensors=SensorsTable())
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_log_without_vehicle_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "none.tlog", frame=FRAME, sensors=SensorsTable())
    encoder = Encoder(255, 190)
    gcs = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    path = tmp_path / "gcs.tlog"
    path.write_bytes(tlog([(float(i), encoder.encode(gcs)) for i in range(9)]))
    with pytest.raises(LogError, match=r"9 HEARTBEAT from systems \[255\]"):
        read(path)


def test_a_companions_velocities_are_its_vehicles_and_nobody_elses(tmp_path: Path) -> None:
    # GIVEN velocities of the autopilot, of a companion, of our own component, and of a system without autopilot
    records = Flight().records(0.0, 4.0)
    vision = mavlink.MAVLink_vision_speed_estimate_message(0, 1.0, 2.0, 0.0)
    for source in ((1, 1), (1, 191), (1, 197), (9, 191)):
        records += [(0.1 * k, Encoder(*source).encode(vision)) for k in range(10, 30)]
    path = tmp_path / "a.tlog"
    path.write_bytes(tlog(sorted(records, key=lambda each: each[0])))
    source, events = read(path)
    found = [event for event in events if isinstance(event.sample, VelocitySample)]
    # THEN those of the companion are used, and the others counted
    assert [event.system_id for event in found] == [1] * 20
    assert [event.sample.t_s for event in found] == pytest.approx([0.1 * k for k in range(10, 30)], abs=1e-3)
    skipped = source.counts.skipped
    assert skipped["odometry: the autopilot's own"] == 20
    assert skipped["odometry: of our own component id"] == 20
    assert skipped["from no autopilot"] == 20
