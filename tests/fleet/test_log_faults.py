"""Faults that public logs show, each in a small log of its own: what becomes of it in a replay, and in a daemon.

Bands are of the figures found, with room on both sides for other rounding; without the fault they are the same.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.tables import FleetConfig
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample
from fleetloc.report.replay_tables import cautions
from fleetloc.run.replay_setup import NO_PLACE
from sim_bridge.replay.logs.events import LogError
from tests.agent.conftest import fleet_config
from tests.support.log_faults import FAULTY, counted, flown, replayed
from tests.support.logs import read

IMU, ATTITUDE, GPS = 400, 400, 100
"""Samples of a tlog of 20 s."""


def used(figures: dict[str, Any], agent: int = 0) -> tuple[int, ...]:
    """Samples of IMU, attitude and GPS that an agent used."""
    sensors = figures["agents"][agent]["sensors"]
    return tuple(sensors[kind]["used"] for kind in ("imu", "attitude", "gps"))


def assert_counts_close(figures: dict[str, Any]) -> None:
    """Each sample is counted once: used, skipped for a reason, or late; and what the log gave is what came."""
    for agent in figures["agents"]:
        for sensor in agent["sensors"].values():
            assert sensor["skipped"] == sum(sensor["skipped_by_reason"].values())
            assert sensor["received"] == sensor["used"] + sensor["skipped"] + sensor["late"]
        given = next(log for log in figures["logs"] if log["file"] == agent["log"])["used"][str(agent["system_id"])]
        for kind in ("imu", "attitude", "gps"):
            assert agent["sensors"][kind]["received"] == given.get(kind, 0)


def assert_flown_well(figures: dict[str, Any], agent: int = 0, rmse_m: tuple[float, float] = (0.15, 0.45)) -> None:
    """The whole flight was estimated, and neither badly nor suspiciously well."""
    assert_counts_close(figures)
    found = figures["agents"][agent]
    assert found["ticks_without_estimate"] <= 25
    assert rmse_m[0] <= found["position_rmse_m"] <= rmse_m[1]
    assert 0.02 <= found["anees"] <= 1.5
    assert found["ticks_alarm"] == 0


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """A fleet of two about a place of the configuration."""
    path = tmp_path / "pair.toml"
    path.write_text(
        '[fleet]\nname = "pair"\norigin = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 500.0 }\n'
        '[initial]\nfixes = 3\n[security]\nmode = "unsigned"\n'
        '[[agents]]\nid = 1\nmavlink = "udpin:127.0.0.1:14551"\n'
        '[[agents]]\nid = 2\nmavlink = "udpin:127.0.0.1:14552"\n'
    )
    return path


@pytest.fixture
def config() -> FleetConfig:
    return fleet_config(1, "sensors.gps_speed=horizontal")


@pytest.mark.parametrize(
    "name",
    ["gimbal_heartbeat", "payload_first", "gps2_only", "scaled_imu_only", "wrap_71min", "named_value_boot_0"],
)
def test_a_fault_that_cost_the_flight_costs_no_sample(tmp_path: Path, name: str) -> None:
    figures = replayed(tmp_path, f"{name}.tlog")
    assert used(figures) == (IMU, ATTITUDE, GPS)
    assert_flown_well(figures)


def test_gimbal_with_the_autopilots_heartbeat_is_no_vehicle_in_a_replay(tmp_path: Path) -> None:
    (log,) = replayed(tmp_path, "gimbal_heartbeat.tlog")["logs"]
    assert list(log["systems"]) == ["1"]
    assert log["skipped"] == {"from no autopilot": 40}


def test_gimbal_with_the_autopilots_heartbeat_is_no_vehicle_live(config: FleetConfig) -> None:
    session, samples = flown(config, "gimbal_heartbeat.tlog")
    assert session.autopilot is not None
    assert session.autopilot.component_id == 1
    assert sum(isinstance(sample, ImuSample) for sample in samples) > 350


def test_payload_that_is_heard_before_the_autopilot_is_given_up_for_it(config: FleetConfig) -> None:
    session, samples = flown(config, "payload_first.tlog")
    assert session.autopilot is not None
    assert (session.autopilot.component_id, session.autopilot.flavour) == (1, "ardupilot")
    assert session.handovers == 1
    assert sum(isinstance(sample, ImuSample) for sample in samples) > 350
    assert sum(isinstance(sample, GpsSample) for sample in samples) > 85


def test_named_value_with_a_boot_time_of_zero_is_no_reboot(config: FleetConfig) -> None:
    session, samples = flown(config, "named_value_boot_0.tlog")
    assert session.reboots == 0
    assert sum(isinstance(sample, AttitudeSample) for sample in samples) > 350


def test_fixes_of_the_second_receiver_serve_while_the_first_has_none(tmp_path: Path, config: FleetConfig) -> None:
    (log,) = replayed(tmp_path, "gps2_only.tlog")["logs"]
    assert log["skipped"] == {"gps: no fix": GPS}
    session, samples = flown(config, "gps2_only.tlog")
    assert sum(isinstance(sample, GpsSample) for sample in samples) > 85
    assert session.samples.skipped["gps: no fix"] > 85


def test_scaled_imu_serves_live_where_no_better_one_comes(config: FleetConfig) -> None:
    _, samples = flown(config, "scaled_imu_only.tlog")
    forces = [sample.specific_force_mps2[2] for sample in samples if isinstance(sample, ImuSample)]
    assert len(forces) > 350
    assert sum(forces) / len(forces) == pytest.approx(-9.8, abs=0.5)


def test_raw_imu_whose_time_wraps_goes_on_live(config: FleetConfig) -> None:
    session, samples = flown(config, "wrap_71min.tlog")
    times = [sample.t_s for sample in samples if isinstance(sample, ImuSample)]
    assert len(times) > 350
    assert max(b - a for a, b in pairwise(times)) < 0.2
    assert session.samples.skipped["imu: wrong time"] == 0


def test_fixes_with_utc_of_another_clock_than_the_recorders_are_shifted(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "utc_fixes_recorder_1s_behind.tlog")
    assert used(figures) == (IMU, ATTITUDE, GPS)
    assert_flown_well(figures)
    (log,) = figures["logs"]
    assert log["notes"]["fixes placed by arrival, as their UTC and our clock differ"] == GPS
    assert log["unix_time_known_by"] == "gps"


@pytest.mark.parametrize("behind_s", [1.0, -7.0, 3e7, -1.7e9])
def test_fixes_with_utc_of_another_clock_than_the_companions_are_shifted(
    config: FleetConfig, behind_s: float
) -> None:
    """GIVEN a companion that is behind or ahead, or was never set THEN its fixes are where the IMU's samples are."""
    _, samples = flown(config, "utc_fixes_recorder_1s_behind.tlog", from_s=2e9 - behind_s)
    fixes = [sample for sample in samples if isinstance(sample, GpsSample)]
    assert len(fixes) > 85
    imu_s = [sample.t_s for sample in samples if isinstance(sample, ImuSample)]
    assert imu_s[0] - 1.0 < fixes[0].t_s < imu_s[0] + 1.0
    assert abs(fixes[-1].t_s - imu_s[-1]) < 0.5


