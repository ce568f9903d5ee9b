"""PX4 logs: topics to samples, the clock of a companion, damage."""

from __future__ import annotations

import builtins
import gzip
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
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
from sim_bridge.replay.logs.events import LogError, TruthSample
from sim_bridge.replay.logs.surveyed import OwnWords
from sim_bridge.replay.logs.ulog.samples import baro_samples, barometer_table
from sim_bridge.replay.logs.ulog.tables import MAGIC, TopicTable, Unpacked, in_order
from tests.support.logs import FRAME, check_refusal, read

pytest.importorskip("pyulog", reason="the extra [ulog] is not installed")
IN_ONE_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=25)

_C_TYPES = {"uint64_t": "Q", "float": "f", "double": "d", "uint8_t": "B", "int32_t": "i", "int64_t": "q"}


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


class Ulog:
    """A PX4 log under construction."""

    def __init__(self) -> None:
        self.definitions = message("B", bytes(40))
        self.data = b""
        self._topics: dict[str, tuple[int, str]] = {}

    def parameter(self, name: str, value: int) -> None:
        key = f"int32_t {name}".encode()
        self.definitions += message("P", bytes((len(key),)) + key + struct.pack("<i", value))

    def topic(self, name: str, **fields: str) -> None:
        described = ";".join(f"{kind} {field}" for field, kind in {"timestamp": "uint64_t", **fields}.items())
        self.definitions += message("F", f"{name}:{described};".encode())
        number = len(self._topics)
        packed = "<Q"
        for kind in fields.values():
            base, _, count = kind.partition("[")
            packed += f"{count.rstrip(']')}{_C_TYPES[base]}"
        self._topics[name] = (number, packed)
        self.data += message("A", struct.pack("<BH", 0, number) + name.encode())

    def add(self, name: str, *values: float) -> None:
        number, packed = self._topics[name]
        self.data += message("D", struct.pack("<H", number) + struct.pack(packed, *values))

    def bytes(self) -> bytes:
        return MAGIC + b"\x01" + struct.pack("<Q", 0) + self.definitions + self.data


def flight(*, utc: bool = False, timesync: bool = True) -> bytes:
    """3 s from 10 s on: north at 2 m/s from 5 m east of the fleet's origin, 20 m up."""
    log = Ulog()
    log.parameter("MAV_SYS_ID", 6)
    log.topic("sensor_combined", gyro_rad="float[3]", accelerometer_m_s2="float[3]")
    log.topic("vehicle_attitude", timestamp_sample="uint64_t", q="float[4]")
    place = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), "float") | {"ref_lat": "double", "ref_lon": "double"}
    log.topic("vehicle_local_position", timestamp_sample="uint64_t", **place, ref_alt="float", xy_global="uint8_t")
    log.topic("vehicle_local_position_groundtruth", timestamp_sample="uint64_t", **place, ref_alt="float")
    log.topic("vehicle_attitude_groundtruth", q="float[4]")
    accuracies = dict.fromkeys(("eph", "epv", "s_variance_m_s", "vel_m_s", "vel_d_m_s", "cog_rad"), "float")
    log.topic("vehicle_gps_position", timestamp_sample="uint64_t", time_utc_usec="uint64_t",
              **dict.fromkeys(("latitude_deg", "longitude_deg", "altitude_msl_m", "altitude_ellipsoid_m"), "double"),
              **accuracies, fix_type="uint8_t")  # fmt: skip
    log.topic("timesync_status", remote_timestamp="uint64_t", observed_offset="int64_t")
    for i in range(300):
        us = 10_000_000 + i * 10_000
        north = 2.0 * i * 0.01
        log.add("sensor_combined", us, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8)
        if i % 2 == 0:
            log.add("vehicle_attitude", us, us - 3_000, 1.0, 0.0, 0.0, 0.0)
            reference = (47.0, 8.0, 410.0) if i >= 100 else (0.0, 0.0, 0.0)
            log.add("vehicle_local_position", us, us - 4_000, north, 5.0, -10.0, 2.0, 0.0, 0.0, *reference, i >= 100)
            log.add("vehicle_attitude_groundtruth", us + 2_000, 0.6, 0.0, 0.0, 0.8)
            log.add("vehicle_local_position_groundtruth", us, us, north, 5.0, -20.0, 2.0, 0.0, 0.0, 47.0, 8.0, 400.0)
        if i % 20 == 0:
            lat, lon, _ = FRAME.geodetic((north, 5.0, -20.0))
            utc_us = 1_795_000_000_000_000 + us if utc else 0
            where = (lat, lon, 420.0, 465.0)
            log.add("vehicle_gps_position", us + 50_000, us, utc_us, *where, 0.9, 1.8, 0.4, 2.0, 0.5, 0.0, 3)
        if i % 10 == 0 and timesync:
            log.add("timesync_status", us, 1_795_000_000_000_000 + us, -1_795_000_000_000_000)
    return log.bytes()


