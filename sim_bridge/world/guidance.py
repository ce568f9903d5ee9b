"""Where the vehicles are meant to fly, and the linear-quadratic law that takes them there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import solve_discrete_are

from sim_bridge.world.quaternions import Array

Point = tuple[float, float, float]
"""NED metres in the fleet frame."""


@dataclass(frozen=True, slots=True)
class Reference:
    """Where a path is at one time, NED: m, m/s, m/s^2."""

    position_m: Point
    velocity_mps: Point = (0.0, 0.0, 0.0)
    accel_mps2: Point = (0.0, 0.0, 0.0)


class Path(Protocol):
    """A path as a function of the time since it was begun."""

    def reference(self, time_s: float) -> Reference:
        """Position, velocity and acceleration at ``time_s``."""
        ...


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Fly to the points in turn, ``hold_s`` from one to the next; a single point is held for ever."""

    points_m: tuple[Point, ...]
    hold_s: float = 10.0
    repeat: bool = True

    def reference(self, time_s: float) -> Reference:
        """The point whose turn it is."""
        turn = int(max(time_s, 0.0) / self.hold_s)
        last = len(self.points_m) - 1
        return Reference(self.points_m[turn % (last + 1) if self.repeat else min(turn, last)])


@dataclass(frozen=True, slots=True)
class Circle:
    """A horizontal circle at constant speed, right-handed about down (clockwise seen from above)."""

    center_m: Point
    radius_m: float
    lap_s: float
    phase_rad: float = 0.0

    def reference(self, time_s: float) -> Reference:
        """Point, tangent and centripetal acceleration."""
        rate = 2.0 * math.pi / self.lap_s
        angle = rate * time_s + self.phase_rad
        north, east, down = self.center_m
        c, s = self.radius_m * math.cos(angle), self.radius_m * math.sin(angle)
        return Reference(
            (north + c, east + s, down), (-rate * s, rate * c, 0.0), (-rate * rate * c, -rate * rate * s, 0.0)
        )


@dataclass(frozen=True, slots=True)
class FigureEight:
    """A horizontal Lissajous eight: north at the lap's frequency, east at twice that."""

    center_m: Point
    length_m: float
    width_m: float
    lap_s: float
    phase_rad: float = 0.0

    def reference(self, time_s: float) -> Reference:
        """Point and its derivatives; ``length_m`` and ``width_m`` are the whole extents."""
        rate = 2.0 * math.pi / self.lap_s
        angle = rate * time_s + self.phase_rad
        north, east, down = self.center_m
        a, b = 0.5 * self.length_m, 0.5 * self.width_m
        s1, c1, s2, c2 = math.sin(angle), math.cos(angle), math.sin(2.0 * angle), math.cos(2.0 * angle)
        return Reference(
            (north + a * s1, east + b * s2, down),
            (a * rate * c1, 2.0 * b * rate * c2, 0.0),
            (-a * rate * rate * s1, -4.0 * b * rate * rate * s2, 0.0),
        )


@dataclass(frozen=True, slots=True)
class Line:
    """Straight on at constant velocity, swinging about the line: ``swing_m`` out on each axis, in ``swing_s``."""

    start_m: Point
    velocity_mps: Point
    swing_m: Point = (0.0, 0.0, 0.0)
    swing_s: float = 60.0

    def reference(self, time_s: float) -> Reference:
        """The point reached and its derivatives."""
        rate = 2.0 * math.pi / self.swing_s
        out, along = math.sin(rate * time_s), math.cos(rate * time_s)
        swings = list(zip(self.start_m, self.velocity_mps, self.swing_m, strict=True))
        north, east, down = (p + time_s * v + out * a for p, v, a in swings)
        v_north, v_east, v_down = (v + rate * along * a for _, v, a in swings)
        a_north, a_east, a_down = (-rate * rate * out * a for a in self.swing_m)
        return Reference((north, east, down), (v_north, v_east, v_down), (a_north, a_east, a_down))


def peak_accel_mps2(path: Path) -> float:
    """Largest acceleration per axis that following a path needs (steps between waypoints not counted)."""
    if isinstance(path, Circle | FigureEight):
        lap_s = path.lap_s
    elif isinstance(path, Line):
        lap_s = path.swing_s
    else:
        return 0.0
    lap = (path.reference(lap_s * part / 64.0).accel_mps2 for part in range(64))
    return max(abs(axis) for accel in lap for axis in accel)


STUDIES_REFERENCES_M: tuple[Point, ...] = (
    (5.0, 0.0, 5.0),
    (0.0, 5.0, 6.0),
    (-5.0, 0.0, 7.0),
    (0.0, -5.0, 4.0),
    (4.0, 4.0, 8.0),
    (-4.0, 4.0, 3.0),
)
"""Where the vehicles of the studies' scenario hover, in order of agents."""


def default_path(slot: int, fleet_size: int) -> Waypoints:
    """What an agent without a path of its own does: hover at the studies' reference.

    Beyond six agents there is no such reference: they hover on a ring of 10 m.
    """
    if slot < len(STUDIES_REFERENCES_M):
        return Waypoints((STUDIES_REFERENCES_M[slot],))
    angle = 2.0 * math.pi * slot / fleet_size
    return Waypoints(((10.0 * math.cos(angle), 10.0 * math.sin(angle), 5.0),))


def standing(slot: int) -> Waypoints:
    """What a target without a path of its own does: stand on the ground, 10 m north of the one before it."""
    return Waypoints(((10.0 * slot, 0.0, 0.0),))


def moved_along(paths: Sequence[Path], time_s: float) -> tuple[Array, Array]:
    """Positions and velocities ``(m, 3)`` NED of bodies that are exactly where their paths are."""
    references = [path.reference(time_s) for path in paths]
    places = np.array([reference.position_m for reference in references], float).reshape(-1, 3)
    return places, np.array([reference.velocity_mps for reference in references], float).reshape(-1, 3)


def lqr_gain(period_s: float, state_weight: float = 1.0, input_weight: float = 1.0) -> Array:
    """Discrete linear-quadratic regulator of a double integrator whose input is held over ``period_s``.

    ``(3, 6)``: acceleration ``u = -K [p - p_ref, v - v_ref]``, the three axes apart.
    """
    a = np.array(((1.0, period_s), (0.0, 1.0)))
    b = np.array(((0.5 * period_s**2,), (period_s,)))
    cost = solve_discrete_are(a, b, state_weight * np.eye(2), np.array(((input_weight,),)))
    axis = np.linalg.solve(input_weight + b.T @ cost @ b, b.T @ cost @ a)
    return np.asarray(np.kron(axis, np.eye(3)), float)


def command(
    gain: Array, references: list[Reference], position_m: Array, velocity_mps: Array, limit_mps2: float
) -> Array:
    """Acceleration that each vehicle is told to fly, ``(n, 3)`` NED m/s^2, clipped per axis."""
    wanted = np.array([(*reference.position_m, *reference.velocity_mps) for reference in references])
    feed_forward = np.array([reference.accel_mps2 for reference in references])
    error = np.concatenate((position_m, velocity_mps), axis=1) - wanted
    return np.asarray(np.clip(feed_forward - error @ gain.T, -limit_mps2, limit_mps2))
