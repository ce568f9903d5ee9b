"""Commands: all answered, and the vehicle does what was accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.autopilot.flavours import px4_mode
from sim_bridge.world.scenario import Interval, Vehicle
from tests.support.hovering import ARDUPILOT, HOVER, PX4

ON_GROUND = {"start_m": (1.0, 2.0, 0.0), "on_ground": True}
BOTH = pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
OK, DENIED, UNSUPPORTED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED
REFUSED_NOW = {"px4": mavlink.MAV_RESULT_TEMPORARILY_REJECTED, "ardupilot": mavlink.MAV_RESULT_FAILED}


@BOTH
def test_unknown_commands_and_messages_are_unsupported(connect, flavour):
    client = connect(Vehicle(1, flavour, 7, **HOVER))
    assert client.command(mavlink.MAV_CMD_DO_SET_RELAY, 1, 1) == UNSUPPORTED
    assert client.command(60_000) == UNSUPPORTED
    assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 12_345) == UNSUPPORTED
    assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, math.nan) == UNSUPPORTED


@BOTH
def test_the_version_is_served_on_request(connect, flavour):
    client = connect(Vehicle(1, flavour, 7, **HOVER))
    assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148) == OK
    (version,) = client.received["AUTOPILOT_VERSION"]
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2


@BOTH
def test_the_older_requests_for_version_and_home_are_ardupilots_alone(connect, flavour):
    client = connect(Vehicle(1, flavour, 7, **HOVER))
    client.run_to(0.5)
    expected = OK if flavour == "ardupilot" else UNSUPPORTED
    assert client.command(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1) == expected
    assert client.command(mavlink.MAV_CMD_GET_HOME_POSITION) == expected
    assert len(client.received["AUTOPILOT_VERSION"]) == (expected == OK)


@BOTH
def test_streamed_messages_can_be_had_once(connect, flavour):
    client = connect(Vehicle(1, flavour, 7, **HOVER))
    client.run_to(0.5)
    before = len(client.received["GPS_RAW_INT"])
    assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT) == OK
    assert len(client.received["GPS_RAW_INT"]) == before + 1
    assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION) == OK


@BOTH
def test_what_is_not_known_yet_is_refused_for_now(connect, flavour):
    client = connect(Vehicle(1, flavour, 7, **HOVER), gps_outages=(Interval(1, 0.0, 9.0),))
    client.run_to(0.5)
    for message_id in (mavlink.MAVLINK_MSG_ID_HOME_POSITION, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN):
        assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id) == REFUSED_NOW[flavour]


@BOTH
def test_arm_take_off_go_and_land(connect, flavour):
    # GIVEN a vehicle on the ground, with GPS
    client = connect(Vehicle(1, flavour, 7, **ON_GROUND))
    world, frame = client.simulation.world, client.simulation.scenario.frame
    take_off = (mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, math.nan, math.nan)
    height = 3.0 if flavour == "ardupilot" else frame.alt_m + 3.0
    # WHEN it is told to take off or arm too early THEN it refuses
    assert client.command(*take_off, height) == REFUSED_NOW[flavour]
    assert client.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == REFUSED_NOW[flavour]
    client.run_to(2.0)
    assert not client.received["HEARTBEAT"][-1].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert client.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == OK
    if flavour == "ardupilot":
        assert client.command(*take_off, height) == REFUSED_NOW[flavour]
        assert client.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 4, 0) == OK
    # WHEN it takes off THEN it climbs
    assert client.command(*take_off, height) == OK
    client.run_to(12.0)
    assert client.received["HEARTBEAT"][-1].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    np.testing.assert_allclose(world.position_m[0], (1.0, 2.0, -3.0), atol=0.3)
    assert client.command(*take_off, height) == REFUSED_NOW[flavour]
    assert client.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == REFUSED_NOW[flavour]
    # WHEN it is sent to a place THEN it flies there
    lat_deg, lon_deg, alt_m = frame.geodetic((8.0, -4.0, -6.0))
    goto = mavlink.MAVLink_command_int_message(
        7, 1, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION, 0, 0,
        -1, 1, 0, math.nan, round(lat_deg * 1e7), round(lon_deg * 1e7), alt_m,
    )  # fmt: skip
    client.send(goto)
    assert client.received["COMMAND_ACK"][-1].result == OK
    client.run_to(27.0)
    np.testing.assert_allclose(world.position_m[0], (8.0, -4.0, -6.0), atol=0.05)
    # WHEN it lands THEN it rests at the ground and can be disarmed
    assert client.command(mavlink.MAV_CMD_NAV_LAND) == OK
    client.run_to(45.0)
    assert world.landed[0]
    assert world.position_m[0, 2] == pytest.approx(0.0, abs=0.06)
    assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE) == OK
    assert client.received["EXTENDED_SYS_STATE"][-1].landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
    assert client.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == OK
    assert client.command(mavlink.MAV_CMD_NAV_LAND) == REFUSED_NOW[flavour]


@pytest.mark.parametrize(
    "params",
    [
        (-1, 1, 0, math.nan, math.nan, 8.5, 500.0),
        (-1, 1, 0, math.nan, 91.0, 8.5, 500.0),
        (-1, 1, 0, math.nan, 47.0, 181.0, 500.0),
        (-1, 1, 0, math.nan, 47.0, 8.5, math.inf),
    ],
)
def test_impossible_places_are_denied(connect, params):
    client = connect(PX4)
    client.run_to(1.0)
    assert client.command(mavlink.MAV_CMD_DO_REPOSITION, *params) == DENIED
    client.run_to(2.0)
    np.testing.assert_allclose(client.simulation.world.position_m[0], (5.0, 0.0, 5.0), atol=1e-6)


def test_modes_are_shown_in_the_heartbeat(connect):
    client = connect(PX4)
    assert client.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 4, 3) == OK
    client.run_to(1.1)
    assert client.received["HEARTBEAT"][-1].custom_mode == px4_mode(4, 3)
    assert client.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 77, 0) == DENIED
    assert client.command(mavlink.MAV_CMD_DO_SET_MODE, 1, math.nan, 0) == DENIED
    assert client.command(mavlink.MAV_CMD_MISSION_START) == OK
    client.run_to(2.1)
    assert client.received["HEARTBEAT"][-1].custom_mode == px4_mode(4, 4)


@BOTH
def test_reboot_is_refused_in_flight_and_done_on_the_ground(connect, flavour):
    flying = connect(Vehicle(1, flavour, 7, **HOVER))
    assert flying.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0, 0, 0, 0, 0, 0) == REFUSED_NOW[flavour]
    resting = connect(Vehicle(1, flavour, 7, **ON_GROUND))
    resting.run_to(4.0)
    assert resting.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 3.0) == UNSUPPORTED
    assert resting.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0) == OK
    resting.run_to(4.9)
    assert not resting.between("HEARTBEAT", 4.01, 4.9)
    resting.run_to(7.0)
    resting.send(mavlink.MAVLink_timesync_message(0, 5))
    assert resting.received["TIMESYNC"][-1].tc1 == pytest.approx(2.0e9, abs=0.02e9)


def test_the_ekf_source_is_ardupilots_alone(connect):
    assert connect(PX4).command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2) == UNSUPPORTED
    client = connect(ARDUPILOT)
    assert client.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2) == OK
    assert client.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 4) == DENIED
    assert client.simulation.autopilots[1].state.feed.source_set == 2