FLIGHT = flight()


def test_topics_become_samples_at_their_own_instants(tmp_path: Path) -> None:
    path = tmp_path / "a.ulg.gz"
    path.write_bytes(gzip.compress(FLIGHT))
    source, events = read(path)
    survey = source.survey()
    system = survey.systems[6]
    assert (system.flavour, system.estimate_frame) == ("px4", "fleet")
    assert system.origin is not None
    assert (system.origin.lat_deg, system.origin.alt_msl_m) == (47.0, 410.0)
    used = {"imu": 300, "attitude": 150, "gps": 15, "autopilot estimate": 100, "truth": 150}
    assert source.counts.used == {6: used}
    assert source.counts.skipped == {"autopilot estimate: origin unknown": 50}
    arrivals = [event.arrival_s for event in events]
    assert arrivals == sorted(arrivals)
    first = {type(event.sample): event for event in reversed(events)}
    imu = first[ImuSample].sample
    assert isinstance(imu, ImuSample)
    assert imu.specific_force_mps2 == pytest.approx((1.0, 2.0, -9.8))
    assert imu.gyro_radps == pytest.approx((0.1, 0.2, 0.3))
    assert first[AttitudeSample].sample.t_s == pytest.approx(first[AttitudeSample].arrival_s - 0.003)
    estimate = first[AutopilotEstimate].sample
    assert isinstance(estimate, AutopilotEstimate)
    assert estimate.position_m == pytest.approx((2.0, 5.0, -20.0), abs=1e-3)
    truth = first[TruthSample].sample
    assert isinstance(truth, TruthSample)
    assert truth.position_m == pytest.approx((0.0, 5.0, -20.0), abs=1e-3)
    assert truth.quaternion == pytest.approx((0.6, 0.0, 0.0, 0.8))
    fix = first[GpsSample].sample
    assert isinstance(fix, GpsSample)
    assert fix.t_s == pytest.approx(10.0)
    assert first[GpsSample].arrival_s == pytest.approx(10.05)
    assert fix.position_m == pytest.approx((0.0, 5.0, -20.0), abs=1e-3)
    assert (fix.horizontal_sigma_m, fix.vertical_sigma_m, fix.speed_sigma_mps) == pytest.approx((0.9, 1.8, 0.4))
    assert fix.ground_velocity_mps == pytest.approx((2.0, 0.0))
    assert fix.latency.source == "px4 boot"


@pytest.mark.parametrize(("utc", "timesync", "known_by"), [(True, True, "gps"), (False, True, "host"),
                                                           (False, False, "unknown")])  # fmt: skip
def test_unix_time_by_receiver_or_companion(tmp_path: Path, utc: bool, timesync: bool, known_by: str) -> None:
    path = tmp_path / "a.ulg"
    path.write_bytes(flight(utc=utc, timesync=timesync))
    unix = read(path)[0].survey().unix
    assert unix.known_by == known_by
    if known_by == "host":
        assert unix.at(11.0) == pytest.approx(1_795_000_011.0, abs=1e-3)
    if known_by == "gps":  # the fix of 11.0 s is published, and stamped, 50 ms later
        assert unix.at(11.05) == pytest.approx(1_795_000_011.0, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "field", "pressure"),
    [
        ("vehicle_air_data", "baro_pressure_pa", 95_461.0),
        ("sensor_baro", "pressure", 95_461.0),
        ("sensor_baro", "pressure", 954.61),  # before PX4 1.14
    ],
)
def test_barometers_in_pascals_and_hectopascals(name: str, field: str, pressure: float) -> None:
    stamps = np.arange(1_000_000, 1_500_000, 100_000, dtype=np.int64)
    columns = {field: np.array([pressure, pressure, np.nan, 0.0, pressure]), "timestamp_sample": stamps - 20_000}
    skipped: Counter[str] = Counter()
    taken = list(baro_samples(TopicTable(name, stamps, columns), skipped))
    assert [arrival_s for arrival_s, _ in taken] == pytest.approx([1.0, 1.1, 1.4])
    samples = [sample for _, sample in taken if isinstance(sample, BaroSample)]
    assert [sample.t_s for sample in samples] == pytest.approx([0.98, 1.08, 1.38])
    assert [sample.altitude_m for sample in samples] == pytest.approx([500.0] * 3, abs=0.3)
    assert skipped == {"baro: no pressure of air": 2}


