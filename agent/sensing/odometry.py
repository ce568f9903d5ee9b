"""Velocities of other sensors than the receiver: cameras, optical flow, wheels; turned into NED and looked after.

Such a sensor measures in the body's axes as a rule, so that the attitude of the instant turns what it says. It is as
good as it claims until it loses its picture or its wheels slip: what contradicts the estimate for seconds is left out
until it agrees again, as fixes are. Its errors last from sample to sample (scale, mounting, a picture without
features): few of its samples are used, none taken for surer than `SIGMA_FLOOR_MPS` and a share of the speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agent.sensing.frames import rotated
from agent.sensing.samples import FlowSample, Triple, VelocitySample
from agent.sensing.timeline import Orientation
from estimators.integrity.thresholds import AGREEING_SQUARE, IGNORED_SQUARE

INTERVAL_S = 0.2
"""Between measurements that are used, of one sensor."""
SIGMA_FLOOR_MPS = 0.1
"""1-sigma at least, whatever the sensor claims."""
TURNED = 0.05
"""Of the speed: what attitude, mounting and scale leave in doubt."""
UNSEEN_MPS = 2.0
"""1-sigma about zero of what an axis that is not measured has, where it shows in others by tilt."""
LEAST_SHARE = 0.7
"""Of an axis of NED that has to lie in measured ones: it is taken as measured then."""
HELD_S = 3.0
"""No sensor of a moving body says the same for longer, to the last digit."""
MEMORY_S = 3.0
"""Of the average that tells whether a sensor agrees with the estimate."""
LARGEST_SQUARE = 10.0
"""A sample counts as this at most in it."""
LONGEST_S = 1.0
"""An estimate that is older is not compared with."""
MANOEUVRE_MPS2 = 3.0
"""How much a drone may have accelerated since the estimate, 1-sigma."""
DISTANCE_SHARE = 0.1
"""1-sigma of the distance to the ground, of it."""


_AXES: tuple[Triple, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Motion:
    """Own velocity by the estimate of an instant: NED m/s, and its variances."""

    t_s: float
    velocity_mps: Triple
    variance_m2ps2: Triple


@dataclass(frozen=True, slots=True)
class MeasuredVelocity:
    """A velocity NED m/s and its variances per axis, inf where it was not measured."""

    velocity_mps: Triple
    variance_m2ps2: Triple


def in_ned(sample: VelocitySample, orientation: Orientation | None) -> MeasuredVelocity | str:
    """A sample turned into NED, or why it cannot be.

    The variances of turned axes hang together; each is given so large that all together claim no more than is known.
    """
    seen = np.isfinite(sample.sigma_mps)
    velocity = np.where(seen, sample.velocity_mps, 0.0)
    turned_mps = TURNED * float(np.linalg.norm(velocity))
    sigma = np.where(seen, np.hypot(np.maximum(sample.sigma_mps, SIGMA_FLOOR_MPS), turned_mps), UNSEEN_MPS)
    turn = np.eye(3)
    if sample.in_body:
        if orientation is None:
            return "attitude unknown"
        turn = np.array([rotated(orientation.quaternion, axis) for axis in _AXES]).T
    covariance = (turn * sigma**2) @ turn.T
    measured = (turn**2 @ seen.astype(float)) >= LEAST_SHARE
    if not measured.any():
        return "nothing measured"
    covariance = covariance * measured[:, None] * measured[None, :]
    variance = np.where(measured, np.abs(covariance).sum(axis=1), np.inf)
    north, east, down = (turn @ velocity).tolist()
    return MeasuredVelocity((north, east, down), (float(variance[0]), float(variance[1]), float(variance[2])))


def over_ground(sample: FlowSample, distance_m: float) -> VelocitySample:
    """What flow tells of the velocity at a distance of the ground along the camera's axis."""
    forward, right = (distance_m * each for each in sample.passing_radps)
    spread = math.hypot(distance_m * sample.sigma_radps, DISTANCE_SHARE * math.hypot(forward, right))
    return VelocitySample(sample.t_s, (forward, right, 0.0), (spread, spread, math.inf), in_body=True)


class Odometer:
    """Looks after the velocities of one sensor."""

    def __init__(self) -> None:
        self._given_s = -math.inf
        self._last: Triple | None = None
        self._changed_s = -math.inf
        """When it last said something else than before."""
        self._square = 1.0
        """Average of its normalised squared differences from the estimate."""
        self._judged_s: float | None = None
        self._contradicts = False

    def take(
        self, sample: VelocitySample, orientation: Orientation | None, motion: Motion | None
    ) -> MeasuredVelocity | str:
        """What a sample tells, or why it is not used; ``orientation`` at its instant, ``motion`` of late."""
        if self._is_held(sample):
            return "always the same"
        if not self._is_due(sample.t_s):
            return "more than are needed"
        measured = in_ned(sample, orientation)
        if isinstance(measured, str):
            return measured
        return measured if self._agrees(sample.t_s, measured, motion) else "contradicts the estimate"

    def _is_held(self, sample: VelocitySample) -> bool:
        """Whether it has said the same for too long for a body that moves."""
        if sample.velocity_mps != self._last or sample.t_s < self._changed_s:
            self._last, self._changed_s = sample.velocity_mps, sample.t_s
        return any(sample.velocity_mps) and sample.t_s - self._changed_s > HELD_S

    def _is_due(self, t_s: float) -> bool:
        if 0.0 <= t_s - self._given_s < 0.99 * INTERVAL_S:
            return False
        self._given_s = t_s
        return True

    def _agrees(self, t_s: float, measured: MeasuredVelocity, motion: Motion | None) -> bool:
        """Whether the sensor is to be believed, this sample taken in."""
        if motion is None or abs(t_s - motion.t_s) > LONGEST_S:
            return not self._contradicts
        moved = (MANOEUVRE_MPS2 * (t_s - motion.t_s)) ** 2
        told, known = (measured.velocity_mps, measured.variance_m2ps2), (motion.velocity_mps, motion.variance_m2ps2)
        squares = [
            (value - expected) ** 2 / (variance + doubt + moved)
            for value, variance, expected, doubt in zip(*told, *known, strict=True)
            if variance < math.inf
        ]
        elapsed_s = INTERVAL_S if self._judged_s is None else max(t_s - self._judged_s, 0.0)
        share = 1.0 - math.exp(-elapsed_s / MEMORY_S)
        self._square += share * (min(sum(squares) / len(squares), LARGEST_SQUARE) - self._square)
        self._judged_s = t_s
        self._contradicts = self._square > (AGREEING_SQUARE if self._contradicts else IGNORED_SQUARE)
        return not self._contradicts
