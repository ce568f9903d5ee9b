"""Robots in the plane with odometry, ranges between them and to one anchor, as files of other programs hold them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

ANCHOR_M = 0.5, -1.0
STEP_S = 0.05


@dataclass(frozen=True, slots=True)
class Robots:
    """A drive in figures: ``pose`` ``(K, n, 3)`` x, y, heading at ``STEP_S`` spacing, and how well it is measured."""

    pose: np.ndarray
    odometry_sigma_m: float = 0.004
    range_sigma_m: float = 0.04


def drive(count: int, duration_s: float) -> Robots:
    """Circles of different size and pace."""
    time_s = STEP_S * np.arange(round(duration_s / STEP_S) + 1)
    poses = []
    for k in range(count):
        angle = 0.4 * time_s * (1.0 + 0.2 * k) + 2.0 * k
        radius = 1.0 + 0.4 * k
        x, y = radius * np.cos(angle) + 2.0 * (k % 2), radius * np.sin(angle) + 1.5 * (k // 2)
        poses.append(np.column_stack((x, y, angle + math.pi / 2.0)))
    return Robots(np.stack(poses, axis=1))


def as_pyfg(robots: Robots, rng: np.random.Generator, bias_m: dict[tuple[int, int], float] | None = None) -> str:
    """The lines of a factor graph; ranges of each pair in turn, 10 a second and pair."""
    lines, (count, n, _) = [f"VERTEX_XY L0 {ANCHOR_M[0]} {ANCHOR_M[1]}"], robots.pose.shape
    for k in range(count):
        for r in range(n):
            x, y, heading = robots.pose[k, r]
            lines.append(f"VERTEX_SE2 {1000 + STEP_S * k:.6f} {'ABCD'[r]}{k} {x} {y} {heading}")
    for k in range(count - 1):
        for r in range(n):
            here, there = robots.pose[k, r], robots.pose[k + 1, r]
            cos, sin = math.cos(here[2]), math.sin(here[2])
            dx, dy = there[:2] - here[:2]
            ahead, left = np.array((cos * dx + sin * dy, cos * dy - sin * dx)) + rng.normal(
                0.0, robots.odometry_sigma_m, 2
            )
            spread = robots.odometry_sigma_m**2
            name = "ABCD"[r]
            lines.append(
                f"EDGE_SE2 {1000 + STEP_S * (k + 1):.6f} {name}{k} {name}{k + 1} {ahead} {left} {there[2] - here[2]} "
                f"{spread} 0 0 {spread} 0 1e-6"
            )
    for k in range(0, count, 2):
        for a in range(n):
            for b in [*range(a + 1, n), -1]:
                far = np.array(ANCHOR_M) if b < 0 else robots.pose[k, b, :2]
                error = rng.normal(0.0, robots.range_sigma_m) + (bias_m or {}).get((a, b), 0.0)
                other = "L0" if b < 0 else f"{'ABCD'[b]}{k}"
                distance = np.linalg.norm(robots.pose[k, a, :2] - far) + error
                lines.append(
                    f"EDGE_RANGE {1000 + STEP_S * k:.6f} {'ABCD'[a]}{k} {other} {distance} {robots.range_sigma_m**2}"
                )
    return "\n".join(lines) + "\n"
