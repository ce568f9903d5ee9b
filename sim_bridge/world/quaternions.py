"""Attitude of many vehicles at once: unit quaternions ``(n, 4)``, order w x y z, body FRD into NED."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALL_ANGLE = 1e-9


def _norms(vectors: Array) -> Array:
    """Norms ``(n, 1)`` of ``(n, k)``; for a few rows `numpy.linalg.norm` is mostly overhead."""
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True)))


def multiply(left: Array, right: Array) -> Array:
    """Hamilton product of ``(n, 4)`` with ``(n, 4)``."""
    lw, lx, ly, lz = left.T
    rw, rx, ry, rz = right.T
    return np.array(
        (
            lw * rw - lx * rx - ly * ry - lz * rz,
            lw * rx + lx * rw + ly * rz - lz * ry,
            lw * ry - lx * rz + ly * rw + lz * rx,
            lw * rz + lx * ry - ly * rx + lz * rw,
        )
    ).T


def conjugate(quaternion: Array) -> Array:
    """The inverse rotation, NED into body."""
    return np.asarray(quaternion * np.array((1.0, -1.0, -1.0, -1.0)))


def matrices(quaternion: Array) -> Array:
    """Rotation matrices ``(n, 3, 3)`` of unit quaternions ``(n, 4)``: body into NED."""
    w, x, y, z = quaternion.T
    wx, wy, wz = 2.0 * w * x, 2.0 * w * y, 2.0 * w * z
    xx, xy, xz = 2.0 * x * x, 2.0 * x * y, 2.0 * x * z
    yy, yz, zz = 2.0 * y * y, 2.0 * y * z, 2.0 * z * z
    rows = (1.0 - yy - zz, xy - wz, xz + wy, xy + wz, 1.0 - xx - zz, yz - wx, xz - wy, yz + wx, 1.0 - xx - yy)
    return np.array(rows).T.reshape(-1, 3, 3)


def rotate(quaternion: Array, vector: Array) -> Array:
    """Vectors ``(n, 3)`` turned by quaternions ``(n, 4)``: body into NED."""
    return np.asarray((matrices(quaternion) @ vector[..., None])[..., 0])


def from_rotation_vector(angle_rad: Array) -> Array:
    """Exponential map of rotation vectors ``(n, 3)``."""
    angle = np.linalg.norm(angle_rad, axis=-1, keepdims=True)
    scale = np.where(angle < SMALL_ANGLE, 0.5, np.sin(0.5 * angle) / np.maximum(angle, SMALL_ANGLE))
    return np.concatenate((np.cos(0.5 * angle), scale * angle_rad), axis=-1)


def to_rotation_vector(quaternion: Array) -> Array:
    """Logarithm, the shorter of the two turns, ``(n, 3)`` rad."""
    shorter = np.where(quaternion[:, :1] < 0.0, -quaternion, quaternion)
    sine = _norms(shorter[:, 1:])
    angle = 2.0 * np.arctan2(sine, shorter[:, :1])
    scale = np.where(sine < SMALL_ANGLE, 2.0, angle / np.maximum(sine, SMALL_ANGLE))
    return np.asarray(scale * shorter[:, 1:])


def from_thrust(specific_force_ned: Array, yaw_rad: Array) -> Array:
    """Attitude of quadrotors whose thrust gives this specific force.

    The smallest tilt that puts body -z along the specific force ``(n, 3)``, after a turn by ``yaw_rad``
    ``(n,)`` about body z. Level flight: specific force ``(0, 0, -g)``, tilt zero.
    """
    down = -specific_force_ned / _norms(specific_force_ned)
    w, x, y = 1.0 + down[:, 2], -down[:, 1], down[:, 0]
    norm = np.sqrt(w * w + x * x + y * y)
    w, x, y = w / norm, x / norm, y / norm
    c, s = np.cos(0.5 * yaw_rad), np.sin(0.5 * yaw_rad)
    return np.array((w * c, x * c + y * s, y * c - x * s, w * s)).T


def to_euler(quaternion: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad (ZYX) of one quaternion ``(4,)``."""
    w, x, y, z = (float(c) for c in quaternion)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return float(roll), float(pitch), float(yaw)
