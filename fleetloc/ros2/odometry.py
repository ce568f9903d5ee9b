"""nav_msgs/Odometry as rmw_zenoh carries it: CDR bytes, keys, attachment; without ROS, pure.

A drone's own estimate in the ROS axes (REP 103: x east, y north, z up). The estimators know no attitude: the child
frame is parallel to the parent, so that the twist, which ROS wants in child axes, is in those too, and the
orientation is unknown (variance of a uniform angle). Layouts: ROS 2 Jazzy's message definitions, OMG CDR 1 little
endian, rmw_zenoh's design document. Checked for bytes only, never against a running ROS graph.
"""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from transport.messages.estimate_body import FleetEstimate

TYPE = "nav_msgs::msg::dds_::Odometry_"
TYPE_HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
"""Of Odometry with all it holds, the same in every distribution that knows type hashes (since Iron)."""
QOS = "2::,10:,:,:,,"
"""Best effort, the last ten, all else by default, as rmw_zenoh writes it."""
UNKNOWN_ANGLE_VARIANCE = math.pi**2 / 3
GID_BYTES = 16
NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """The message; positions m, velocities m/s in ROS axes, covariances ``(6, 6)`` linear before angular."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position: Vector
    orientation_xyzw: Vector
    pose_covariance: Matrix
    linear: Vector
    angular: Vector
    twist_covariance: Matrix


class _Cdr:
    """A little-endian CDR stream: every number at a multiple of its size from the first byte after the header."""

    def __init__(self) -> None:
        self._parts = bytearray()

    def _align(self, size: int) -> None:
        self._parts += bytes(-len(self._parts) % size)

    def integers(self, layout: str, *values: int) -> None:
        self._align(4)
        self._parts += struct.pack(f"<{layout}", *values)

    def text(self, value: str) -> None:
        data = value.encode() + b"\0"
        self.integers("I", len(data))
        self._parts += data

    def doubles(self, values: Vector) -> None:
        self._align(8)
        self._parts += values.astype("<f8").tobytes()

    def done(self) -> bytes:
        return b"\x00\x01\x00\x00" + bytes(self._parts)


def encode_odometry(message: Odometry) -> bytes:
    """CDR of a message, with its encapsulation header."""
    stream = _Cdr()
    stream.integers("iI", *divmod(message.stamp_ns, 1_000_000_000))
    stream.text(message.frame_id)
    stream.text(message.child_frame_id)
    stream.doubles(message.position)
    stream.doubles(message.orientation_xyzw)
    stream.doubles(message.pose_covariance.ravel())
    stream.doubles(message.linear)
    stream.doubles(message.angular)
    stream.doubles(message.twist_covariance.ravel())
    return stream.done()


def odometry_of(
    estimate: FleetEstimate, agent_id: int, *, stamp_ns: int, frame_id: str, child_frame_id: str
) -> Odometry:
    """What a drone says of itself; its estimate holds the drone."""
    slot = estimate.agents.index(agent_id)
    state = estimate.mean[6 * slot : 6 * slot + 6]
    covariance = estimate.own_covariance
    return Odometry(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        child_frame_id=child_frame_id,
        position=NED_TO_ENU @ state[:3],
        orientation_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        pose_covariance=_with_unknown_angles(covariance[:3, :3]),
        linear=NED_TO_ENU @ state[3:],
        angular=np.zeros(3),
        twist_covariance=_with_unknown_angles(covariance[3:, 3:]),
    )


def _with_unknown_angles(ned: Matrix) -> Matrix:
    covariance = np.diag([0.0, 0.0, 0.0, *[UNKNOWN_ANGLE_VARIANCE] * 3])
    covariance[:3, :3] = NED_TO_ENU @ ned @ NED_TO_ENU.T
    return covariance


# --- on rmw_zenoh ---------------------------------------------------------------------------------------------------


def topic_key(domain: int, topic: str) -> str:
    """Key expression of a topic such as ``uav1/odom`` (without the leading slash)."""
    return f"{domain}/{topic}/{TYPE}/{TYPE_HASH}"


def node_token(domain: int, session_id: str, node: str) -> str:
    """Liveliness token that makes a node known to the graph."""
    return f"@ros2_lv/{domain}/{session_id}/0/0/NN/%/%/{node}"


def publisher_token(domain: int, session_id: str, entity: int, node: str, topic: str) -> str:
    """Liveliness token of a publisher, number ``entity`` of its session."""
    mangled = "%" + topic.replace("/", "%")
    return f"@ros2_lv/{domain}/{session_id}/0/{entity}/MP/%/%/{node}/{mangled}/{TYPE}/{TYPE_HASH}/{QOS}"


def gid_of(token: str) -> bytes:
    """The 16 bytes that tell a publisher from all others; any that do will do."""
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(number: int, unix_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh (Jazzy 0.2.4 and later) wants beside every message: 33 bytes."""
    return struct.pack("<qqB", number, unix_ns, len(gid)) + gid
