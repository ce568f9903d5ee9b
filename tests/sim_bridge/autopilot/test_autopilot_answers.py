"""What the fake autopilots make of what they are sent: parameters, missions, nonsense, a bad wire, any bytes."""

from __future__ import annotations

import itertools
import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.autopilot.link_faults import LinkQuality
from sim_bridge.world.scenario import Interval, Vehicle
from tests.support.hovering import ARDUPILOT, HOVER, PX4


def test_parameters_are_listed_read_and_set(connect):
    for vehicle, name, encode in (
        (PX4, b"EKF2_EV_CTRL", lambda v: struct.unpack("<f", struct.pack("<i", v))[0]),
        (ARDUPILOT, b"VISO_TYPE", float),
    ):
        client = connect(vehicle)
        client.send(mavlink.MAVLink_param_request_list_message(7, 1))
        values = client.received["PARAM_VALUE"]
        assert sorted(v.param_index for v in values) == list(range(values[0].param_count))
        client.send(mavlink.MAVLink_param_set_message(7, 1, name, encode(5), mavlink.MAV_PARAM_TYPE_INT32))
        assert values[-1].param_value == encode(5)
        client.send(mavlink.MAVLink_param_request_read_message(7, 1, name, -1))
        assert (values[-1].param_id, values[-1].param_value) == (name.decode(), encode(5))
        known = len(values)
        client.send(mavlink.MAVLink_param_request_read_message(7, 1, b"NONSENSE", -1))
        client.send(mavlink.MAVLink_param_set_message(7, 1, b"NONSENSE", 1.0, 9))
        assert len(values) == known
        counters = client.simulation.autopilots[1].counters
        assert counters.ignored["unknown parameter"] == counters.ignored["unknown parameter or value"] == 1


def test_missions_pings_and_stream_groups(connect):
    client = connect(ARDUPILOT)
    client.send(mavlink.MAVLink_mission_request_list_message(7, 1, mission_type=0))
    assert client.received["MISSION_COUNT"][-1].count == 0
    client.send(mavlink.MAVLink_mission_count_message(7, 1, 3, mission_type=0))
    client.send(mavlink.MAVLink_mission_clear_all_message(7, 1, mission_type=0))
    results = [ack.type for ack in client.received["MISSION_ACK"]]
    assert results == [mavlink.MAV_MISSION_UNSUPPORTED, mavlink.MAV_MISSION_ACCEPTED]
    client.send(mavlink.MAVLink_ping_message(1, 42, 0, 0))
    ping = client.received["PING"][-1]
    assert (ping.seq, ping.target_system) == (42, 245)
    client.send(mavlink.MAVLink_request_data_stream_message(7, 1, mavlink.MAV_DATA_STREAM_RAW_SENSORS, 25, 1))
    client.run_to(4.0)
    assert len(client.received["RAW_IMU"]) == pytest.approx(100, abs=1)


def test_messages_for_others_and_garbage_are_counted_and_not_obeyed(connect):
    client = connect(PX4)
    client.send(mavlink.MAVLink_command_long_message(9, 1, 511, 0, 105, -1.0, 0, 0, 0, 0, 0))
    client.send(mavlink.MAVLink_command_long_message(7, 154, 511, 0, 105, -1.0, 0, 0, 0, 0, 0))
    client.send(mavlink.MAVLink_manual_control_message(7, 0, 0, 0, 0, 0))
    client.simulation.receive(1, b"\xfd\x09nothing of ours", client.simulation.now)
    autopilot = client.simulation.autopilots[1]
    assert dict(autopilot.counters.ignored) == {
        "COMMAND_LONG for another system": 1,
        "COMMAND_LONG for another component": 1,
        "MANUAL_CONTROL": 1,
    }
    assert sum(autopilot.link.bad.values()) >= 1
    client.run_to(2.0)
    assert len(client.received["HIGHRES_IMU"]) == pytest.approx(100, abs=1)


@pytest.mark.parametrize("value", [math.nan, math.inf, -7.0])
def test_nonsense_in_an_interval_is_denied(connect, value):
    assert connect(PX4).command(511, 105, value) == mavlink.MAV_RESULT_DENIED


