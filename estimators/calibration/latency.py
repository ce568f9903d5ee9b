"""The latency of a position sensor, estimated beside the drone's motion by a small bank of filters.

A receiver stamps a fix with ``t``, but position and velocity are those of ``t - tau``. What tells the latency
``tau`` from an offset of the position is a manoeuvre: an inertial sensor, whose timing is known, says when the
velocity changed, and the fixes say so ``tau`` later.

*Given* tau the problem is linear, in horizontal NED and SI units::

    x = [p(2), v(2), b(2), psi]
    p' = v + wander          position in the receiver's own frame, which wanders against the ground
    v' = a + J a psi - b     a measured; J a is a turned by 90 degrees, psi a small heading error
    b, psi                   first-order Gauss-Markov
    z_p = p(t - tau) + noise,   z_v = v(t - tau) + noise

so a Kalman filter is run for each tau of a grid over the prior, and its innovations weigh it (multiple-model
estimation, Magill 1965). The filters differ in their means alone: their covariance does not depend on tau (but for
the heading's coupling, for which the weighted mean serves).

In steady flight all filters have the same innovations, but for the noise of the acceleration, which each sees at
another time and which by chance favours one of them. Against this the acceleration is smoothed, and a fix counts by
how much the acceleration about it exceeds its errors: a hovering drone learns nothing. (An extended filter with tau
among its states was tried first. Its rows ``-v`` and ``-a`` carry the noise of v and a, which it takes for
manoeuvres: with a good receiver it was wrong by 4 to 7 of its sigmas.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from scipy.interpolate import CubicSpline

from estimators.calibration.latency_kernels import (
    HALF_S,
    STATES,
    fill_integrals,
    largest_density,
    measure_excitation,
    move_bank,
    update_bank,
    weigh_latencies,
)
from estimators.model.measurements import Matrix, Vector

Pair = tuple[float, float]
"""North and east."""

P, V, B = slice(0, 2), slice(2, 4), slice(4, 6)
GRID_SIGMAS, GRID_POINTS, FINE_POINTS = 3.0, 13, 121
"""The grid of latencies spans so many sigma of the prior to either side; its log weights are interpolated."""
REJECTED_IN_A_ROW = 5
"""After as many the receiver has moved for good (a jump), not erred: its quantity starts anew from the fix."""
LOST_AFTER_S = 2.0
"""Longer without a fix, position and velocity start anew; what is known of the latency stays."""
STANDS_OUT = 4.6
"""An acceleration is a manoeuvre as far as its square exceeds so many error variances (90 % of chi-square)."""
ROUNDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class LatencyModel:
    """What the filters assume; 1-sigma and correlation times of first-order Gauss-Markov processes.

    ``bias`` covers accelerometer bias and, above all, the tilt error of the autopilot's attitude (0.01 rad are
    0.1 m/s2), which changes with the manoeuvres: it is short-lived so that it cannot be taken for a latency.
    ``heading`` is the error of the compass. ``wander_s``: beside a white part, the fixes' error has one as large as
    its reported 1-sigma that changes within this time (multipath, ionosphere). ``memory_s``: what was learned fades
    in favour of the prior, since the latency of a real receiver may change.
    """

    bias_sigma_mps2: float = 0.2
    bias_correlation_s: float = 5.0
    heading_sigma_rad: float = 0.06
    heading_correlation_s: float = 60.0
    wander_s: float = 60.0
    start_speed_sigma_mps: float = 5.0
    memory_s: float = 3600.0


class FixOutcome(Enum):
    """What became of a fix; of two that hold, the later one is told."""

    STARTED = auto()
    USED = auto()
    REJECTED = auto()
    """Position, velocity or both were outside the gate; the other one may have been used."""
    RESTARTED = auto()
    """Position or velocity started anew after a gap or a jump."""
    UNCOVERED = auto()
    """No acceleration of its time is known (yet or any more)."""


@dataclass(frozen=True, slots=True)
class TimedFix:
    """A fix: position (m) and, if measured, velocity (m/s), north and east, with the variance per axis."""

    stamp_s: float
    position_m: Pair
    position_variance_m2: float
    velocity_mps: Pair | None
    velocity_variance_m2ps2: float


class AccelerationHistory:
    """The measured acceleration (north, east) of the last ``keep_s``, constant by pieces, and its integrals."""

    def __init__(self, keep_s: float) -> None:
        self._keep_s = keep_s
        self._pieces: Matrix = np.empty((0, 5))
        """Start, end, north, east, variance ``(pieces, 5)``."""

    def add(self, start_s: float, end_s: float, accel_mps2: Pair, variance: float) -> None:
        """Append a piece with the variance of its mean in (m/s2)2; one that does not adjoin begins a new history."""
        known = len(self._pieces)
        first = 0 if abs(self.end_s - start_s) <= ROUNDING_S else known
        while first < known and self._pieces[first, 1] < end_s - self._keep_s:
            first += 1
        pieces = np.empty((known - first + 1, 5))
        pieces[:-1] = self._pieces[first:]
        pieces[-1] = (start_s, end_s, *accel_mps2, variance)
        self._pieces = pieces

    def covers(self, from_s: float, to_s: float) -> bool:
        """Whether a span is known throughout."""
        if not len(self._pieces):
            return False
        return bool(self._pieces[0, 0] - ROUNDING_S <= from_s and to_s <= self.end_s + ROUNDING_S)

    @property
    def end_s(self) -> float:
        """Until when it is known."""
        return float(self._pieces[-1, 1]) if len(self._pieces) else -math.inf

    def integrals(self, from_s: Vector, to_s: Vector) -> tuple[Matrix, Matrix]:
        """What the acceleration, averaged over ``SMOOTH_S`` about each instant, adds over spans ``(k,)``.

        To velocity and to position (from rest), each ``(k, 2)``: the moving average of an integral is a difference
        of the next one. What noise adds from one instant to the next would tell the latencies of the grid apart by
        chance; true accelerations of a drone hardly change within the average.
        """
        gained, moved = np.empty((len(from_s), 2)), np.empty((len(from_s), 2))
        fill_integrals(self._pieces, from_s, to_s, gained, moved)
        return gained, moved

    def excitation(self, about_s: float) -> tuple[float, float]:
        """How far the acceleration about an instant stands out of the whole history's mean, squared in (m/s2)2.

        With it comes the variance per axis that noise has in the acceleration about the instant.
        """
        return measure_excitation(self._pieces, about_s)

    def velocity_density(self) -> float:
        """Growth of the velocity's variance per axis by white noise, (m/s)2 per s; that of the worst piece."""
        return largest_density(self._pieces)