def test_simulator_at_a_third_of_real_time_is_replayed_on_its_own_clock(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "sim_at_0.3.tlog")
    assert used(figures) == (IMU, ATTITUDE, GPS)
    assert_flown_well(figures)
    (log,) = figures["logs"]
    assert log["duration_s"] == pytest.approx(20.0, abs=0.3)
    assert log["notes"]["simulator at 0.30 of real time: its clock is the log's"] == 1


def test_frames_without_stamps_are_refused_by_name(tmp_path: Path) -> None:
    expected = re.escape(
        f"{FAULTY / 'no_stamps.tlog.raw.gz'}: expected frames with time stamps (the .tlog beside it)"
    )
    with pytest.raises(LogError, match=expected):
        replayed(tmp_path, "no_stamps.tlog.raw")


# --- dataflash -------------------------------------------------------------------------------------------------

BIN = (750, 375, 75)
"""Samples of a dataflash log of 15 s; its autopilot's estimate is the truth."""


def assert_near_its_autopilot(figures: dict[str, Any], agent: int = 0) -> None:
    assert_counts_close(figures)
    found = figures["agents"][agent]
    assert found["ticks_without_estimate"] <= 25
    assert 0.1 <= found["to_autopilot_horizontal_rms_m"] <= 0.4
    assert found["ticks_alarm"] <= 1


