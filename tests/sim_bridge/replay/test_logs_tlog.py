"""Telemetry logs: frames, vehicles, clocks, and what damage does to them."""

from __future__ import annotations

import gzip
import struct
from collections import Counter
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agent.config.tables import SensorsTable
from agent.mavlink.codec import Encoder, mavlink
from agent.sensing.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample
from sim_bridge.replay.logs import open_log
from sim_bridge.replay.logs.events import LogError, TruthSample
from sim_bridge.replay.logs.telemetry.frames import Frame, FrameReader, decoded
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


FLIGHT = tlog(Flight().records(0.0, 2.0))
WHOLE = len(frames(FLIGHT, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)[0])


@given(st.integers(0, len(FLIGHT)), st.binary(max_size=400))
def test_garbage_between_frames_costs_at_most_the_frame_it_cuts(place: int, garbage: bytes) -> None:
    found, skipped, _ = frames(FLIGHT[:place] + garbage + FLIGHT[place:], mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)
    assert WHOLE - 1 <= len(found) <= WHOLE + 1
    assert sum(skipped.values()) >= (1 if garbage and place < len(FLIGHT) else 0)


@pytest.mark.parametrize("cut", range(0, 150))
def test_a_cut_end_loses_only_the_last_frame(cut: int) -> None:
    data = FLIGHT[: len(FLIGHT) - cut]
    found, skipped, _ = frames(data, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)
    assert WHOLE - 2 <= len(found) <= WHOLE
    assert set(skipped) <= {"bytes of a cut last record"}


def test_frames_across_chunks_are_found() -> None:
    class Drops:
        """Gives few bytes at a time, as a pipe may."""

        def __init__(self, data: bytes) -> None:
            self.file = BytesIO(data)

        def read(self, size: int, /) -> bytes:
            return self.file.read(min(size, 700))

    skipped: Counter[str] = Counter()
    reader = FrameReader(Drops(FLIGHT), frozenset({105}), skipped, Counter())
    assert len(list(reader)) == WHOLE
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


@IN_ONE_FOLDER
@given(st.integers(0, len(FLIGHT)), st.booleans())
def test_a_log_cut_anywhere_gives_what_is_left(tmp_path: Path, cut: int, packed: bool) -> None:
    part = FLIGHT[:cut]
    count = attempt(tmp_path / "x", gzip.compress(part, 1) if packed else part)
    assert count >= cut / len(FLIGHT) * 88 - 10


@IN_ONE_FOLDER
@given(st.integers(20, 4000))
def test_a_cut_gzip_stream_gives_what_can_be_unpacked(tmp_path: Path, kept: int) -> None:
    packed = gzip.compress(FLIGHT, 9)
    count = attempt(tmp_path / "x", packed[:kept])
    assert count >= min(kept / len(packed), 1.0) * 70 - 30


@IN_ONE_FOLDER
@given(st.data())
def test_a_damaged_byte_costs_little_more_than_its_sample(tmp_path: Path, data: st.DataObject) -> None:
    """GIVEN up to one percent of damaged bytes THEN so many samples are missing, and at most a window of stamps."""
    damaged = bytearray(FLIGHT)
    places = data.draw(st.sets(st.integers(0, len(FLIGHT) - 1), max_size=len(FLIGHT) // 100))
    for place in places:
        damaged[place] ^= data.draw(st.integers(1, 255))
    assert attempt(tmp_path / "x", bytes(damaged)) >= attempt(tmp_path / "whole", FLIGHT) - len(places) - 10


@IN_ONE_FOLDER
@given(st.binary(max_size=2000))
def test_anything_else_is_one_line(tmp_path: Path, data: bytes) -> None:
    assert attempt(tmp_path / "x", data) == 0


@IN_ONE_FOLDER
@given(st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=20), st.integers(0, 60))
def test_no_stamps_of_the_recorder_break_the_reading(tmp_path: Path, stamps: list[int], first: int) -> None:
    records = Flight().records(0.0, 2.0)
    parts = [record(UNIX_S + t_s, frame) for t_s, frame in records]
    for place, stamp in enumerate(stamps, first):
        parts[place] = struct.pack(">Q", stamp) + records[place][1]
    assert attempt(tmp_path / "x", b"".join(parts)) >= len(records) - 3 * len(stamps) - 60


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