class LatencyEstimator:
    """Bank of filters over one sensor's latency; ``latency_s`` and ``sigma_s`` are its answer at any time.

    ``history`` is kept by the owner, who gives `update` each fix once its time is covered (`ready`).
    """

    def __init__(
        self,
        prior_s: float,
        prior_sigma_s: float,
        history: AccelerationHistory,
        model: LatencyModel | None = None,
    ) -> None:
        """Begin with a prior (mean and 1-sigma in s); raises `ValueError` unless it is finite, its sigma > 0."""
        if not (math.isfinite(prior_s) and math.isfinite(prior_sigma_s) and prior_sigma_s > 0.0):
            raise ValueError(f"latency: expected a finite prior and a positive sigma, got {prior_s}, {prior_sigma_s}")
        self._model = model or LatencyModel()
        offsets = np.linspace(-GRID_SIGMAS, GRID_SIGMAS, GRID_POINTS, dtype=np.float64)
        fine = np.linspace(-GRID_SIGMAS, GRID_SIGMAS, FINE_POINTS, dtype=np.float64)
        self.grid_s: Vector = prior_s + prior_sigma_s * offsets
        self._fine_s: Vector = prior_s + prior_sigma_s * fine
        self._log_prior: Vector = -0.5 * offsets**2
        self._fine_log_prior: Vector = -0.5 * fine**2
        self._interpolation: Matrix = np.ascontiguousarray(CubicSpline(offsets, np.eye(GRID_POINTS))(fine))
        # The tails are cut off: without data the spread of the weights would be a little less than the prior's.
        self._spread = 1.0
        self._log_likelihood: Vector = np.zeros(GRID_POINTS)
        self._weights: Vector = np.empty(GRID_POINTS)
        self._weigh()
        self._spread = prior_sigma_s / self.sigma_s
        self._weigh()
        self.history = history
        self.means: Matrix = np.zeros((GRID_POINTS, STATES))
        self.covariance: Matrix = np.zeros((STATES, STATES))
        bias, heading = self._model.bias_sigma_mps2**2, self._model.heading_sigma_rad**2
        self._stationary: Vector = np.array((bias, bias, heading))
        times = (self._model.bias_correlation_s, self._model.bias_correlation_s, self._model.heading_correlation_s)
        self._rate: Vector = 1.0 / np.array(times)
        self._stamp_s: float | None = None
        self._rejected = {"position": 0, "velocity": 0}
        self._share = 0.0

    def ready(self, stamp_s: float) -> bool:
        """Whether the acceleration is known as far as a fix of this stamp may need it."""
        return bool(stamp_s - self.grid_s[0] + HALF_S <= self.history.end_s)

    @property
    def velocity_mps(self) -> Pair:
        """Velocity at the last fix, zero before the first."""
        north, east = self._weights @ self.means[:, V]
        return float(north), float(east)

    def update(self, fix: TimedFix) -> FixOutcome:
        """Take in a fix; fixes come in the order of their stamps.

        Raises `ValueError`, and changes nothing, if anything is not finite, a variance not positive or the order
        wrong.
        """
        self._check(fix)
        if not self._covered(fix.stamp_s, fix.stamp_s):
            return FixOutcome.UNCOVERED
        last_s = self._stamp_s
        self._stamp_s = fix.stamp_s
        if last_s is None:
            self._start(fix)
            return FixOutcome.STARTED
        if fix.stamp_s - last_s > LOST_AFTER_S or not self._covered(last_s, fix.stamp_s):
            self._start(fix)
            return FixOutcome.RESTARTED
        self._propagate(last_s, fix)
        self._share = self._manoeuvre(fix.stamp_s - self.latency_s)
        outcomes = [self._measure("position", P, fix.position_m, fix.position_variance_m2)]
        if fix.velocity_mps is not None:
            outcomes.append(self._measure("velocity", V, fix.velocity_mps, fix.velocity_variance_m2ps2))
        self._weigh()
        return max(outcomes, key=lambda outcome: outcome.value)

    def _covered(self, from_stamp_s: float, to_stamp_s: float) -> bool:
        return self.history.covers(from_stamp_s - self.grid_s[-1] - HALF_S, to_stamp_s - self.grid_s[0] + HALF_S)

    def _start(self, fix: TimedFix) -> None:
        """Everything but the weights anew, from a fix alone."""
        self.means[:] = 0.0
        self.covariance[:] = np.diag((0.0, 0.0, 0.0, 0.0, *self._stationary))
        self._renew(P, fix.position_m, fix.position_variance_m2)
        if fix.velocity_mps is None:
            self._renew(V, (0.0, 0.0), self._model.start_speed_sigma_mps**2)
        else:
            self._renew(V, fix.velocity_mps, fix.velocity_variance_m2ps2)

    def _renew(self, part: slice, value: Pair, variance: float) -> None:
        """A quantity anew, the same in all filters: each takes it for that of its own instant."""
        self.means[:, part] = value
        self.covariance[part, :] = 0.0
        self.covariance[:, part] = 0.0
        self.covariance[part, part] = variance * np.eye(2)

    def _propagate(self, last_s: float, fix: TimedFix) -> None:
        """Move each filter on from the last fix's instant to this one's, as it believes them to be."""
        duration_s = fix.stamp_s - last_s
        gained, moved = self.history.integrals(last_s - self.grid_s, fix.stamp_s - self.grid_s)
        grown = self.history.velocity_density() * duration_s
        wander = 2.0 * fix.position_variance_m2 / self._model.wander_s * duration_s
        move_bank(
            self.means,
            self.covariance,
            self._weights,
            gained,
            moved,
            duration_s,
            self._rate,
            self._stationary,
            grown,
            wander,
        )
        self._log_likelihood *= math.exp(-duration_s / self._model.memory_s)

    def _manoeuvre(self, instant_s: float) -> float:
        """How much a fix counts, 0 to 1: the share of the squared acceleration that its errors cannot explain."""
        squared, variance = self.history.excitation(instant_s)
        variance += self._model.bias_sigma_mps2**2
        return max(0.0, 1.0 - STANDS_OUT * variance / max(squared, variance))

    def _measure(self, name: str, part: slice, value: Pair, variance: float) -> FixOutcome:
        """Gated update of all filters with two components of the state; the gate is for their weighted mean."""
        squares = np.empty(GRID_POINTS)
        if not update_bank(self.means, self.covariance, self._weights, part.start, *value, variance, squares):
            self._rejected[name] += 1
            if self._rejected[name] < REJECTED_IN_A_ROW:
                return FixOutcome.REJECTED
            self._rejected[name] = 0
            self._renew(part, value, variance)
            return FixOutcome.RESTARTED
        self._rejected[name] = 0
        self._log_likelihood -= 0.5 * self._share * squares
        return FixOutcome.USED

    def _weigh(self) -> None:
        """Weights, mean and spread of the latency from the likelihoods and the prior."""
        mean, sigma = weigh_latencies(
            self._log_likelihood,
            self._log_prior,
            self._interpolation,
            self._fine_s,
            self._fine_log_prior,
            self._weights,
        )
        self.latency_s = mean
        """How much older values are than their stamps."""
        self.sigma_s = self._spread * sigma
        """1-sigma of ``latency_s``."""

    def _check(self, fix: TimedFix) -> None:
        values = (fix.stamp_s, *fix.position_m, *(fix.velocity_mps or ()))
        variances = (fix.position_variance_m2, fix.velocity_variance_m2ps2)
        if not all(map(math.isfinite, (*values, *variances))) or min(variances) <= 0.0:
            raise ValueError(f"latency: expected finite values and positive variances, got {fix}")
        if self._stamp_s is not None and fix.stamp_s <= self._stamp_s:
            raise ValueError(f"latency: expected a fix after {self._stamp_s} s, got one of {fix.stamp_s} s")
