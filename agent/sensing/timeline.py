"""From samples to ticks: which tick an instant belongs to, and the acceleration averaged over each tick.

Tick k holds the instants from ``k T`` to ``(k+1) T`` of fleet time. The IMU is rotated to NED with the
attitude at its own time, gravity is removed, and the acceleration is integrated over the tick (linear
between samples). Silence longer than the configured gap is not bridged: the mean of the rest stands in for
it, with a variance that says so.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import TypeVar

from agent.config.tables import SensorsTable
from agent.sensing.frames import interpolated, rotated
from agent.sensing.samples import AttitudeSample, ImuSample, Quaternion, Triple
from estimators.model.unknown_motion import TILTED_MPS2

TICK_ROUNDING = 1e-6
"""Instants this share of a tick before a tick's start belong to it: k T is not exact in floating point."""
KEEP_S = 1.0
MAX_SAMPLES = 4096
ACCEL_GAP_SIGMA_MPS2 = 1.1547
"""1-sigma of the acceleration while no IMU sample came: uniform in +-2 m/s2, as of other drones by default."""
ATTITUDE_MAX_AGE_S = 0.3
"""An IMU sample without an attitude this close is a gap: carried further with the turn rate, tilt errors show."""
PINNED_SAMPLES = 6
"""So many samples in a row with one and the same large component: the accelerometer is at its limit, or hangs."""
NOISE_STEPS = 5.0
"""A component changes by more of its own steps than this on average, or it repeats by chance, as that of an IMU whose
values come in thousandths of g."""
USUAL_SHARE = 0.02
"""Of a sample in the average change."""
PINNED_MPS2 = 4.0
"""Components below this are no limit, and where values come in steps they may well repeat."""
_Sample = TypeVar("_Sample", ImuSample, AttitudeSample)
_time_of = attrgetter("t_s")


def tick_of(t_s: float, period_s: float) -> int:
    """The tick that an instant of fleet time belongs to."""
    return math.floor(t_s / period_s + TICK_ROUNDING)


def nearest_tick(t_s: float, period_s: float) -> int:
    """The tick whose start is nearest to an instant of fleet time."""
    return math.floor(t_s / period_s + 0.5)


@dataclass(frozen=True, slots=True)
class TickInput:
    """Acceleration averaged over a tick, NED m/s2 with its variance per axis in (m/s2)2.

    ``coverage`` is the share of the tick that IMU samples vouch for, 0 with an acceleration of zero if none.
    """

    tick: int
    accel_mps2: Triple
    variance: Triple
    coverage: float
    samples: int
    aided: bool = True
    """Whether the attitudes were those of an autopilot with positions."""


@dataclass(frozen=True, slots=True)
class Orientation:
    """How a body lies and turns at an instant: the quaternion into NED, the turn rate in body rad/s."""

    quaternion: Quaternion
    rate_radps: Triple


class _Limit:
    """Notices an accelerometer at its limit: a component that had noise stays what it is, and large."""

    def __init__(self) -> None:
        self._last: Triple = (math.nan, math.nan, math.nan)
        self._times = [0, 0, 0]
        """How often each component has been what it is, in a row."""
        self._least = [math.inf, math.inf, math.inf]
        """Smallest change of each from sample to sample: the step in which its values come."""
        self._usual = [0.0, 0.0, 0.0]
        """Average change of each of late, m/s2."""

    def take(self, force_mps2: Triple) -> bool:
        """The next sample's specific force in the body's axes; whether it is at the limit.

        One that is the last one again in all axes is held, not measured anew: it tells nothing.
        """
        if force_mps2 == self._last:
            return any(self._holds(axis) for axis in range(3))
        for axis, value in enumerate(force_mps2):
            change = abs(value - self._last[axis])
            self._times[axis] = 1 if change != 0.0 else self._times[axis] + 1
            if change > 0.0:
                self._least[axis] = min(self._least[axis], change)
            if change >= 0.0 and self._times[axis] < PINNED_SAMPLES:
                self._usual[axis] += USUAL_SHARE * (change - self._usual[axis])
        self._last = force_mps2
        return any(self._holds(axis) for axis in range(3))

    def is_at(self, force_mps2: Triple) -> bool:
        """Whether an earlier sample is of the same run."""
        return any(self._holds(axis) and value == self._last[axis] for axis, value in enumerate(force_mps2))

    def _holds(self, axis: int) -> bool:
        noisy = self._usual[axis] > NOISE_STEPS * self._least[axis]
        return noisy and self._times[axis] >= PINNED_SAMPLES and abs(self._last[axis]) >= PINNED_MPS2


