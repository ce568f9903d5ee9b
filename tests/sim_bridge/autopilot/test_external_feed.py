"""Outside positions: taken and refused as the real autopilots do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.world.scenario import Interval, Vehicle

HOVER = {"start_m": (5.0, 0.0, 5.0), "start_velocity_mps": (0.0, 0.0, 0.0)}
PX4 = Vehicle(1, "px4", 7, **HOVER)
ARDUPILOT = Vehicle(1, "ardupilot", 7, **HOVER)
NED, ENU, FRD, FLU, BODY = 1, 4, 20, 21, 12
VISION, VIO, MOCAP, AUTOPILOT = 2, 3, 6, 8


def odometry(position: tuple[float, float, float], frame: int, child: int, **changes: Any) -> Any:
    fields = {
        "time_usec": 0, "frame_id": frame, "child_frame_id": child,
        "x": position[0], "y": position[1], "z": position[2], "q": [1.0, 0.0, 0.0, 0.0],
        "vx": 0.0, "vy": 0.0, "vz": 0.0, "rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": 0.0,
        "pose_covariance": [0.01] * 21, "velocity_covariance": [0.01] * 21,
        "reset_counter": 1, "estimator_type": VISION, "quality": 50,
    }  # fmt: skip
    return mavlink.MAVLink_odometry_message(**(fields | changes))


def feed_of(client: Any) -> Any:
    return client.simulation.autopilots[1].state.feed


@pytest.mark.parametrize(
    ("vehicle", "frame", "child", "changes", "accepted"),
    [
        (PX4, NED, NED, {}, True),
        (PX4, NED, BODY, {"estimator_type": VIO}, True),
        (PX4, ENU, ENU, {}, True),
        (PX4, FRD, BODY, {}, True),
        (PX4, NED, NED, {"q": [math.nan] * 4}, True),
        (PX4, 14, BODY, {}, False),
        (PX4, NED, 0, {}, False),
        (PX4, NED, NED, {"estimator_type": MOCAP}, False),
        (PX4, NED, NED, {"estimator_type": AUTOPILOT}, False),
        (PX4, NED, NED, {"x": math.nan}, False),
        (PX4, NED, NED, {"y": 1e38}, False),
        (PX4, NED, NED, {"vz": -3e38}, False),
        (ARDUPILOT, FRD, BODY, {}, True),
        (ARDUPILOT, FRD, BODY, {"estimator_type": AUTOPILOT}, True),
        (ARDUPILOT, NED, NED, {}, False),
        (ARDUPILOT, NED, BODY, {}, False),
        (ARDUPILOT, FRD, NED, {}, False),
        (ARDUPILOT, FRD, BODY, {"q": [math.nan] * 4}, False),
        (ARDUPILOT, FRD, BODY, {"q": [3e38, 0.0, 0.0, 3e38]}, False),
        (ARDUPILOT, FRD, BODY, {"quality": -1}, False),
        (ARDUPILOT, FRD, BODY, {"x": math.inf}, False),
    ],
)
def test_frames_and_estimators(connect, vehicle, frame, child, changes, accepted):
    client = connect(vehicle)
    client.run_to(1.0)
    client.send(odometry((0.0, 0.0, 0.0), frame, child, **changes))
    feed = feed_of(client)
    assert feed.accepted == accepted
    assert sum(feed.rejected.values()) == (not accepted)
    # only PX4 speaks up, and only about the estimator type
    announced = vehicle is PX4 and changes.get("estimator_type") == AUTOPILOT
    assert len(client.received["STATUSTEXT"]) == announced


def test_messages_that_are_not_handled_are_counted(connect):
    client = connect(PX4)
    client.send(mavlink.MAVLink_vision_speed_estimate_message(0, 0.0, 0.0, 0.0))
    assert dict(feed_of(client).rejected) == {"VISION_SPEED_ESTIMATE not handled": 1}
    client.send(mavlink.MAVLink_vision_position_estimate_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert feed_of(client).accepted == 1


def fly_blind(client: Any, message: Any, period_s: float) -> np.ndarray:
    """Lose GPS at 5 s, feed from 4 s to 25 s; LOCAL_POSITION_NED at the end minus the feed."""
    client.set_rate(32, 10.0)
    time_s = 4.0
    client.run_to(time_s)
    while time_s < 25.0:
        client.send(message)
        time_s += period_s
        client.run_to(time_s)
    local = client.received["LOCAL_POSITION_NED"][-1]
    return np.array((local.x - message.x, local.y - message.y, local.z - message.z))


OUTAGE = {"gps_outages": (Interval(1, 5.0, 1e9),)}


def test_px4_follows_the_feed_when_gps_is_gone(connect):
    client = connect(PX4, **OUTAGE)
    error = fly_blind(client, odometry((3.0, 0.0, 0.0), NED, NED), 0.1)
    np.testing.assert_allclose(error, 0.0, atol=0.3)
    assert client.received["ESTIMATOR_STATUS"][-1].flags == 0x33F


def test_px4_does_not_start_on_a_feed_slower_than_five_per_second(connect):
    client = connect(PX4, **OUTAGE)
    error = fly_blind(client, odometry((3.0, 0.0, 0.0), NED, NED), 0.25)
    assert np.linalg.norm(error) > 0.5
    assert client.received["ESTIMATOR_STATUS"][-1].flags == 0x25


def test_ardupilot_follows_the_feed_only_from_its_second_source_set(connect):
    message = odometry((3.0, 0.0, 0.0), FRD, BODY)
    ignoring, following = connect(ARDUPILOT, **OUTAGE), connect(ARDUPILOT, **OUTAGE)
    following.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2)
    assert np.linalg.norm(fly_blind(ignoring, message, 0.1)) > 0.5
    np.testing.assert_allclose(fly_blind(following, message, 0.1), 0.0, atol=0.3)


@pytest.mark.parametrize(
    ("frame", "position"),
    [(NED, (1.0, 2.0, 3.0)), (ENU, (2.0, 1.0, -3.0)), (FRD, (1.0, 2.0, 3.0)), (FLU, (1.0, -2.0, -3.0))],
)
def test_axes_of_the_local_frames(connect, frame, position):
    client = connect(PX4, **OUTAGE)
    client.run_to(8.0)
    attitude = np.array([1.0, 0.0, 0.0, 0.0])
    turned = {"vx": position[0], "vy": position[1], "vz": position[2]}
    fed = feed_of(client).accept(odometry(position, frame, frame, **turned), attitude, client.simulation.now)
    np.testing.assert_array_equal(fed.position_m, (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(fed.velocity_mps, (1.0, 2.0, 3.0))


def test_velocity_in_the_body_frame_is_turned(connect):
    client = connect(ARDUPILOT)
    quarter = math.sqrt(0.5)
    message = odometry((0.0, 0.0, 0.0), FRD, BODY, q=[quarter, 0.0, 0.0, quarter], vx=2.0)
    fed = feed_of(client).accept(message, np.array([1.0, 0.0, 0.0, 0.0]), client.simulation.now)
    np.testing.assert_allclose(fed.velocity_mps, (0.0, 2.0, 0.0), atol=1e-12)
    without = odometry((0.0, 0.0, 0.0), FRD, BODY, vx=math.nan)
    fed = feed_of(client).accept(without, np.array([1.0, 0.0, 0.0, 0.0]), client.simulation.now)
    assert fed.velocity_mps is None
