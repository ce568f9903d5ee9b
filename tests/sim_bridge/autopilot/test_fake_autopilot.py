"""The fake autopilots on their link, in virtual time: streams, answers, reboot, loss of GPS and of the link."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.world.scenario import Interval, Reboot, Vehicle
from tests.support.hovering import ARDUPILOT, HOVER, PX4

BOTH = pytest.mark.parametrize("vehicle", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])


@BOTH
def test_heartbeats_come_every_second_from_the_autopilot_component(connect, vehicle):
    client = connect(vehicle)
    client.run_to(10.5)
    heartbeats = client.received["HEARTBEAT"]
    assert len(heartbeats) == 11
    expected = {"px4": mavlink.MAV_AUTOPILOT_PX4, "ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA}
    for heartbeat in heartbeats:
        assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (7, 1)
        assert heartbeat.autopilot == expected[vehicle.flavour]
        assert heartbeat.type == mavlink.MAV_TYPE_QUADROTOR
        assert heartbeat.base_mode == mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def test_px4_streams_by_itself_and_ardupilot_only_when_asked(connect):
    px4, ardupilot = connect(PX4), connect(ARDUPILOT)
    px4.run_to(5.0)
    ardupilot.run_to(5.0)
    assert {"HIGHRES_IMU", "ATTITUDE_QUATERNION", "GPS_RAW_INT", "LOCAL_POSITION_NED", "ODOMETRY"} <= set(
        px4.received
    )
    assert set(ardupilot.received) == {"HEARTBEAT", "TIMESYNC"}


@pytest.mark.parametrize(
    ("vehicle", "message_id", "kind", "rate_hz"),
    [
        (PX4, 105, "HIGHRES_IMU", 100.0),
        (PX4, 105, "HIGHRES_IMU", 80.0),
        (PX4, 31, "ATTITUDE_QUATERNION", 25.0),
        (PX4, 24, "GPS_RAW_INT", 10.0),
        (PX4, 24, "GPS_RAW_INT", 5.0),
        (PX4, 32, "LOCAL_POSITION_NED", 2.0),
        (ARDUPILOT, 27, "RAW_IMU", 50.0),
        (ARDUPILOT, 31, "ATTITUDE_QUATERNION", 50.0),
        (ARDUPILOT, 24, "GPS_RAW_INT", 4.0),
        (ARDUPILOT, 2, "SYSTEM_TIME", 1.0),
    ],
)
def test_the_rate_obtained_is_the_rate_requested(connect, vehicle, message_id, kind, rate_hz):
    client = connect(vehicle)
    client.run_to(1.0)
    assert client.set_rate(message_id, rate_hz) == mavlink.MAV_RESULT_ACCEPTED
    client.run_to(11.5)
    assert len(client.between(kind, 1.5, 11.5)) == pytest.approx(10 * rate_hz, rel=0.03, abs=1)


def test_no_stream_is_faster_than_its_sensor(connect):
    client = connect(PX4, imu_hz=50.0)
    assert client.set_rate(105, 200.0) == mavlink.MAV_RESULT_ACCEPTED
    client.run_to(4.0)
    assert len(client.received["HIGHRES_IMU"]) == pytest.approx(200, abs=2)
    # the autopilot says what it really does
    assert client.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 105) == mavlink.MAV_RESULT_ACCEPTED
    assert client.received["MESSAGE_INTERVAL"][-1].interval_us == 20_000


def test_ardupilot_intervals_are_whole_milliseconds(connect):
    client = connect(ARDUPILOT, imu_hz=200.0)
    assert client.command(511, 27, 15_400.0) == mavlink.MAV_RESULT_ACCEPTED
    client.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 27)
    assert client.received["MESSAGE_INTERVAL"][-1].interval_us == 15_000


def test_streams_stop_and_return_to_their_default(connect):
    client = connect(PX4)
    assert client.command(511, 105, -1.0) == mavlink.MAV_RESULT_ACCEPTED
    client.run_to(2.0)
    assert not client.received["HIGHRES_IMU"]
    assert client.command(511, 105, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    client.run_to(4.0)
    assert len(client.received["HIGHRES_IMU"]) == pytest.approx(100, abs=1)


def test_each_flavour_refuses_foreign_streams_its_own_way(connect):
    assert connect(PX4).set_rate(mavlink.MAVLINK_MSG_ID_RAW_IMU, 50.0) == mavlink.MAV_RESULT_FAILED
    assert connect(ARDUPILOT).set_rate(mavlink.MAVLINK_MSG_ID_ODOMETRY, 10.0) == mavlink.MAV_RESULT_DENIED
    assert connect(ARDUPILOT).set_rate(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 10.0) == mavlink.MAV_RESULT_DENIED


@BOTH
def test_stamps_are_boot_times_of_the_samples(connect, vehicle):
    # GIVEN a simulation that begins at some large monotonic time
    client = connect(vehicle, start_s=86_400.25)
    kind = "HIGHRES_IMU" if vehicle is PX4 else "RAW_IMU"
    client.set_rate(105 if vehicle is PX4 else 27, 50.0)
    client.set_rate(31, 50.0)
    client.set_rate(24, 10.0)
    client.run_to(3.0)
    for message, now in zip(client.received[kind], client.arrivals[kind], strict=True):
        assert message.time_usec == pytest.approx(1e6 * (now - 86_400.25), abs=1.0)
    for message, now in zip(
        client.received["ATTITUDE_QUATERNION"], client.arrivals["ATTITUDE_QUATERNION"], strict=True
    ):
        assert message.time_boot_ms == pytest.approx(1e3 * (now - 86_400.25), abs=1.0)
    assert [fix.time_usec for fix in client.received["GPS_RAW_INT"]] == [100_000 * k for k in range(1, 31)]


@BOTH
def test_the_imu_at_hover_reads_minus_g_on_the_wire(connect, vehicle):
    client = connect(vehicle)
    client.set_rate(105 if vehicle is PX4 else 27, 100.0)
    client.run_to(10.0)
    if vehicle is PX4:
        accel = np.array([(m.xacc, m.yacc, m.zacc) for m in client.received["HIGHRES_IMU"]])
    else:
        accel = 9.80665e-3 * np.array([(m.xacc, m.yacc, m.zacc) for m in client.received["RAW_IMU"]])
    gravity = client.simulation.scenario.gravity
    assert gravity == pytest.approx(9.807, abs=0.01)
    np.testing.assert_allclose(accel.mean(axis=0), (0.0, 0.0, -gravity), atol=0.03)
    assert np.abs(accel - (0.0, 0.0, -gravity)).max() <= 0.1 + 0.006


def test_gravity_removed_by_the_attitude_gives_the_true_acceleration(connect):
    # GIVEN a PX4 that flies from a random start
    client = connect(Vehicle(1, "px4", 1), seed=3)
    client.set_rate(105, 100.0)
    client.command(511, 31, 10_000.0)
    world = client.simulation.world
    errors = []
    for step in range(1, 400):
        client.run_to(0.01 * step - 0.005)  # the samples' own step
        imu, attitude = client.received["HIGHRES_IMU"][-1], client.received["ATTITUDE_QUATERNION"][-1]
        if imu.time_usec // 1000 != attitude.time_boot_ms:
            continue
        w, x, y, z = attitude.q1, attitude.q2, attitude.q3, attitude.q4
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        ned = turn @ (imu.xacc, imu.yacc, imu.zacc) + (0.0, 0.0, client.simulation.scenario.gravity)
        errors.append(ned - world.accel_mps2[0])
    assert len(errors) > 150
    # THEN what is left is the paper's noise
    assert np.abs(errors).max() <= 0.1 + 1e-5


@BOTH
def test_timesync_is_answered_with_the_boot_clock(connect, vehicle):
    client = connect(vehicle)
    client.run_to(2.0)
    client.send(mavlink.MAVLink_timesync_message(0, 1234), now=client.simulation.start_s + 2.25)
    answer = client.received["TIMESYNC"][-1]
    assert (answer.tc1, answer.ts1) == (2_250_000_000, 1234)


def test_px4_asks_for_the_time_ten_times_a_second_and_counts_answers(connect):
    client = connect(PX4)
    client.run_to(5.0)
    requests = client.received["TIMESYNC"]
    assert len(requests) == pytest.approx(50, abs=1)
    assert all(request.tc1 == 0 for request in requests)
    assert len({request.ts1 for request in requests}) == len(requests)
    client.send(mavlink.MAVLink_timesync_message(99, requests[-1].ts1))
    assert client.simulation.autopilots[1].counters.timesync_replies == 1


def test_a_skewed_crystal_runs_away(connect):
    client = connect(Vehicle(1, "px4", 1, clock_skew_ppm=1000.0, **HOVER))
    client.run_to(10.0)
    assert client.received["HIGHRES_IMU"][-1].time_usec == pytest.approx(
        1001e3 * (client.arrivals["HIGHRES_IMU"][-1] - 1000.0), abs=1.0
    )


def test_unix_time_is_known_from_the_first_fix_on(connect):
    client = connect(PX4, unix_offset_s=1.7e9, gps_outages=(Interval(1, 0.0, 3.0),))
    client.run_to(6.0)
    times = client.received["SYSTEM_TIME"]
    assert times[0].time_unix_usec == 0
    assert times[-1].time_unix_usec == pytest.approx(1e6 * (1.7e9 + client.arrivals["SYSTEM_TIME"][-1]), abs=2)


def test_without_positions_the_attitude_is_tilted_until_they_come_back(connect):
    # GIVEN an autopilot that hovers level and loses its receiver for six seconds
    client = connect(PX4, gps_outages=(Interval(1, 3.0, 9.0),))
    client.run_to(16.0)

    def tilts(from_s, to_s):
        for sent in client.between("ATTITUDE_QUATERNION", from_s, to_s):
            yield np.degrees(2.0 * np.arcsin(np.hypot(sent.q2, sent.q3)))

    # THEN its attitude is tilted as PX4's was measured to be, within a second of the word that it is not aided
    level, leaning, upright = (list(tilts(*while_)) for while_ in ((1.0, 3.5), (6.0, 8.9), (14.0, 16.0)))
    assert min(len(level), len(leaning), len(upright)) > 20
    assert max(level) < 0.1
    assert max(upright) < 0.1
    assert all(1.9 < tilt < 2.6 for tilt in leaning)


def test_px4_reports_a_lost_receiver_after_a_second_of_silence(connect):
    client = connect(PX4, gps_outages=(Interval(1, 3.0, 6.0),))
    client.set_rate(24, 10.0)
    client.run_to(8.0)
    assert all(fix.fix_type == 3 for fix in client.between("GPS_RAW_INT", 0.5, 2.95))
    assert client.between("GPS_RAW_INT", 3.0, 3.85) == []
    lost = client.between("GPS_RAW_INT", 3.9, 5.99)
    assert len(lost) == pytest.approx(20, abs=2)
    assert {(fix.fix_type, fix.eph, fix.vel, fix.satellites_visible) for fix in lost} == {(0, 65535, 65535, 255)}
    assert all(fix.fix_type == 3 for fix in client.between("GPS_RAW_INT", 6.05, 8.0))


def test_ardupilot_says_no_fix_at_once(connect):
    client = connect(ARDUPILOT, gps_outages=(Interval(1, 3.0, 4.0),))
    client.set_rate(24, 10.0)
    client.run_to(5.0)
    assert {fix.fix_type for fix in client.between("GPS_RAW_INT", 3.0, 3.99)} == {1}


@BOTH
def test_a_reboot_resets_the_clock_the_rates_and_the_sequence(connect, vehicle):
    # GIVEN an autopilot with a rate of ours, rebooting at 5 s for a second
    client = connect(vehicle, reboots=(Reboot(1, 5.0),))
    client.set_rate(2, 10.0)
    client.set_rate(31, 10.0)
    client.run_to(9.0)
    # THEN it is silent meanwhile
    assert not any(client.between(kind, 5.01, 5.99) for kind in client.received)
    # AND its boot clock begins again
    assert client.between("ATTITUDE_QUATERNION", 0, 5)[-1].time_boot_ms > 4500
    first_after = client.between("HEARTBEAT", 6.0, 9.0)[0]
    assert first_after.get_seq() < 3
    if vehicle is PX4:
        assert client.between("ATTITUDE_QUATERNION", 6, 9)[0].time_boot_ms < 50
        assert len(client.between("ATTITUDE_QUATERNION", 7, 8)) == pytest.approx(50, abs=1)
    else:
        assert client.between("ATTITUDE_QUATERNION", 6, 9) == []
    # AND it answers again, a request while it is down staying without answer
    assert client.command(512, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == mavlink.MAV_RESULT_ACCEPTED


def test_a_reboot_command_while_down_is_not_answered(connect):
    client = connect(PX4, reboots=(Reboot(1, 1.0, 2.0),))
    client.run_to(2.0)
    client.send(mavlink.MAVLink_command_long_message(7, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0))
    assert client.received["COMMAND_ACK"] == []


def test_a_silenced_link_loses_everything_both_ways(connect):
    client = connect(PX4, silences=(Interval(1, 2.0, 6.0),))
    client.run_to(4.0)
    client.send(mavlink.MAVLink_command_long_message(7, 1, 511, 0, 105, 1e5, 0, 0, 0, 0, 0))
    assert client.received["COMMAND_ACK"] == []
    client.run_to(8.0)
    assert not any(client.between(kind, 2.0, 5.99) for kind in client.received)
    assert client.between("HEARTBEAT", 6.0, 8.0)
    assert client.simulation.dropped[1] > 100


@BOTH
def test_position_is_relative_to_the_autopilots_own_origin_and_not_the_truth(connect, vehicle):
    client = connect(vehicle)
    client.set_rate(32, 10.0)
    client.set_rate(33, 10.0)
    client.run_to(10.0)
    local = client.received["LOCAL_POSITION_NED"][-1]
    # it hovers where its first fix was, which the noise put up to 0.15 m off
    assert np.abs((local.x, local.y, local.z)).max() < 0.6
    assert client.command(512, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) == mavlink.MAV_RESULT_ACCEPTED
    origin = client.received["GPS_GLOBAL_ORIGIN"][-1]
    frame = client.simulation.scenario.frame
    place = np.array(frame.ned(origin.latitude * 1e-7, origin.longitude * 1e-7, origin.altitude * 1e-3))
    np.testing.assert_allclose(place, (5.0, 0.0, 5.0), atol=0.17)
    whole = client.received["GLOBAL_POSITION_INT"][-1]
    seen = np.array(frame.ned(whole.lat * 1e-7, whole.lon * 1e-7, whole.alt * 1e-3))
    np.testing.assert_allclose(seen, np.add(place, (local.x, local.y, local.z)), atol=0.03)
    assert not np.array_equal(seen, client.simulation.world.position_m[0])


def test_without_position_px4_is_silent_and_ardupilot_sends_zeros(connect):
    for vehicle, expected in ((PX4, set()), (ARDUPILOT, {(0, 0)})):
        client = connect(vehicle, gps_outages=(Interval(1, 0.0, 100.0),))
        client.set_rate(33, 5.0)
        client.set_rate(32, 5.0)
        client.run_to(3.0)
        assert client.received["LOCAL_POSITION_NED"] == []
        assert {(m.lat, m.lon) for m in client.received["GLOBAL_POSITION_INT"]} == expected
        assert client.command(512, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) not in (0, 3)
        # an origin from outside is taken once
        origin = mavlink.MAVLink_set_gps_global_origin_message(7, 473977420, 85455940, 489400)
        client.send(origin)
        assert client.received["GPS_GLOBAL_ORIGIN"][-1].altitude == pytest.approx(489_400, abs=2)
        client.send(origin)
        assert len(client.received["GPS_GLOBAL_ORIGIN"]) == 1


def test_whole_milliseconds_and_unknown_gps_time(connect):
    client = connect(Vehicle(1, "px4", 1, stamp_quantum_us=1000, gps_time_unknown=True, clock_skew_ppm=37.0, **HOVER))
    client.run_to(3.0)
    assert all(message.time_usec % 1000 == 0 for message in client.received["HIGHRES_IMU"])
    assert {fix.time_usec for fix in client.received["GPS_RAW_INT"]} == {0}