def test_a_bad_wire_loses_doubles_and_swaps_frames(connect):
    # GIVEN a link with all three faults
    client = connect(Vehicle(1, "px4", 1, link=LinkQuality(0.2, 0.1, 0.1), **HOVER))
    client.run_to(20.0)
    stamps = [message.time_usec for message in client.received["HIGHRES_IMU"]]
    unique = set(stamps)
    # THEN a fifth of the 50 Hz is missing, a tenth comes twice, some come late
    assert len(unique) / 1000 == pytest.approx(0.8, abs=0.05)
    assert len(stamps) / len(unique) == pytest.approx(1.1, abs=0.04)
    steps = [(later - earlier) % 256 for earlier, later in itertools.pairwise(client.sequence)]
    assert 0.05 < np.mean([step > 128 for step in steps]) < 0.15


def test_impossible_link_qualities_are_refused():
    with pytest.raises(ValueError, match=r"loss: expected a probability 0\.\.1, found 1\.5"):
        LinkQuality(loss=1.5)


anything = st.floats(width=32)


@settings(max_examples=40, deadline=None)
@given(
    flavour=st.sampled_from(["px4", "ardupilot"]),
    number=st.one_of(
        st.integers(0, 0xFFFF),
        st.sampled_from([16, 20, 21, 22, 176, 192, 246, 300, 400, 410, 510, 511, 512, 520, 42007]),
    ),
    params=st.lists(anything, min_size=7, max_size=7),
    frame=st.integers(0, 255),
    place=st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1)),
)
def test_every_command_whatever_it_holds_is_answered_and_survived(connect, flavour, number, params, frame, place):
    vehicle = Vehicle(1, flavour, 7, start_m=(0.0, 0.0, 0.0))
    client = connect(vehicle)
    client.run_to(0.3)
    client.set_rate(33, 10.0)
    acks = client.received["COMMAND_ACK"]
    before = len(acks)
    client.send(mavlink.MAVLink_command_long_message(7, 1, number, 0, *params))
    client.send(mavlink.MAVLink_command_int_message(7, 1, frame, number, 0, 0, *params[:4], *place, params[6]))
    rebooting = number == 246 and any(ack.result == 0 for ack in acks[before:])
    assert rebooting or [ack.command for ack in acks[before:]] == [number, number]
    client.run_to(2.2)
    assert client.between("HEARTBEAT", 1.2, 2.3)
    assert np.isfinite(client.simulation.world.position_m).all()


@settings(max_examples=20, deadline=None)
@given(
    flavour=st.sampled_from(["px4", "ardupilot"]),
    values=st.lists(anything, min_size=3, max_size=3),
    quaternion=st.lists(anything, min_size=4, max_size=4),
    frames=st.sampled_from([(1, 1), (1, 12), (20, 12), (4, 4), (14, 0)]),
    noise=st.binary(max_size=300),
)
def test_any_feed_and_any_bytes_are_survived(connect, flavour, values, quaternion, frames, noise):
    vehicle = Vehicle(1, flavour, 7, start_m=(0.0, 0.0, 0.0))
    client = connect(vehicle, gps_outages=(Interval(1, 0.5, 1e9),))
    for message_id in (32, 33):
        client.set_rate(message_id, 10.0)
    client.run_to(1.7)
    zeros = [0.0] * 21
    for step in range(3):
        client.simulation.receive(1, noise, client.simulation.now)
        client.send(
            mavlink.MAVLink_odometry_message(
                0, *frames, *values, quaternion, *values, 0.0, 0.0, 0.0, zeros, zeros, 0, 2, 50
            )
        )
        client.run_to(1.8 + 0.1 * step)
    feed = client.simulation.autopilots[1].state.feed
    assert feed.accepted + sum(feed.rejected.values()) == 3
    last = client.received["LOCAL_POSITION_NED"][-1]
    assert np.isfinite((last.x, last.y, last.z, last.vx, last.vy, last.vz)).all()