@pytest.mark.parametrize("name", ["gps_instance1_only", "fix_time_equals_record_time"])
def test_a_fault_that_cost_fixes_of_a_dataflash_log_costs_none(tmp_path: Path, name: str) -> None:
    figures = replayed(tmp_path, f"{name}.BIN")
    assert used(figures) == BIN
    assert not figures["logs"][0]["skipped"]
    assert figures["logs"][0]["unix_time_known_by"] == "gps"
    assert_near_its_autopilot(figures)


def test_receiver_whose_weeks_have_rolled_over_is_laid_beside_the_others(tmp_path: Path, pair: Path) -> None:
    figures = replayed(tmp_path / "out", "rollover_a.BIN", "rollover_b.BIN", config=pair)
    for agent in (0, 1):
        assert used(figures, agent) == BIN
        assert_near_its_autopilot(figures, agent)
    starts_s = [agent["first_estimate_s"] for agent in figures["agents"]]
    assert starts_s[1] - starts_s[0] == pytest.approx(2.0, abs=0.15)  # its log begins so much later


def test_leap_seconds_are_those_of_the_date_of_the_flight(tmp_path: Path, pair: Path) -> None:
    figures = replayed(tmp_path / "out", "leap_2016.tlog", "leap_2016.BIN", config=pair)
    by_host, by_gps = (agent["phases"]["all"]["from_s"] for agent in figures["agents"])
    assert abs(by_host - by_gps) < 0.15
    assert used(figures, 0) == (IMU, ATTITUDE, GPS)
    assert used(figures, 1) == BIN


# --- ulog ------------------------------------------------------------------------------------------------------


def test_receiver_without_fixes_before_one_that_has_some_in_a_px4_log(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "gps_instance0_dead.ulg")
    assert used(figures) == (1000, 500, 100)
    assert figures["logs"][0]["skipped"] == {"gps: no fix": 100}
    assert_flown_well(figures)


def test_accelerometer_bias_that_px4_knows_is_taken_off(tmp_path: Path) -> None:
    """GIVEN 0.075 m/s2 on the second axis THEN samples are without it from the first time that PX4 tells it."""
    assert_flown_well(replayed(tmp_path, "accel_bias.ulg"), rmse_m=(0.2, 0.6))
    _, biased = read(FAULTY / "accel_bias.ulg.gz")
    _, other = read(FAULTY / "px4_speed_is_norm.ulg.gz")
    sideways = [
        float(
            np.mean([event.sample.specific_force_mps2[1] for event in events if isinstance(event.sample, ImuSample)])
        )
        for events in (biased, other)
    ]
    assert sideways[0] == pytest.approx(sideways[1], abs=0.01)


def test_speed_that_is_a_norm_gives_way_to_the_velocity_of_a_px4_log(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "px4_speed_is_norm.ulg")
    assert used(figures) == (1250, 625, 125)
    assert_flown_well(figures, rmse_m=(0.2, 0.6))


# --- places ----------------------------------------------------------------------------------------------------


def test_vehicle_below_the_sea_is_replayed(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "below_minus_500.tlog")
    assert used(figures) == (IMU, ATTITUDE, GPS)
    assert_flown_well(figures)


