"""An autopilot's navigation as a Kalman filter that uses, refuses, resets and times out with the firmware's figures.

Per axis a position and a velocity, predicted with the measured acceleration. Positions from outside count at the
instant for which they are taken. A gate refuses them; the state is set to them when they announce a reset, when
nothing else holds it, or when they were refused for too long. Figures: PX4 1.16 in SIH and ArduCopter 4.7 in SITL.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from sim_bridge.autopilot.navigation import Navigation, OutsideState
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.quaternions import Array
from sim_bridge.world.sensors import GpsFix

ACCEL_SIGMA_MPS2 = 0.35
GPS_GATE, VELOCITY_GATE = 5.0, 3.0
START_SIGMA_M, START_SIGMA_MPS = 1.0, 0.5
REMEMBERED_S = 1.0
"""How old a position may be and still be put where it belongs."""
GPS_STOPPED_S = 1.0
"""Without a fix for so long, GPS holds nothing any more, and a feed that begins sets the state, unless the autopilot
counts on its receiver for longer (`LossFigures.gps_kept_s`)."""
GPS_SPEED_SIGMA_MPS = 0.3
OFFSET_DENSITY_M_PER_SQRT_S = 0.13
"""PX4 takes so fast a wander for a feed's own offset while it counts on its receiver."""
GPS_SIGMA_M = 0.5
"""EKF2_GPS_P_NOISE: no feed counts as better while GPS is used."""
LEAST_SIGMA_M, LEAST_SIGMA_MPS = 0.1, 0.1
BAROMETER_SIGMA_M, BAROMETER_EVERY_S, BAROMETER_SHARE = 0.5, 0.1, 0.05
"""While GPS gives heights, the barometer's offset follows them by this share of each sample."""


@dataclass(frozen=True, slots=True)
class LossFigures:
    """What follows so many seconds after the last position that was used."""

    flag_s: float
    """Its estimator no longer says that it has a position."""
    failsafe_s: float
    """It lands."""
    refused_s: float
    """Positions that were refused for so long are set, not fused, if nothing else holds the state."""
    gps_delay_s: float
    """Its own fixes are taken for so old when they come: EKF2_GPS_DELAY; ArduPilot's lag of a receiver."""
    returns_after_s: float | None
    """Its earlier mode comes back when it has positions again for so long; ``None``: it stays in LAND."""
    gps_kept_s: float = 0.0
    """So long after its last good fix it still counts on its receiver: meanwhile positions that are ``relative`` give
    it nothing but their motion, and the first one after that time is set."""
    gps_start_ratio: float = np.inf
    """A receiver that is back is left out while a feed holds the state and its ratios of both axes sum up to more."""


FIGURES: dict[FlavourName, LossFigures] = {
    "px4": LossFigures(
        flag_s=0.7,
        failsafe_s=4.5,
        refused_s=1.0,
        gps_delay_s=0.11,
        returns_after_s=2.0,
        gps_kept_s=7.0,
        gps_start_ratio=0.25,
    ),
    "ardupilot": LossFigures(flag_s=7.0, failsafe_s=8.0, refused_s=7.0, gps_delay_s=0.2, returns_after_s=None),
}


class FeedOffset:
    """What PX4 takes for the offset ``(3,)`` of a feed from its receiver, while it counts on that."""

    def __init__(self, offset_m: Array, at_s: float) -> None:
        self.offset_m = offset_m
        self.variance_m2: Array = np.zeros(3)
        self._at_s = at_s

    def follow(self, off_m: Array, variance_m2: Array, now: float) -> None:
        """A position came that is ``off_m`` from the state's, with the variance of both."""
        wander_m2 = OFFSET_DENSITY_M_PER_SQRT_S**2 * (now - self._at_s)
        self._at_s = now
        prior_m2 = np.minimum(self.variance_m2 + wander_m2, variance_m2)
        gain = prior_m2 / (prior_m2 + variance_m2)
        self.offset_m = self.offset_m + gain * (off_m - self.offset_m)
        self.variance_m2 = (1.0 - gain) * prior_m2