def test_the_barometer_that_the_autopilot_chose_is_listened_to() -> None:
    tables = {name: TopicTable(name, np.zeros(1, np.int64), {}) for name in ("sensor_baro", "vehicle_air_data")}
    assert barometer_table(tables) is tables["vehicle_air_data"]
    assert barometer_table({"sensor_baro": tables["sensor_baro"]}) is tables["sensor_baro"]
    assert barometer_table({}) is None


def odometry_of(folder: Path, layout: dict[str, str], rows: list[list[float]], ours: OwnWords | None = None) -> Any:
    """Velocities that a log with such a topic gives, and what it counted."""
    log = Ulog()
    log.topic("vehicle_visual_odometry", timestamp_sample="uint64_t", **layout)
    log.topic("distance_sensor", **dict.fromkeys(("current_distance", "min_distance", "max_distance"), "float"),
              variance="float", signal_quality="uint8_t", orientation="uint8_t")  # fmt: skip
    for k, row in enumerate(rows):
        log.add("vehicle_visual_odometry", 1_000_000 + 100_000 * k, 990_000 + 100_000 * k, *row)
    told = [(5.0, 100, 25), (5.0, 100, 0), (40.0, 100, 25), (5.0, 0, 25)]
    for k, (distance, quality, orientation) in enumerate(told):
        log.add("distance_sensor", 1_000_000 + 100_000 * k, distance, 0.2, 30.0, 0.01, quality, orientation)
    path = folder / "a.ulg"
    path.write_bytes(log.bytes())
    source = open_log(path, frame=FRAME, sensors=SensorsTable(), ours=ours or OwnWords())
    return [event.sample for event in source.events()], source.counts


def test_a_companions_odometry_is_read_in_the_frames_of_both_layouts(tmp_path: Path) -> None:
    quarter = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    nan = float("nan")
    new = {"velocity": "float[3]", "velocity_variance": "float[3]", "q": "float[4]", "velocity_frame": "uint8_t"}
    old = {"vx": "float", "vy": "float", "vz": "float", "velocity_covariance": "float[21]", "q": "float[4]",
           "velocity_frame": "uint8_t"}  # fmt: skip
    triangle = [0.04 if at in (0, 6, 11) else nan for at in range(21)]
    for layout, variances, frames in ((new, [0.04] * 3, (1, 2, 3, 0)), (old, triangle, (0, 1, 3, 2))):
        rows = [[0.0, 2.0, 0.5, *variances, *quarter, frame] for frame in frames]
        rows.append([nan, nan, nan, *variances, *quarter, frames[0]])
        samples, counts = odometry_of(tmp_path, layout, rows)
        found = [sample for sample in samples if isinstance(sample, VelocitySample)]
        assert [sample.in_body for sample in found] == [False, True, True]
        assert found[0].velocity_mps == pytest.approx((0.0, 2.0, 0.5))
        assert found[1].velocity_mps == pytest.approx((2.0, 0.0, 0.5), abs=1e-6)  # turned back into the body
        assert [sample.t_s for sample in found] == pytest.approx([0.99, 1.09, 1.19])
        assert found[0].sigma_mps == pytest.approx((0.2, 0.2, 0.2))
        assert counts.skipped["odometry: in no frame that is known"] == 1
        assert counts.skipped["odometry: not finite"] == 1
    # what the autopilot was given may be ours
    samples, counts = odometry_of(tmp_path, old, rows, OwnWords(odometry=True))
    assert not [sample for sample in samples if isinstance(sample, VelocitySample)]
    assert counts.skipped["odometry: may be ours"] == 5
    # and the range finder that looks down tells distances in its reach
    ground = [sample for sample in samples if isinstance(sample, GroundSample)]
    assert [(sample.distance_m, sample.sigma_m) for sample in ground] == [(5.0, pytest.approx(0.1))]
    assert counts.skipped["ground: looks elsewhere"] == 1
    assert counts.skipped["ground: out of its reach"] == 2


@given(st.lists(st.integers(0, 10**9), max_size=60))
def test_order_is_restored_by_leaving_out_least(stamps: list[int]) -> None:
    places = in_order(np.array(stamps, np.int64))
    kept = [stamps[place] for place in places.tolist()]
    assert kept == sorted(kept)
    assert sorted(set(places.tolist())) == places.tolist()


def test_single_damaged_stamps_are_left_out() -> None:
    stamps = np.arange(0, 100_000_000, 1_000_000, dtype=np.int64)
    damaged = stamps.copy()
    damaged[[7, 40, 99]] = (2**50, 3, 2**60)
    assert sorted(set(range(100)) - set(in_order(damaged).tolist())) == [7, 40, 99]