def test_log_without_any_place_says_so(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "no_fix_no_origin.tlog")
    assert used(figures) == (IMU, ATTITUDE, 0)
    assert figures["origin"] == NO_PLACE
    assert "no log tells a place: there is no origin, no home and no fix in them" in cautions(figures)


# --- what is wrong in the air ----------------------------------------------------------------------------------


def test_fixes_later_than_the_window_are_counted_and_the_remedy_told(tmp_path: Path) -> None:
    figures = replayed(tmp_path / "logged", "late_fixes.tlog")
    assert_counts_close(figures)
    gps = figures["agents"][0]["sensors"]["gps"]
    assert (gps["received"], gps["skipped"]) == (150, 0)
    assert 60 <= gps["late"] <= 130
    (sentence,) = (each for each in cautions(figures) if "later than the window" in each)
    assert sentence.startswith(f"{gps['late']} of 150 fixes of drone 1")
    assert "--arrival stamped" in sentence
    stamped = replayed(tmp_path / "stamped", "late_fixes.tlog", arrival="stamped")
    assert stamped["agents"][0]["sensors"]["gps"]["late"] == 0
    assert stamped["agents"][0]["position_rmse_m"] < figures["agents"][0]["position_rmse_m"]


def test_speed_that_may_be_a_norm_on_the_link_is_not_taken_for_a_motion_over_ground(tmp_path: Path) -> None:
    """GIVEN a climb of 1.5 m/s, 0.25 m/s over ground, and a speed of 1.5 m/s along the course."""
    figures = replayed(tmp_path, "px4_speed_is_norm.tlog")
    assert used(figures) == (600, 600, 150)
    assert_flown_well(figures, rmse_m=(0.3, 0.9))


def test_fixes_100_m_off_for_seconds_are_held_back_and_an_alarm_is_raised(tmp_path: Path) -> None:
    figures = replayed(tmp_path, "gps_glitch.tlog")
    assert_counts_close(figures)
    (agent,) = figures["agents"]
    assert 0.15 <= agent["position_rmse_m"] <= 0.6
    assert 0.02 <= agent["anees"] <= 1.5
    assert 30 <= agent["ticks_alarm"] <= 120
    assert agent["position_p95_m"] < 1.5


def test_ranges_that_say_none_with_a_number_move_nobody(tmp_path: Path, pair: Path) -> None:
    """GIVEN every twentieth range at the 65.535 m that 16-bit modules have for none."""
    good, wrong = (
        replayed(tmp_path / name, "ranges_a.tlog", "ranges_b.tlog", config=pair, ranges=f"{name}.csv.gz")
        for name in ("ranges_good", "ranges_sentinel_65535")
    )
    for figures in (good, wrong):
        assert_counts_close(figures)
        assert figures["fleet"]["ranges"]["delivered"] == 560
    for before, found in zip(good["agents"], wrong["agents"], strict=True):
        assert found["sensors"]["range"]["received"] == 280
        assert 0.1 <= found["position_rmse_m"] <= 1.3 * before["position_rmse_m"]
        assert 0.02 <= found["anees"] <= 1.5


@pytest.mark.parametrize(
    ("name", "messages"),
    [
        ("gps2_only.tlog", (400, 400, 200)),
        ("scaled_imu_only.tlog", (400, 400, 100)),
        ("utc_fixes_recorder_1s_behind.tlog", (400, 400, 100)),
        ("late_fixes.tlog", (600, 600, 150)),
        ("sim_at_0.3.tlog", (400, 400, 100)),
        ("gps_glitch.tlog", (800, 800, 200)),
    ],
)
def test_a_daemon_counts_each_message_of_its_sensors_once(
    config: FleetConfig, name: str, messages: tuple[int, int, int]
) -> None:
    sensors = counted(config, name)
    for kind, sent in zip(("imu", "attitude", "gps"), messages, strict=True):
        found = sensors[kind]
        assert found["received"] == found["used"] + found["skipped"] + found["late"]
        assert 0.9 * sent <= found["received"] <= sent  # those before the first heartbeat are of nobody known
