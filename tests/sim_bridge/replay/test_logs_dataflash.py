"""Dataflash logs: formats described by the log, units, lanes, truth, damage."""

from __future__ import annotations

import math
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agent.config.tables import SensorsTable
from agent.sensing.samples import (
    AttitudeSample,
    AutopilotEstimate,
    BaroSample,
    FlowSample,
    GpsSample,
    GroundSample,
    ImuSample,
    VelocitySample,
)
from sim_bridge.replay.logs import open_log
from sim_bridge.replay.logs.dataflash.records import FMT_BYTES, HEAD, LONGEST_RECORD_BYTES, RecordReader
from sim_bridge.replay.logs.dataflash.source import CONFIRM_RECORDS
from sim_bridge.replay.logs.events import LogError, TruthSample
from sim_bridge.replay.logs.surveyed import OwnWords
from tests.support.logs import FMT_OF_FMT, check_refusal, entry, fmt, read

IN_ONE_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
IMU, ATT, GPS, GPA, XKF1, XKF4, ORGN, SIM, SIM2, PARM = range(100, 110)
IMU_F, GPS_F, GPA_F, ORGN_F = "QBffffff", "QBBIHBcLLeff", "QBCCCI", "QBLLe"
HEADER = FMT_OF_FMT + b"".join(
    (
        fmt(IMU, "IMU", IMU_F, "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
        fmt(ATT, "ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw"),
        fmt(GPS, "GPS", GPS_F, "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs"),
        fmt(GPA, "GPA", GPA_F, "TimeUS,I,HAcc,VAcc,SAcc,SMS"),
        fmt(XKF1, "XKF1", "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD"),
        fmt(XKF4, "XKF4", "QBB", "TimeUS,C,PI"),
        fmt(ORGN, "ORGN", ORGN_F, "TimeUS,Type,Lat,Lng,Alt"),
        fmt(SIM, "SIM", "QfLLffff", "TimeUS,Alt,Lat,Lng,Q1,Q2,Q3,Q4"),
        fmt(SIM2, "SIM2", "Qdddfff", "TimeUS,PN,PE,PD,VN,VE,VD"),
        fmt(PARM, "PARM", "QNf", "TimeUS,Name,Value"),
    )
)


def flight(from_s: float = 30.0, to_s: float = 34.0) -> bytes:
    """4 s of a vehicle that flies north at 2 m/s, 100 m above the fleet's origin at 30 s."""
    parts = [HEADER, entry(PARM, "QNf", round(from_s * 1e6), b"MAV_SYSID", 9.0)]
    parts.append(entry(ORGN, ORGN_F, round(from_s * 1e6), 0, 470_000_000, 80_000_000, 50_000))
    for step in range(round(from_s * 20), round(to_s * 20)):
        us, north = step * 50_000, 2.0 * (step / 20 - 30.0)
        parts.append(entry(IMU, IMU_F, us, 0, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8))
        parts.append(entry(IMU, IMU_F, us, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        parts.append(entry(ATT, "Qfff", us, 0.0, 0.0, 90.0))
        parts.append(entry(XKF4, "QBB", us, 0, 1))
        parts.append(entry(XKF1, "QBffffff", us, 0, 7.0, 7.0, 7.0, 7.0, 7.0, 7.0))
        parts.append(entry(XKF1, "QBffffff", us, 1, 2.0, 0.0, 0.0, north, 1.0, -3.0))
        parts.append(entry(SIM2, "Qdddfff", us - 8_000, north - 0.016, 0.0, -100.0, 2.0, 0.0, 0.0))
        lat_e7 = round(470_000_000 + north / 0.0111178)
        parts.append(entry(SIM, "QfLLffff", us, 500.0, lat_e7, 80_000_000, 1.0, 0.0, 0.0, 0.0))
        if step % 4 == 0:
            of_week_ms = 100_000_000 + step * 50
            place = (lat_e7, 80_000_000, 50_000)
            parts.append(entry(GPS, GPS_F, us + 20_000, 0, 3, of_week_ms, 2300, 12, 80, *place, 2.0, 0.0))
            parts.append(entry(GPA, GPA_F, us + 20_000, 0, 70, 90, 20, us // 1000))
            parts.append(entry(GPS, GPS_F, us + 20_000, 1, 3, of_week_ms, 2300, 12, 80, 0, 0, 0, 2.0, 0.0))
    return b"".join(parts)


FLIGHT = flight()


def test_records_become_samples_in_si_and_the_fleets_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.BIN"
    path.write_bytes(FLIGHT)
    source, events = read(path)
    survey = source.survey()
    assert set(survey.systems) == {9}
    system = survey.systems[9]
    assert (system.flavour, system.truth_from, system.estimate_frame) == ("ardupilot", "SIM2", "fleet")
    assert survey.unix.known_by == "gps"
    unix_s = 315_964_800 + 2300 * 604_800 + 100_000.0 + 31.0 - 18
    assert survey.unix.at(31.02) == pytest.approx(unix_s, abs=2e-3)
    by_kind = {kind: [e.sample for e in events if isinstance(e.sample, kind)] for kind in (ImuSample, GpsSample)}
    assert len(by_kind[ImuSample]) == 80
    assert by_kind[ImuSample][5].specific_force_mps2 == pytest.approx((1.0, 2.0, -9.8))
    assert by_kind[ImuSample][5].gyro_radps == pytest.approx((0.1, 0.2, 0.3))
    fix = by_kind[GpsSample][0]
    assert len(by_kind[GpsSample]) == 20
    assert fix.t_s == pytest.approx(30.0)  # GPA.SMS, 20 ms before the record
    assert fix.position_m == pytest.approx((0.0, 0.0, -100.0), abs=1e-5)
    assert (fix.horizontal_sigma_m, fix.vertical_sigma_m, fix.speed_sigma_mps) == pytest.approx((0.7, 0.9, 0.2))
    assert fix.ground_velocity_mps == pytest.approx((2.0, 0.0))
    assert fix.latency.source == "ardupilot boot"


@pytest.mark.parametrize(
    ("second", "labels", "first"),
    [("BARO", "TimeUS,I,Alt,Press", (0,)), ("BAR2", "TimeUS,Alt,Press", ())],
    ids=["numbered", "of its own name"],
)
def test_the_first_barometer_gives_altitudes_of_its_pressure(
    tmp_path: Path, second: str, labels: str, first: tuple[int, ...]
) -> None:
    # GIVEN two barometers, whose heights are above the ground, in either layout
    form, number = "QBff" if first else "Qff", (1,) if first else ()
    described = fmt(120, "BARO", form, labels) + (fmt(121, second, form, labels) if not first else b"")
    kind = 120 if first else 121
    told = b"".join(
        entry(120, form, us, *first, 3.0, 95_461.0) + entry(kind, form, us, *number, 3.0, 90_000.0)
        for us in range(34_000_000, 35_100_000, 100_000)
    )
    path = tmp_path / "a.BIN"
    path.write_bytes(flight() + described + told)
    source, events = read(path)
    heights = [event.sample for event in events if isinstance(event.sample, BaroSample)]
    assert [sample.t_s for sample in heights[:10]] == pytest.approx([34.0 + 0.1 * k for k in range(10)], abs=1e-6)
    assert {round(sample.altitude_m) for sample in heights} == {500}
    assert source.counts.skipped["baro: not the first one"] == 11


def test_flow_of_a_log_is_used(tmp_path: Path) -> None:
    layout = "QBffff"
    described = fmt(122, "OF", layout, "TimeUS,Qual,flowX,flowY,bodyX,bodyY")
    told = [(200, 0.8, 1.2, 0.2, 0.4), (0, 0.8, 1.2, 0.2, 0.4), (200, float("nan"), 1.2, 0.2, 0.4)]
    entries = b"".join(entry(122, layout, 34_000_000 + 100_000 * k, *each) for k, each in enumerate(told))
    path = tmp_path / "a.BIN"
    path.write_bytes(flight() + described + entries)
    source, events = read(path)
    (found,) = [event.sample for event in events if isinstance(event.sample, FlowSample)]
    assert found.passing_radps == pytest.approx((0.8, -0.6))
    assert found.distance_m is None
    assert source.counts.skipped["flow: no quality"] == 1
    assert source.counts.skipped["flow: not finite"] == 1


def test_odometry_and_range_finders_of_a_log_are_used(tmp_path: Path) -> None:
    # GIVEN what a companion gave the autopilot, one ignored and one of no quality, and range finders
    velocity, finder = "QfffffB", "QBHBB"
    described = fmt(120, "VISV", velocity, "TimeUS,VX,VY,VZ,VErr,Q,Ign") + fmt(
        121, "RFND", finder, "TimeUS,Instance,Dist,Stat,Orient"
    )
    told = b"".join(
        entry(120, velocity, 34_000_000 + 100_000 * k, 1.0, 2.0, 0.5, 0.2, quality, ignored)
        for k, (quality, ignored) in enumerate([(50.0, 0), (-1.0, 0), (50.0, 1), (50.0, 0)])
    ) + b"".join(
        entry(121, finder, 34_500_000 + 100_000 * k, number, 5, status, facing)
        for k, (number, status, facing) in enumerate([(0, 4, 25), (1, 4, 25), (0, 4, 0), (0, 3, 25)])
    )
    path = tmp_path / "a.BIN"
    path.write_bytes(flight() + described + told)
    source, events = read(path)
    found = [event.sample for event in events if isinstance(event.sample, VelocitySample)]
    assert [sample.velocity_mps for sample in found] == [(1.0, 2.0, 0.5)] * 2
    assert {sample.in_body for sample in found} == {False}
    assert found[0].sigma_mps == pytest.approx((0.2, 0.2, 0.2))
    assert source.counts.skipped["odometry: says that it failed"] == 2
    assert len([event for event in events if isinstance(event.sample, GroundSample)]) == 1
    assert source.counts.skipped["ground: not the first one that looks down"] == 2
    assert source.counts.skipped["ground: out of its reach"] == 1
    # and none of it where it may be ours
    ours = open_log(path, frame=source.frame, sensors=SensorsTable(), ours=OwnWords(odometry=True))
    assert not [event for event in ours.events() if isinstance(event.sample, VelocitySample)]
    assert ours.counts.skipped["odometry: may be ours"] == 4


def test_attitude_is_body_to_ned(tmp_path: Path) -> None:
    path = tmp_path / "a.BIN"
    path.write_bytes(FLIGHT)
    attitude = next(e.sample for e in read(path)[1] if isinstance(e.sample, AttitudeSample))
    assert attitude.quaternion == pytest.approx((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))


def test_the_estimate_is_of_the_primary_lane_about_the_fleets_origin(tmp_path: Path) -> None:
    path = tmp_path / "a.BIN"
    path.write_bytes(FLIGHT)
    estimates = [e.sample for e in read(path)[1] if isinstance(e.sample, AutopilotEstimate)]
    assert estimates[20].position_m == pytest.approx((2.0 * (estimates[20].t_s - 30.0), 1.0, -103.0), abs=1e-5)
    assert estimates[20].velocity_mps == (2.0, 0.0, 0.0)


def test_truth_is_the_motion_about_the_home_that_the_places_show(tmp_path: Path) -> None:
    """GIVEN places to 1 cm at other instants than the motion THEN the home is found to millimetres."""
    path = tmp_path / "a.BIN"
    path.write_bytes(FLIGHT)
    truth = [e.sample for e in read(path)[1] if isinstance(e.sample, TruthSample)]
    assert len(truth) >= 158
    for sample in truth:
        assert sample.position_m == pytest.approx((2.0 * (sample.t_s - 30.0), 0.0, -100.0), abs=4e-3)
        assert sample.velocity_mps == (2.0, 0.0, 0.0)
    assert any(sample.quaternion == (1.0, 0.0, 0.0, 0.0) for sample in truth)


def test_old_layouts_without_instance_and_accuracy(tmp_path: Path) -> None:
    """GIVEN GPS without GPA and IMU without instance THEN accuracy is from HDOP, the stamp from TimeUS."""
    header = FMT_OF_FMT + fmt(IMU, "IMU", "Qffffff", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    header += fmt(GPS, "GPS", "QBcLLe", "TimeUS,Status,HDop,Lat,Lng,Alt")
    parts = [header]
    for i in range(40):
        parts.append(entry(IMU, "Qffffff", 1_000_000 + i * 20_000, 0, 0, 0, 0, 0, -9.8))
        if i % 10 == 9:
            parts.append(entry(GPS, "QBcLLe", 1_000_000 + i * 20_000, 3, 120, 470_000_000, 80_000_000, 40_000))
    path = tmp_path / "old.BIN"
    path.write_bytes(b"".join(parts))
    source, events = read(path)
    fixes = [event.sample for event in events if isinstance(event.sample, GpsSample)]
    assert source.survey().unix.known_by == "unknown"
    assert len(fixes) == 3  # the last one waits for an accuracy that never comes
    assert fixes[0].horizontal_sigma_m == pytest.approx(1.2 * 2.5)
    assert fixes[0].ground_velocity_mps is None
    assert fixes[0].t_s == pytest.approx(1.2, abs=0.021)


def test_values_that_cannot_be_true_are_counted(tmp_path: Path) -> None:
    bad = [
        entry(IMU, IMU_F, 33_990_000, 0, math.nan, 0, 0, 0, 0, 0),
        entry(IMU, IMU_F, 33_990_000, 0, 0, 0, 0, 5000.0, 0, 0),
        entry(ATT, "Qfff", 33_990_000, math.inf, 0, 0),
        entry(XKF1, "QBffffff", 33_990_000, 1, math.nan, 0, 0, 0, 0, 0),
        entry(SIM2, "Qdddfff", 33_990_000, math.nan, 0, 0, 0, 0, 0),
    ]
    path = tmp_path / "bad.BIN"
    path.write_bytes(FLIGHT + b"".join(bad))
    source, events = read(path)
    skipped = source.counts.skipped
    assert skipped["imu: not finite"] == skipped["imu: out of range"] == 1
    assert skipped["attitude: not finite or out of range"] == skipped["autopilot estimate: not finite"] == 1
    assert skipped["truth: not finite or out of range"] == 1
    for event in events:
        assert math.isfinite(event.sample.t_s)


def test_a_damaged_time_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "time.BIN"
    place = FLIGHT.index(entry(ATT, "Qfff", 32_000_000, 0.0, 0.0, 90.0)) + 3
    damaged = bytearray(FLIGHT)
    damaged[place + 5] ^= 0x40
    path.write_bytes(bytes(damaged))
    source, events = read(path)
    assert source.counts.notes["stamps replaced"] == 1
    assert source.survey().last_s == pytest.approx(33.95, abs=0.05)
    assert len(events) == len(read_flight(tmp_path))


def read_flight(folder: Path) -> list[object]:
    path = folder / "whole.BIN"
    path.write_bytes(FLIGHT)
    return list(read(path)[1])


# --- damage ------------------------------------------------------------------------------------------------------


def records(data: bytes) -> tuple[int, Counter[str]]:
    skipped: Counter[str] = Counter()
    reader = RecordReader(BytesIO(data), {"IMU": ("TimeUS",)}, skipped, Counter())
    return len(list(reader)), skipped


class Place(NamedTuple):
    """A record behind the descriptions, as it was written."""

    begin: int
    end: int
    kind: int


def _places() -> list[Place]:
    described = [HEADER[at : at + FMT_BYTES] for at in range(0, len(HEADER), FMT_BYTES)]
    lengths = {description[3]: description[4] for description in described}
    found, at = [], len(HEADER)
    while at < len(FLIGHT):
        found.append(Place(at, at + lengths[FLIGHT[at + 2]], FLIGHT[at + 2]))
        at = found[-1].end
    return found


PLACES = _places()
IMU_RECORDS = sum(place.kind == IMU for place in PLACES)


@given(st.integers(len(HEADER), len(FLIGHT)), st.binary(min_size=1, max_size=300))
def test_garbage_costs_the_record_it_cuts_or_hides_the_end_of(place: int, garbage: bytes) -> None:
    """GIVEN a format without checksums THEN a record is believed if another begins, with two bytes, at its end."""
    garbage = garbage.translate(None, HEAD) or b"x"
    found, _ = records(FLIGHT[:place] + garbage + FLIGHT[place:])
    lost = [each for each in PLACES if each.begin < place < each.end + len(HEAD)]
    assert found == IMU_RECORDS - sum(each.kind == IMU for each in lost)


@given(st.integers(len(HEADER), len(FLIGHT)), st.binary(max_size=300))
def test_a_false_head_costs_at_most_the_records_in_its_reach(place: int, garbage: bytes) -> None:
    found, _ = records(FLIGHT[:place] + garbage + FLIGHT[place:])
    reach = range(place - len(HEAD) + 1, place + LONGEST_RECORD_BYTES)
    lost = sum(each.kind == IMU and each.end >= reach.start and each.begin < reach.stop for each in PLACES)
    assert IMU_RECORDS - lost <= found <= IMU_RECORDS + garbage.count(HEAD)


def test_a_cut_end_loses_only_what_is_not_there() -> None:
    """AND the last one that is, if the head behind it is cut in two."""
    for cut in range(121):
        left = len(FLIGHT) - cut
        found, skipped = records(FLIGHT[:left])
        believed = [each for each in PLACES if each.end == left or each.end + len(HEAD) <= left]
        assert found == sum(each.kind == IMU for each in believed)
        rest = left - believed[-1].end
        assert skipped == ({"bytes of a cut last record": rest} if rest else {})


def test_a_damaged_description_is_counted_and_not_used() -> None:
    damaged = FLIGHT.replace(b"QBffffff\0", b"QBfff!ff\0", 1)
    found, skipped = records(damaged)
    assert found == 0
    assert skipped["damaged FMT record"] == 1


@pytest.mark.parametrize(
    ("kind", "good", "flipped"),
    [
        ("IMU", b"QBffffff", b"QBfffnff"),
        ("XKF1", b"QBffffff", b"QBfffnff"),
        ("ATT", b"Qfff", b"Qfnf"),
        ("GPS", b"QBBIHBcLLeff", b"QBBIHBcLLenf"),
        ("GPS", b"QBBIHBcLLeff", b"QBBfHBcLLeff"),
        ("PARM", b"QNf", b"QNn"),
        ("PARM", b"QNf", b"dNf"),
    ],
)
def test_a_type_that_a_field_cannot_have_is_a_damaged_description(
    tmp_path: Path, kind: str, good: bytes, flipped: bytes
) -> None:
    """GIVEN a number described as text, or an integer as a float, of the same size THEN its records are left out."""
    name = kind.encode().ljust(4, b"\0")
    data = FLIGHT.replace(name + good.ljust(16, b"\0"), name + flipped.ljust(16, b"\0"), 1)
    assert data != FLIGHT
    path = tmp_path / "x.BIN"
    assert attempt(path, data) > 200
    source, _ = read(path)
    assert source.counts.skipped["damaged FMT record"] == 1
    assert kind not in next(iter(source.survey().systems.values())).messages


@IN_ONE_FOLDER
@given(st.data())
def test_damaged_descriptions_never_break_the_reading(tmp_path: Path, data: st.DataObject) -> None:
    damaged = bytearray(FLIGHT)
    for place in data.draw(st.sets(st.integers(len(FMT_OF_FMT), len(HEADER) - 1), max_size=20)):
        damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    attempt(tmp_path / "x", bytes(damaged))


def attempt(path: Path, data: bytes) -> int:
    path.write_bytes(data)
    try:
        source, events = read(path)
    except LogError as error:
        check_refusal(error, path)
        return 0
    arrivals = [event.arrival_s for event in events]
    assert arrivals == sorted(arrivals)
    for event in events:
        assert all(math.isfinite(value) for value in _numbers(event.sample))
    assert sum(kinds.total() for kinds in source.counts.used.values()) == len(events)
    return len(events)


def _numbers(sample: object) -> list[float]:
    found: list[float] = [sample.t_s]  # type: ignore[attr-defined]
    for name in ("position_m", "velocity_mps", "quaternion", "specific_force_mps2", "gyro_radps"):
        found += getattr(sample, name, None) or ()
    return found


@IN_ONE_FOLDER
@given(st.data())
def test_damaged_bytes_never_break_the_reading(tmp_path: Path, data: st.DataObject) -> None:
    damaged = bytearray(FLIGHT)
    for place in data.draw(st.sets(st.integers(0, len(FLIGHT) - 1), max_size=len(FLIGHT) // 100)):
        damaged[place] ^= data.draw(st.integers(1, 255))
    attempt(tmp_path / "x", bytes(damaged))


@IN_ONE_FOLDER
@given(st.integers(0, len(FLIGHT)))
def test_a_log_cut_anywhere_gives_what_is_left(tmp_path: Path, cut: int) -> None:
    attempt(tmp_path / "x", FLIGHT[:cut])


def test_a_log_of_descriptions_alone_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "header.BIN"
    path.write_bytes(HEADER)
    with pytest.raises(LogError, match="expected dataflash records with TimeUS, found none"):
        read(path)


def test_a_pause_of_the_logger_is_time_that_passed(tmp_path: Path) -> None:
    path = tmp_path / "pause.BIN"
    path.write_bytes(flight(30.0, 32.0) + flight(90.0, 92.0)[len(HEADER) :])
    source, events = read(path)
    assert source.survey().last_s == pytest.approx(92.0, abs=0.1)
    assert source.counts.notes["pauses of the recorder"] == 1
    assert source.counts.skipped["wrong time"] == CONFIRM_RECORDS - 1
    assert events[-1].arrival_s == pytest.approx(92.0, abs=0.1)
