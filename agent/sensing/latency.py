"""How late the sensors are: profiles by autopilot, and the latency of GPS learned in flight and applied.

A latency is how much older a value is than its stamp. Fixes come with a prior of it (`gps_prior`); `GpsLatency`
runs the filters of `estimators.calibration.latency` beside the fleet's estimator, on the averaged accelerations
of the ticks, and moves each fix to the instant that it is of.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from typing import Literal

from agent.config.tables import SensorsTable
from agent.sensing.samples import GpsSample, LatencyPrior
from agent.sensing.timeline import TickInput
from estimators.calibration.latency import AccelerationHistory, FixOutcome, LatencyEstimator, TimedFix
from estimators.integrity.latency_doubt import FixTiming

Stamp = Literal["boot", "utc", "arrival"]
"""What the time of a fix is: the autopilot's boot clock, the receiver's UTC, or the arrival of the message."""

_GPS: dict[str, dict[Stamp, tuple[float, float]]] = {
    "ardupilot": {"boot": (0.10, 0.04), "utc": (0.0, 0.05), "arrival": (0.25, 0.08)},
    "px4": {"boot": (0.05, 0.06), "utc": (0.0, 0.05), "arrival": (0.12, 0.07)},
    "other": {"boot": (0.10, 0.06), "utc": (0.0, 0.05), "arrival": (0.20, 0.10)},
}
"""Latency and 1-sigma in s. With its boot clock an autopilot stamps when its driver has the fix. The instant that the
fix is of was before that: 0.12 s with current u-blox receivers in ArduPilot's experience, 0.11 s in PX4's, 0.085 s in
ArduPilot's simulation, nothing in PX4's. Messages leave up to a period later still."""
_IMU_S = {"ardupilot": 0.0125, "px4": 0.0, "other": 0.0}
"""ArduPilot sends filtered values with the time of sending."""

KEEP_S = 5.0
"""Accelerations are kept for so long: fixes that come later than a few seconds after their instant teach nothing."""
MAX_PERIOD_S = 0.25
"""A longer tick's mean acceleration says too little about when the velocity changed: nothing is estimated."""
MAX_WAITING = 64


def gps_prior(flavour: str, stamp: Stamp, sensors: SensorsTable) -> LatencyPrior:
    """What is known beforehand of a fix's latency: as configured, else by autopilot and kind of stamp.

    ``flavour`` is ``ardupilot``, ``px4`` or anything else.
    """
    latency_s, sigma_s = _GPS.get(flavour, _GPS["other"])[stamp]
    if sensors.gps_latency_s is not None:
        latency_s, sigma_s = sensors.gps_latency_s, 0.0
    if sensors.gps_latency_sigma_s is not None:
        sigma_s = sensors.gps_latency_sigma_s
    return LatencyPrior(f"{flavour} {stamp}", latency_s, sigma_s)


def imu_latency_s(flavour: str, sensors: SensorsTable) -> float:
    """Latency of IMU samples: as configured, else by autopilot."""
    configured = sensors.imu_latency_s
    return _IMU_S.get(flavour, _IMU_S["other"]) if configured is None else configured


@dataclass(slots=True)
class _Source:
    """One kind of fix: what is known of its latency, and fixes that wait for the acceleration of their time."""

    estimator: LatencyEstimator
    waiting: deque[TimedFix] = field(default_factory=lambda: deque(maxlen=MAX_WAITING))


