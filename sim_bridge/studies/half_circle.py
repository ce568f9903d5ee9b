"""The half circle of Bolting and Fergani 2018: one UAS flies around another, and what is known of where it is.

A relative position in three states, fed with double differences of satellite code, whose error is a bias that stays
and noise within a bound, with the displacement that a carrier phase gives, and with ranges. The text leaves most
numbers open; those here are this project's. A set filter on the bounds stands beside a Kalman filter on the
variances: the set holds the truth, whatever the error looks like within its bound; the Kalman filter is the better
guess, and does not know of the bias.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimators.integrity.sets.cuts import Outcome, Strip, cut, cut_range, predicted
from estimators.integrity.sets.ellipsoid import Ellipsoid, box_ellipsoid, interval_ellipsoid
from estimators.model.measurements import Matrix, Vector

ELEVATION_DEG = (75.0, 65.5, 56.0, 46.5, 37.0, 27.5, 18.0)
"""Of the satellites; the first and highest is the reference of all differences."""
AZIMUTH_STEP_DEG = 137.5
"""From one to the next: the golden angle, which spreads any number of them evenly."""


@dataclass(frozen=True, slots=True)
class HalfCircle:
    """What is flown, and the sensors. Metres."""

    epochs: int = 101
    radius_m: float = 10.0
    height_m: float = -2.0
    code_bound_m: float = 3.0
    bias_m: float = 1.0
    """The bias of a code difference is uniform within this."""
    noise_sigma_m: float = 0.5
    step_bound_m: float = 0.02
    """Of the displacement, per axis and epoch."""
    range_bound_m: float = 0.5


@dataclass(frozen=True, slots=True)
class HalfCircleData:
    """One flight. ``rows`` ``(m, 3)`` H, one a code difference."""

    truth_m: Matrix
    """``(T, 3)`` relative position."""
    code_m: Matrix
    """``(T, m)``."""
    step_m: Matrix
    """``(T - 1, 3)``: measured displacement from each epoch to the next."""
    range_m: Vector
    """``(T,)``."""
    rows: Matrix
    code_bound_m: float
    step_bound_m: float
    range_bound_m: float


@dataclass(frozen=True, slots=True)
class KalmanNoise:
    """What a Kalman filter takes the errors for: white, with these variances, m2."""

    code: float
    step: float
    range: float


def satellite_rows() -> Matrix:
    """``(m, 3)``: what a displacement NED adds to each code difference, the difference of two lines of sight."""
    elevation = np.deg2rad(ELEVATION_DEG)
    azimuth = np.deg2rad(AZIMUTH_STEP_DEG) * np.arange(len(elevation))
    sight = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)], axis=1
    )
    return np.asarray(sight[1:] - sight[0])


def draw(scenario: HalfCircle, rng: np.random.Generator) -> HalfCircleData:
    """One flight with its errors, all within the bounds."""
    angle = np.linspace(0.0, np.pi, scenario.epochs)
    truth = np.stack(
        [
            scenario.radius_m * np.cos(angle),
            scenario.radius_m * np.sin(angle),
            np.full(scenario.epochs, scenario.height_m),
        ],
        axis=1,
    )
    rows = satellite_rows()
    bias = rng.uniform(-scenario.bias_m, scenario.bias_m, len(rows))
    noise = rng.normal(0.0, scenario.noise_sigma_m, (scenario.epochs, len(rows)))
    error = np.clip(bias + noise, -scenario.code_bound_m, scenario.code_bound_m)
    step_error = rng.uniform(-scenario.step_bound_m, scenario.step_bound_m, (scenario.epochs - 1, 3))
    range_error = rng.uniform(-scenario.range_bound_m, scenario.range_bound_m, scenario.epochs)
    return HalfCircleData(
        truth,
        truth @ rows.T + error,
        np.diff(truth, axis=0) + step_error,
        np.linalg.norm(truth, axis=1) + range_error,
        rows,
        scenario.code_bound_m,
        scenario.step_bound_m,
        scenario.range_bound_m,
    )


def kalman_noise(scenario: HalfCircle) -> KalmanNoise:
    """The variances that belong to a scenario's errors, the bias taken for white noise as well."""
    return KalmanNoise(
        scenario.bias_m**2 / 3.0 + scenario.noise_sigma_m**2,
        scenario.step_bound_m**2 / 3.0,
        scenario.range_bound_m**2 / 3.0,
    )


def set_filter(data: HalfCircleData, *, with_ranges: bool) -> Iterator[tuple[Ellipsoid, bool]]:
    """The guaranteed set of each epoch, and whether nothing was empty; cuts in the order of the rows, then the range.

    It begins with the box that the first epoch's code allows.
    """
    bound = data.code_bound_m
    held = interval_ellipsoid(data.rows, data.code_m[0], np.full(len(data.rows), bound))
    noise = box_ellipsoid(np.zeros(3), np.full(3, data.step_bound_m)).shape
    for k in range(len(data.code_m)):
        if k:
            held = predicted(held, np.eye(3), data.step_m[k - 1], noise)
        sound = True
        for row, value in zip(data.rows, data.code_m[k], strict=True):
            made = cut(held, Strip(np.ascontiguousarray(row), float(value) - bound, float(value) + bound))
            held, sound = made.ellipsoid, sound and made.outcome is not Outcome.EMPTY
        if with_ranges:
            made = cut_range(held, float(data.range_m[k]), data.range_bound_m)
            held, sound = made.ellipsoid, sound and made.outcome is not Outcome.EMPTY
        yield held, sound


def kalman_filter(data: HalfCircleData, noise: KalmanNoise, *, with_ranges: bool) -> Iterator[tuple[Vector, Matrix]]:
    """Mean ``(3,)`` and covariance of each epoch, from the first epoch's code on."""
    covariance: Matrix = np.asarray(np.linalg.inv(data.rows.T @ data.rows / noise.code), np.float64)
    mean = covariance @ data.rows.T @ data.code_m[0] / noise.code
    for k in range(len(data.code_m)):
        if k:
            mean, covariance = mean + data.step_m[k - 1], covariance + noise.step * np.eye(3)
            mean, covariance = _updated(mean, covariance, data.rows, data.code_m[k] - data.rows @ mean, noise.code)
        if with_ranges:
            distance = float(np.linalg.norm(mean))
            toward = mean[None, :] / distance
            left = np.array([data.range_m[k] - distance])
            mean, covariance = _updated(mean, covariance, toward, left, noise.range)
        yield mean, covariance


def _updated(mean: Vector, covariance: Matrix, rows: Matrix, left: Vector, variance: float) -> tuple[Vector, Matrix]:
    spread = rows @ covariance @ rows.T + variance * np.eye(len(rows))
    gain = np.linalg.solve(spread, rows @ covariance).T
    shrunk = covariance - gain @ spread @ gain.T
    return mean + gain @ left, 0.5 * (shrunk + shrunk.T)