class FusingNavigation(Navigation):
    """Of one flavour; counters by name of what became of what came."""

    def __init__(self, flavour: FlavourName, oldest_s: float = REMEMBERED_S) -> None:
        """``oldest_s``: positions from outside that are older are left out."""
        super().__init__()
        self._oldest_s = min(oldest_s, REMEMBERED_S)
        self.figures = FIGURES[flavour]
        self.refused = self.resets = 0
        self._covariance: Array = np.zeros((3, 2, 2))
        """Of position and velocity, each axis."""
        self._past: deque[tuple[float, Array, Array]] = deque()
        self._ratio = 0.0
        self._gps_s = self._refused_since_s = -np.inf
        self._feed_s = self._speed_used_s = -np.inf
        self._reset_counter: int | None = None
        self._offset: FeedOffset | None = None
        self._barometer_off_m: float | None = None
        self._height_s = -np.inf

    def aided(self, now: float) -> bool:
        """Whether a position was used lately enough for this autopilot."""
        return self.origin_m is not None and self.unaided_s(now) <= self.figures.flag_s

    def ratio(self, now: float) -> float:
        """Of the last horizontal innovation and its gate; above 1 it was refused."""
        return self._ratio

    def set_origin(self, origin_m: Array) -> None:
        """Set the origin and start there."""
        super().set_origin(origin_m)
        self._covariance[:] = np.diag((START_SIGMA_M**2, START_SIGMA_MPS**2))

    def predict(self, accel_ned_mps2: Array, now: float) -> None:
        """Integrate the measured acceleration ``(3,)`` NED, gravity removed, up to now."""
        before_s = self._predicted_s
        super().predict(accel_ned_mps2, now)
        if before_s is None or self.origin_m is None:
            return
        step_s = now - before_s
        move = np.array(((1.0, step_s), (0.0, 1.0)))
        noise = np.array((0.5 * step_s**2, step_s))
        self._covariance = move @ self._covariance @ move.T + ACCEL_SIGMA_MPS2**2 * np.outer(noise, noise)
        self._past.append((now, self.position_m, self.velocity_mps))
        while now - self._past[0][0] > REMEMBERED_S:
            self._past.popleft()

    def on_fix(self, fix: GpsFix, now: float) -> None:
        """Use a valid fix of the autopilot's own receiver."""
        sigmas = np.maximum((fix.h_acc_m, fix.h_acc_m, fix.v_acc_m), LEAST_SIGMA_M)
        position, velocity = np.array(fix.position_ned_m), np.array(fix.velocity_ned_mps)
        if self.origin_m is None:
            self.set_origin(position)
            self.velocity_mps = velocity
        alone = now - self._feed_s > GPS_STOPPED_S
        taken_s = now - self.figures.gps_delay_s
        if not alone and now - self._gps_s > self.figures.gps_kept_s:
            variance_m2 = self._covariance[:2, 0, 0] + sigmas[:2] ** 2
            ratio = np.sum((position - self._at(taken_s)[0])[:2] ** 2 / (GPS_GATE**2 * variance_m2))
            if ratio > self.figures.gps_start_ratio:
                self.refused += 1
                return
        if self._use(position, velocity, sigmas, np.full(3, GPS_SPEED_SIGMA_MPS), taken_s, now, alone, GPS_GATE):
            self._gps_s = now

    def on_height(self, down_m: float, now: float) -> None:
        """Use the height of its barometer: about that of GPS while there is one, as it was then without."""
        if self.origin_m is None or now - self._height_s < BAROMETER_EVERY_S:
            return
        self._height_s = now
        off_m = down_m - float(self.position_m[2])
        if self._barometer_off_m is None:
            self._barometer_off_m = off_m
        elif now - self._gps_s <= GPS_STOPPED_S:
            self._barometer_off_m += BAROMETER_SHARE * (off_m - self._barometer_off_m)
        else:
            sigmas = np.array((np.inf, np.inf, BAROMETER_SIGMA_M))
            self._fuse(0, np.array((0.0, 0.0, off_m - self._barometer_off_m)), sigmas)

    def on_outside(self, outside: OutsideState, now: float) -> None:
        """Use a position from outside."""
        if self.origin_m is None:
            return
        if now - outside.taken_s > self._oldest_s:
            self.refused += 1
            return
        announced = self._reset_counter is not None and outside.reset_counter != self._reset_counter
        self._reset_counter = outside.reset_counter
        if outside.relative and now - self._gps_s <= self.figures.gps_kept_s:
            self._use_motion(outside, announced, now)
            return
        counted, self._offset = self._offset is not None, None
        alone = now - self._gps_s > GPS_STOPPED_S
        begins = alone and (now - self._feed_s > GPS_STOPPED_S or counted)
        if begins or (announced and alone):
            self._set(outside.position_m, outside.velocity_mps, outside.taken_s, now)
            self._feed_s = now
            return
        sigmas = np.maximum(outside.position_sigma_m, LEAST_SIGMA_M)
        self._use_fed(outside, outside.position_m, sigmas, alone, now)

    def _use_motion(self, outside: OutsideState, announced: bool, now: float) -> None:
        """Use a position that is counted from where the state was when it began, less what drifts of that."""
        then_m, _ = self._at(outside.taken_s)
        off_m = np.where(np.isfinite(outside.position_m), outside.position_m - then_m, 0.0)
        sigmas = np.maximum(outside.position_sigma_m, GPS_SIGMA_M)
        if self._offset is None or announced or now - self._feed_s > GPS_STOPPED_S:
            self._offset = FeedOffset(off_m, now)
        offset = self._offset
        before_m = offset.offset_m
        sigmas = np.sqrt(sigmas**2 + offset.variance_m2)
        offset.follow(off_m, sigmas**2 + self._covariance[:, 0, 0], now)
        self._use_fed(outside, outside.position_m - before_m, sigmas, False, now)

    def _use_fed(self, outside: OutsideState, place_m: Array, sigmas: Array, alone: bool, now: float) -> None:
        speeds = np.maximum(outside.velocity_sigma_mps, LEAST_SIGMA_MPS)
        if self._use(place_m, outside.velocity_mps, sigmas, speeds, outside.taken_s, now, alone, outside.gate):
            self._feed_s = now

    def _use(
        self,
        position_m: Array,
        velocity_mps: Array | None,
        sigma_m: Array,
        sigma_mps: Array,
        taken_s: float,
        now: float,
        alone: bool,
        gate: float,
    ) -> bool:
        """Fuse a position (and velocity) taken at ``taken_s``, or refuse it; whether it was used."""
        then_m, then_mps = self._at(taken_s)
        given = np.isfinite(position_m)
        off_m = np.where(given, position_m - then_m, 0.0)
        sigma_m = np.where(given, sigma_m, np.inf)
        limit = gate**2 * (self._covariance[:, 0, 0] + sigma_m**2)
        self._ratio = float(np.max((off_m**2 / limit)[:2]))
        if self._ratio > 1.0:
            self.refused += 1
            self._refused_since_s = now if self._refused_since_s == -np.inf else self._refused_since_s
            forsaken = self.unaided_s(now) > self.figures.failsafe_s  # it begins anew with what comes
            if not (forsaken or (alone and now - self._refused_since_s >= self.figures.refused_s)):
                return False
            self._set(position_m, velocity_mps, taken_s, now)
            return True
        self._refused_since_s = -np.inf
        self._fuse(0, off_m, sigma_m)
        if velocity_mps is not None and np.isfinite(velocity_mps).all():
            self._use_velocity(velocity_mps - then_mps, sigma_mps, now)
        self._aided_s = now
        return True

    def _use_velocity(self, off_mps: Array, sigma_mps: Array, now: float) -> None:
        """Fuse a velocity, axis by axis; one that was refused for too long is set."""
        within = off_mps**2 <= VELOCITY_GATE**2 * (self._covariance[:, 1, 1] + sigma_mps**2)
        if within.all():
            self._speed_used_s = now
        elif now - self._speed_used_s >= self.figures.refused_s:
            self._shift(np.zeros(3), off_mps)
            self._covariance[:, 1, 1] += START_SIGMA_MPS**2
            self._speed_used_s = now
            return
        self._fuse(1, off_mps, np.where(within, sigma_mps, np.inf))

    def _fuse(self, row: int, off: Array, sigma: Array) -> None:
        """One Kalman update per axis; an infinite sigma changes nothing."""
        covariance = self._covariance
        gain = covariance[:, :, row] / (covariance[:, row, row] + sigma**2)[:, None]
        self._covariance = covariance - gain[:, :, None] * covariance[:, None, row, :]
        shift_m, shift_mps = gain[:, 0] * off, gain[:, 1] * off
        self._shift(shift_m, shift_mps)

    def _shift(self, shift_m: Array, shift_mps: Array) -> None:
        """Correct the state, and what is remembered of it, so that the next innovation knows."""
        self.position_m = self.position_m + shift_m
        self.velocity_mps = self.velocity_mps + shift_mps
        self._past = deque((t, p + shift_m, v + shift_mps) for t, p, v in self._past)

    def _set(self, position_m: Array, velocity_mps: Array | None, taken_s: float, now: float) -> None:
        """A reset: the state is what came, carried on to now."""
        then_m, then_mps = self._at(taken_s)
        shift_mps = np.zeros(3) if velocity_mps is None else velocity_mps - then_mps
        off_m = np.where(np.isfinite(position_m), position_m - then_m, 0.0)
        self._shift(off_m + (now - taken_s) * shift_mps, shift_mps)
        self._covariance[:] = np.diag((START_SIGMA_M**2, START_SIGMA_MPS**2))
        self._refused_since_s = -np.inf
        self._aided_s = now
        self.resets += 1

    def _at(self, taken_s: float) -> tuple[Array, Array]:
        """Its position and velocity at an instant that it remembers, the nearest one."""
        if not self._past:
            return self.position_m, self.velocity_mps
        _, position_m, velocity_mps = min(self._past, key=lambda each: abs(each[0] - taken_s))
        return position_m, velocity_mps