def attempt(path: Path, data: bytes) -> Counter[type]:
    path.write_bytes(data)
    try:
        _, events = read(path)
    except LogError as error:
        check_refusal(error, path)
        return Counter()
    arrivals = [event.arrival_s for event in events]
    assert arrivals == sorted(arrivals)
    return Counter(type(event.sample) for event in events)


def whole_imu_messages(length: int) -> int:
    """Data of the first topic that the first ``length`` bytes of the flight hold to their end."""
    found, at = 0, len(MAGIC) + 9
    while at + 3 <= len(FLIGHT):
        size, kind = struct.unpack_from("<HB", FLIGHT, at)
        end = at + 3 + size
        found += kind == ord("D") and FLIGHT[at + 3 : at + 5] == b"\0\0" and end <= length
        at = end
    return found


@IN_ONE_FOLDER
@given(st.integers(0, len(FLIGHT)))
def test_a_log_cut_anywhere_gives_what_is_left(tmp_path: Path, cut: int) -> None:
    assert whole_imu_messages(len(FLIGHT)) == 300
    assert attempt(tmp_path / "x", FLIGHT[:cut])[ImuSample] == whole_imu_messages(cut)


@IN_ONE_FOLDER
@given(st.data())
def test_damaged_bytes_are_one_line_or_a_summary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: st.DataObject
) -> None:
    damaged = bytearray(FLIGHT)
    for place in data.draw(st.sets(st.integers(0, len(FLIGHT) - 1), max_size=len(FLIGHT) // 100)):
        damaged[place] ^= data.draw(st.integers(1, 255))
    attempt(tmp_path / "x", bytes(damaged))
    assert not capsys.readouterr().out


def test_a_reader_that_goes_in_circles_is_stopped(tmp_path: Path) -> None:
    """GIVEN damage over which pyulog goes back for ever THEN the file ends that."""
    with (tmp_path / "x").open("w+b") as file:
        file.write(bytes(1000))
        guarded = Unpacked(file)

        def circle() -> None:
            while True:
                guarded.read(3)
                guarded.seek(0)

        with pytest.raises(OSError, match="back and back"):
            circle()


def test_without_the_package_the_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ulg"
    path.write_bytes(FLIGHT)
    genuine = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.partition(".")[0] == "pyulog":
            raise ImportError(name)
        return genuine(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(LogError, match=r"pip install 'fleetloc\[ulog\]'"):
        read(path)


@pytest.mark.parametrize(
    ("topic", "layout"),
    [
        (
            "vehicle_optical_flow",
            {"timestamp_sample": "uint64_t", "pixel_flow": "float[2]", "delta_angle": "float[3]",
             "distance_m": "float", "integration_timespan_us": "uint64_t", "quality": "uint8_t"},
        ),
        (
            "optical_flow",
            {"pixel_flow_x_integral": "float", "pixel_flow_y_integral": "float", "gyro_x_rate_integral": "float",
             "gyro_y_rate_integral": "float", "gyro_z_rate_integral": "float", "ground_distance_m": "float",
             "integration_timespan": "uint64_t", "quality": "uint8_t"},
        ),
    ],
)  # fmt: skip
def test_flow_is_read_in_both_layouts(tmp_path: Path, topic: str, layout: dict[str, str]) -> None:
    # GIVEN 0.05 s of a drone that moves forward and to the left, and turns; one of no quality, one of no duration
    log, nan = Ulog(), float("nan")
    log.topic(topic, **layout)
    for k, (quality, duration_us, distance_m) in enumerate(
        [(255, 50_000, 2.0), (255, 50_000, nan), (0, 50_000, 2.0), (99, 0, 2.0)]
    ):
        told = [] if "timestamp_sample" not in layout else [1_000_000 + 100_000 * k]
        log.add(topic, 1_000_000 + 100_000 * k, *told, 0.04, 0.06, 0.01, 0.02, 0.3, distance_m, duration_us, quality)
    path = tmp_path / "a.ulg"
    path.write_bytes(log.bytes())
    source = open_log(path, frame=FRAME, sensors=SensorsTable(), ours=OwnWords(odometry=True))
    found = [event.sample for event in source.events()]
    near, far = found
    assert isinstance(near, FlowSample)
    assert isinstance(far, FlowSample)
    # THEN it is told as over the ground, in the middle of what was integrated
    assert near.passing_radps == pytest.approx((0.8, -0.6))
    assert (near.distance_m, far.distance_m) == (2.0, None)
    assert near.t_s == pytest.approx(0.975)
    assert source.counts.skipped["flow: no quality"] == 1
    assert source.counts.skipped["flow: integrated over no time"] == 1