class GpsLatency:
    """The latency of one drone's fixes; ``counters`` holds by name what became of them in the estimation.

    Each kind of fix (`LatencyPrior`) is estimated by itself, so that a receiver whose stamps become valid in flight
    confuses nothing. A latency that is exactly known, or not to be estimated, stays as it is.
    """

    def __init__(self, period_s: float, sensors: SensorsTable) -> None:
        self._period_s = period_s
        self._enabled = sensors.estimate_latency and period_s <= MAX_PERIOD_S
        self._sources: dict[LatencyPrior, _Source] = {}
        self._current: LatencyPrior | None = None
        self._history = AccelerationHistory(KEEP_S)
        self._accel_mps2 = 0.0
        self.timing: FixTiming | None = None
        """How well it is known when the latest fix was taken; ``None`` before the first."""
        self.counters: Counter[str] = Counter()

    @property
    def latency_s(self) -> float | None:
        """Latency of the kind of fix that came last; ``None`` before the first."""
        return None if self._current is None else self._known(self._current)[0]

    @property
    def sigma_s(self) -> float | None:
        """1-sigma of ``latency_s``: the prior's without manoeuvres, 0 if it is known exactly."""
        return None if self._current is None else self._known(self._current)[1]

    def taken_s(self, sample: GpsSample) -> float:
        """Fleet time of the instant that a fix is of, as far as that is known by now."""
        return sample.t_s - self._known(sample.latency)[0]

    def on_fix(self, sample: GpsSample) -> GpsSample:
        """Take in a fix; it comes back at the instant that it is of, as far as that is known by now.

        An error of the latency shifts it along the track: with velocity v and acceleration a the covariances grow by
        ``v v' sigma^2`` and ``a a' sigma^2``, at most ``|v|^2 sigma^2`` and ``|a|^2 sigma^2`` in any direction,
        which is what the (isotropic) accuracies of the fix get.
        """
        prior = self._current = sample.latency
        if self._enabled and prior.sigma_s > 0.0:
            if prior not in self._sources:
                self._sources[prior] = _Source(LatencyEstimator(prior.latency_s, prior.sigma_s, self._history))
            self._sources[prior].waiting.append(_fix(sample))
        latency_s, sigma_s = self._known(prior)
        speed_mps = self._speed_mps(sample)
        self.timing = FixTiming(sigma_s, speed_mps, sample.horizontal_sigma_m, refused=False)
        return replace(
            sample,
            t_s=sample.t_s - latency_s,
            horizontal_sigma_m=math.hypot(sample.horizontal_sigma_m, speed_mps * sigma_s),
            speed_sigma_mps=math.hypot(sample.speed_sigma_mps, self._accel_mps2 * sigma_s),
        )

    def on_tick(self, closed: TickInput) -> None:
        """Take in the acceleration of a tick (in ascending order), and the fixes that waited for it."""
        north, east, _ = closed.accel_mps2
        self._accel_mps2 = math.hypot(north, east)
        start_s = closed.tick * self._period_s
        self._history.add(start_s, start_s + self._period_s, (north, east), closed.variance[0])
        refused = False
        for source in self._sources.values():
            while source.waiting and source.estimator.ready(source.waiting[0].stamp_s):
                refused |= self._estimate(source.estimator, source.waiting.popleft()) is FixOutcome.REJECTED
        if self.timing is not None:
            self.timing = replace(self.timing, refused=refused)

    def _estimate(self, estimator: LatencyEstimator, fix: TimedFix) -> FixOutcome | None:
        try:
            outcome = estimator.update(fix)
        except ValueError:  # not finite, or out of order
            self.counters["unusable"] += 1
            return None
        self.counters[outcome.name.lower()] += 1
        return outcome

    def _known(self, prior: LatencyPrior) -> tuple[float, float]:
        source = self._sources.get(prior)
        if source is None:
            return prior.latency_s, prior.sigma_s
        return source.estimator.latency_s, source.estimator.sigma_s

    def _speed_mps(self, sample: GpsSample) -> float:
        """Speed, over ground where the receiver gives that; without any, as estimated from the positions."""
        if sample.ground_velocity_mps is not None:
            return math.hypot(*sample.ground_velocity_mps)
        if sample.speed_mps is not None:
            return sample.speed_mps
        source = self._sources.get(sample.latency)
        return 0.0 if source is None else math.hypot(*source.estimator.velocity_mps)


def _fix(sample: GpsSample) -> TimedFix:
    north, east, _ = sample.position_m
    variances = sample.horizontal_sigma_m**2, sample.speed_sigma_mps**2
    return TimedFix(sample.t_s, (north, east), variances[0], sample.ground_velocity_mps, variances[1])