class Timeline:
    """The IMU and attitude samples of the last moments.

    Each sample is counted once, in ``used`` by sensor or in ``skipped`` by reason: one of the IMU when the tick that
    it lies in is closed, or when it comes if that was before. ``waiting`` are those whose tick is not closed yet.
    """

    def __init__(self, period_s: float, gravity_mps2: float, sensors: SensorsTable) -> None:
        self._period_s = period_s
        self._gravity_mps2 = gravity_mps2
        self._sensors = sensors
        self._imu: list[ImuSample] = []
        self._attitudes: list[AttitudeSample] = []
        self._closed_until_s = -math.inf
        self._limit = _Limit()
        self.used: Counter[str] = Counter()
        self.skipped: Counter[str] = Counter()

    @property
    def waiting(self) -> int:
        """IMU samples that lie in no tick closed so far."""
        return len(self._imu) - bisect_left(self._imu, self._closed_until_s, key=_time_of)

    def add_imu(self, sample: ImuSample) -> None:
        """Take in an IMU sample, in any order; those of an accelerometer at its limit are as good as none."""
        if self._limit.take(sample.specific_force_mps2):
            before = self.waiting
            self._imu = [kept for kept in self._imu if not self._limit.is_at(kept.specific_force_mps2)]
            self.skipped["imu: at its limit"] += 1 + before - self.waiting
        elif sample.t_s < self._closed_until_s - self._sensors.imu_max_gap_s:
            self.skipped["imu: late"] += 1
        elif not _insert(self._imu, sample):
            self.skipped["imu: duplicate"] += 1
        else:
            self.used["imu"] += sample.t_s < self._closed_until_s  # it still lends itself to the next tick
            self._make_room()

    def add_attitude(self, sample: AttitudeSample) -> None:
        """Take in an attitude sample, in any order."""
        if not _insert(self._attitudes, sample):
            self.skipped["attitude: duplicate"] += 1
            return
        self.used["attitude"] += 1
        if len(self._attitudes) > MAX_SAMPLES:
            del self._attitudes[0]

    def close(self, tick: int) -> TickInput:
        """The input of a tick, from what has come in so far; ticks are closed in ascending order."""
        start_s, end_s = tick * self._period_s, (tick + 1) * self._period_s
        accelerations = self._accelerations(start_s, end_s)
        self._judge(accelerations, start_s, end_s)
        points = [(t, a) for t, a in accelerations if a is not None]
        covered_s, integral = self._integral(points, start_s, end_s)
        self._closed_until_s = end_s
        self._forget(start_s - KEEP_S)
        inside = len([t for t, _ in points if start_s <= t < end_s])
        if covered_s <= 0.0:
            spread = ACCEL_GAP_SIGMA_MPS2**2 + self._sensors.accel_sigma_mps2**2
            return TickInput(tick, (0.0, 0.0, 0.0), (spread, spread, spread), 0.0, 0)
        coverage = min(covered_s / self._period_s, 1.0)
        uncovered = 1.0 - coverage if 1.0 - coverage > TICK_ROUNDING else 0.0
        aided = all(sample.aided for sample in self._attitudes if start_s <= sample.t_s < end_s)
        tilted = 0.0 if aided else TILTED_MPS2**2
        variance = self._sensors.accel_sigma_mps2**2 + (uncovered * ACCEL_GAP_SIGMA_MPS2) ** 2 + tilted
        north, east, down = (component / covered_s for component in integral)
        return TickInput(tick, (north, east, down), (variance, variance, variance), coverage, inside, aided)

    def orientation_at(self, t_s: float) -> Orientation | None:
        """How the body lies and turns at an instant; ``None`` without an attitude close enough."""
        rate = self._rate_at(t_s)
        quaternion = self.attitude_at(t_s, rate)
        return None if quaternion is None else Orientation(quaternion, rate)

    def _rate_at(self, t_s: float) -> Triple:
        """The turn rate of the nearest IMU sample, body rad/s; zero where there is none of late."""
        after = bisect_left(self._imu, t_s, key=_time_of)
        near = [s for s in self._imu[max(after - 1, 0) : after + 1] if abs(s.t_s - t_s) <= ATTITUDE_MAX_AGE_S]
        return min(near, key=lambda s: abs(s.t_s - t_s)).gyro_radps if near else (0.0, 0.0, 0.0)

    def _judge(self, accelerations: list[tuple[float, Triple | None]], start_s: float, end_s: float) -> None:
        """Count the IMU samples of a tick, and those before it that lie in none."""
        first = bisect_left(self._imu, self._closed_until_s, key=_time_of)
        left_out = bisect_left(self._imu, start_s, key=_time_of) - first
        if left_out > 0:
            self.skipped["imu: in no tick"] += left_out
        inside = [a for t, a in accelerations if max(start_s, self._closed_until_s) <= t < end_s]
        without = sum(a is None for a in inside)
        if without:
            self.skipped["imu: no attitude"] += without
        self.used["imu"] += len(inside) - without

    def _make_room(self) -> None:
        """Let the oldest sample go where there are too many."""
        if len(self._imu) > MAX_SAMPLES:
            self.skipped["imu: more than can be held"] += self._imu[0].t_s >= self._closed_until_s
            del self._imu[0]

    def attitude_at(self, t_s: float, gyro_radps: Triple) -> Quaternion | None:
        """The attitude at an instant; ``None`` without a sample close enough.

        Between two samples it is interpolated; beside one it is carried there with the turn rate.
        """
        after = bisect_left(self._attitudes, t_s, key=_time_of)
        limit_s = ATTITUDE_MAX_AGE_S
        before = self._attitudes[after - 1] if after > 0 else None
        behind = self._attitudes[after] if after < len(self._attitudes) else None
        if before is not None and behind is not None and behind.t_s - before.t_s <= limit_s:
            share = (t_s - before.t_s) / (behind.t_s - before.t_s)
            return interpolated(before.quaternion, behind.quaternion, share)
        near = [s for s in (before, behind) if s is not None and abs(t_s - s.t_s) <= limit_s]
        if not near:
            return None
        nearest = min(near, key=lambda s: abs(t_s - s.t_s))
        return _turned(nearest.quaternion, gyro_radps, t_s - nearest.t_s)

    def _accelerations(self, start_s: float, end_s: float) -> list[tuple[float, Triple | None]]:
        """(time, NED acceleration) of the samples in a tick and of the next ones on either side."""
        first = bisect_left(self._imu, start_s, key=_time_of)
        last = bisect_left(self._imu, end_s, key=_time_of)
        return [(s.t_s, self._acceleration(s)) for s in self._imu[max(first - 1, 0) : last + 1]]

    def _acceleration(self, sample: ImuSample) -> Triple | None:
        attitude = self.attitude_at(sample.t_s, sample.gyro_radps)
        if attitude is None:
            return None
        north, east, down = rotated(attitude, sample.specific_force_mps2)
        return north, east, down + self._gravity_mps2

    def _integral(self, points: list[tuple[float, Triple]], start_s: float, end_s: float) -> tuple[float, Triple]:
        """Covered time in s and integral in m/s over a tick."""
        gap_s = self._sensors.imu_max_gap_s
        covered_s, north, east, down = 0.0, 0.0, 0.0, 0.0
        if not points:
            return covered_s, (north, east, down)
        # Before the first and after the last sample the nearest one holds, for as long as a gap may be.
        held = [(points[0][0] - gap_s, points[0][1]), *points, (points[-1][0] + gap_s, points[-1][1])]
        for (t0, a0), (t1, a1) in pairwise(held):
            low = t0 if t0 > start_s else start_s
            high = t1 if t1 < end_s else end_s
            if high <= low or t1 - t0 > gap_s * (1 + TICK_ROUNDING):
                continue
            middle, part_s = ((low + high) / 2 - t0) / (t1 - t0), high - low
            covered_s += part_s
            north += part_s * (a0[0] + middle * (a1[0] - a0[0]))
            east += part_s * (a0[1] + middle * (a1[1] - a0[1]))
            down += part_s * (a0[2] + middle * (a1[2] - a0[2]))
        return covered_s, (north, east, down)

    def _forget(self, before_s: float) -> None:
        del self._imu[: bisect_left(self._imu, before_s, key=_time_of)]
        # The last attitude before stays: the next ones are interpolated from it.
        del self._attitudes[: max(bisect_left(self._attitudes, before_s, key=_time_of) - 1, 0)]


def _insert(samples: list[_Sample], sample: _Sample) -> bool:
    """Put a sample in its place; false if that instant is taken already."""
    if not samples or sample.t_s > samples[-1].t_s:  # as nearly all
        samples.append(sample)
    else:
        index = bisect_left(samples, sample.t_s, key=_time_of)
        if samples[index].t_s == sample.t_s:
            return False
        samples.insert(index, sample)
    return True


def _turned(quaternion: Quaternion, gyro_radps: Triple, duration_s: float) -> Quaternion:
    """The attitude after turning with constant body rates for a while (negative = before)."""
    rate = math.sqrt(sum(component * component for component in gyro_radps))
    if rate == 0.0:
        return quaternion
    half = 0.5 * rate * duration_s
    cosine, scale = math.cos(half), math.sin(half) / rate
    w, x, y, z = quaternion
    a, b, c = (component * scale for component in gyro_radps)
    return (
        w * cosine - x * a - y * b - z * c,
        w * a + x * cosine + y * c - z * b,
        w * b - x * c + y * cosine + z * a,
        w * c + x * b - y * a + z * cosine,
    )
