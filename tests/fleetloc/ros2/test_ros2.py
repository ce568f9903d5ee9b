"""Odometry for ROS 2: bytes against an independent implementation, axes, keys, and what a router receives."""

from __future__ import annotations

import json
import queue
import socket
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from fleetloc.errors import EnvironmentFault, InputError
from fleetloc.ros2.bridge import Ros2Publisher, Ros2Settings
from fleetloc.ros2.odometry import (
    UNKNOWN_ANGLE_VARIANCE,
    Odometry,
    attachment,
    encode_odometry,
    odometry_of,
    publisher_token,
    topic_key,
)
from tests.support.beacon import fleet_estimate
from tests.support.ports import bound

GOLDEN = json.loads((Path(__file__).parents[2] / "data" / "ros2" / "odometry.json").read_text())
HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"


def fleet() -> FleetConfig:
    return config_from(
        {
            "fleet": {"name": "ros", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24550 + i}"} for i in (1, 2)],
        },
        "test",
    )


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden["frame_id"] or "empty names")
def test_the_bytes_are_those_of_another_implementation(golden: dict[str, Any]) -> None:
    message = Odometry(
        stamp_ns=golden["stamp_ns"],
        frame_id=golden["frame_id"],
        child_frame_id=golden["child_frame_id"],
        position=np.array(golden["position"]),
        orientation_xyzw=np.array(golden["orientation"], float),
        pose_covariance=np.array(golden["pose_covariance"]).reshape(6, 6),
        linear=np.array(golden["linear"]),
        angular=np.array(golden["angular"], float),
        twist_covariance=np.array(golden["twist_covariance"]).reshape(6, 6),
    )
    assert encode_odometry(message).hex() == golden["cdr_hex"]


def test_axes_become_east_north_up_and_covariances_with_them() -> None:
    estimate = fleet_estimate(fleet(), 0.0, own=2)
    estimate.mean[6:12] = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    covariance[0, 2] = covariance[2, 0] = 0.5  # north and down
    estimate.own_covariance[:] = covariance
    odometry = odometry_of(estimate, 2, stamp_ns=0, frame_id="map", child_frame_id="x")
    assert odometry.position.tolist() == [2.0, 1.0, -3.0]
    assert odometry.linear.tolist() == [0.2, 0.1, -0.3]
    assert odometry.pose_covariance.diagonal().tolist() == [2.0, 1.0, 3.0, *[UNKNOWN_ANGLE_VARIANCE] * 3]
    assert odometry.pose_covariance[1, 2] == -0.5  # north and up
    assert odometry.twist_covariance.diagonal()[:3].tolist() == [5.0, 4.0, 6.0]


def test_keys_tokens_and_attachment_are_those_of_rmw_zenoh() -> None:
    assert topic_key(7, "uav1/odom") == f"7/uav1/odom/nav_msgs::msg::dds_::Odometry_/{HASH}"
    token = publisher_token(7, "abc", 10, "fleetloc", "uav1/odom")
    expected = f"@ros2_lv/7/abc/0/10/MP/%/%/fleetloc/%uav1%odom/nav_msgs::msg::dds_::Odometry_/{HASH}/2::,10:,:,:,,"
    assert token == expected
    beside = attachment(5, 123, bytes(range(16)))
    assert len(beside) == 33
    assert struct.unpack("<qqB16s", beside) == (5, 123, 16, bytes(range(16)))


def test_a_router_receives_the_message_and_the_graph_its_tokens() -> None:
    # GIVEN a router, as rmw_zenohd is one, and a subscriber to everything of domain 3
    with bound(socket.SOCK_STREAM) as port:
        endpoint = f"tcp/127.0.0.1:{port}"
    table = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    with zenoh.open(zenoh.Config.from_json5(json.dumps(table))) as router:
        router.declare_subscriber("3/**", zenoh.handlers.Callback(samples.put, indirect=False))
        publisher = Ros2Publisher(fleet(), Ros2Settings(endpoint, domain=3))
        try:
            # WHEN drone 2 says where it is
            estimate = fleet_estimate(fleet(), 4.0, own=2)
            publisher.publish(2, estimate, 123)
            # THEN the message arrives under its key with its attachment
            sample = samples.get(timeout=30.0)
            assert str(sample.key_expr) == topic_key(3, "uav2/odom")
            stamp_ns = round((fleet().fleet.epoch_unix_s + 4.0) * 1e9)
            names = {"frame_id": "map", "child_frame_id": "uav2/estimate"}
            assert sample.payload.to_bytes() == encode_odometry(odometry_of(estimate, 2, stamp_ns=stamp_ns, **names))
            assert sample.attachment is not None
            assert struct.unpack("<qqB", sample.attachment.to_bytes()[:17]) == (1, 123, 16)
            tokens = [str(reply.ok.key_expr) for reply in router.liveliness().get("@ros2_lv/3/**") if reply.ok]
            assert sorted(token.split("/")[5] for token in tokens) == ["MP", "MP", "NN"]
        finally:
            publisher.close()


def test_no_router_is_said_in_one_line() -> None:
    with bound(socket.SOCK_STREAM) as port:
        endpoint = f"tcp/127.0.0.1:{port}"
    with pytest.raises(EnvironmentFault, match=rf"router {endpoint}: no rmw_zenohd reached"):
        Ros2Publisher(fleet(), Ros2Settings(endpoint))


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"domain": 233}, "--domain"),
        ({"namespace": "uav"}, "--namespace"),
        ({"namespace": "1uav{id}"}, "--namespace"),
        ({"namespace": "uav{id}/**"}, "--namespace"),
        ({"router": "127.0.0.1"}, "--router"),
    ],
)
def test_settings_that_ros_would_not_take_are_refused(settings: dict[str, Any], names: str) -> None:
    with pytest.raises(InputError, match=f"{names}: expected"):
        Ros2Settings(**settings)
