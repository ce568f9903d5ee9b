"""How wrong the simulated sensors are: the paper's uniform noise, and two pictures of real sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from sim_bridge.world.quaternions import Array

ProfileName = Literal["paper", "realistic", "nom"]
FlavourName = Literal["px4", "ardupilot"]


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Inertial sensors.

    ``held_uniform_mps2`` is drawn once per fleet tick in NED and held over it, so that it is the noise of the
    tick's mean acceleration; the others are per sample and axis in the body frame.
    """

    held_uniform_mps2: float = 0.0
    accel_sigma_mps2: float = 0.0
    accel_bias_sigma_mps2: float = 0.0
    accel_walk_mps2: float = 0.0
    """How far a bias walks in a second, 1-sigma; in t seconds sqrt(t) times as far."""
    gyro_sigma_rps: float = 0.0
    gyro_bias_sigma_rps: float = 0.0


@dataclass(frozen=True, slots=True)
class AttitudeNoise:
    """Slow error of the autopilot's attitude, first-order Gauss-Markov per axis in the body frame.

    ``heading_offset_rad`` stays all flight long, to one side or the other, each vehicle's drawn.
    """

    tilt_sigma_rad: float = 0.0
    heading_sigma_rad: float = 0.0
    heading_offset_rad: float = 0.0
    correlation_s: float = 30.0


@dataclass(frozen=True, slots=True)
class GpsNoise:
    """A receiver.

    White noise is per fix; the wander is first-order Gauss-Markov (multipath, ionosphere), ``wander_common`` of its
    variance the same for all receivers of the fleet. ``delivery_s``
    passes between the stamp of a fix and its message, and the position is ``stamp_lag_s`` older than the
    stamp says. The accuracies and dilutions are what the receiver reports.
    """

    position_uniform_m: float = 0.0
    speed_uniform_mps: float = 0.0
    horizontal_sigma_m: float = 0.0
    vertical_sigma_m: float = 0.0
    velocity_sigma_mps: float = 0.0
    horizontal_wander_m: float = 0.0
    vertical_wander_m: float = 0.0
    wander_correlation_s: float = 60.0
    wander_common: float = 0.0
    delivery_s: float = 0.0
    stamp_lag_s: float = 0.0
    h_acc_m: float = 1.0
    v_acc_m: float = 1.5
    speed_acc_mps: float = 0.3
    hdop: float = 0.8
    vdop: float = 1.2


@dataclass(frozen=True, slots=True)
class UwbNoise:
    """Two-way ranges.

    The bias belongs to a pair, whoever measures: a Gaussian plus a uniform draw. A range without line of
    sight is too long by an exponential, cut at ``nlos_max_m``. ``orientation_m`` is the amplitude over the
    bearing in the body frame; ``reported_sigma_m`` is what the driver says.
    """

    uniform_m: float = 0.0
    sigma_m: float = 0.0
    bias_mean_m: float = 0.0
    bias_sigma_m: float = 0.0
    bias_uniform_m: float = 0.0
    orientation_m: float = 0.0
    nlos_probability: float = 0.0
    nlos_mean_m: float = 1.0
    nlos_max_m: float = 20.0
    reported_sigma_m: float = 0.1


@dataclass(frozen=True, slots=True)
class BarometerNoise:
    """A barometer: wrong by an offset that it was switched on with, and by a drift, first-order Gauss-Markov.

    ``scale_sigma``: of its heights, since the air is not that of the standard atmosphere.
    """

    sigma_m: float = 0.0
    """White noise of a sample."""
    offset_sigma_m: float = 0.0
    drift_sigma_m: float = 0.0
    drift_correlation_s: float = 1000.0
    scale_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class NoiseProfile:
    """All sensors of a fleet; the IMU depends on the autopilot, which filters it differently."""

    imu: dict[FlavourName, ImuNoise]
    attitude: AttitudeNoise = field(default_factory=AttitudeNoise)
    gps: GpsNoise = field(default_factory=GpsNoise)
    uwb: UwbNoise = field(default_factory=UwbNoise)
    barometer: BarometerNoise | None = None
    """Absent = the vehicles have none."""


_PAPER_IMU = ImuNoise(held_uniform_mps2=0.1)

PAPER = NoiseProfile(
    imu={"px4": _PAPER_IMU, "ardupilot": _PAPER_IMU},
    gps=GpsNoise(
        position_uniform_m=0.15,
        speed_uniform_mps=0.08,
        h_acc_m=0.15 / math.sqrt(3.0),
        v_acc_m=0.15 / math.sqrt(3.0),
        speed_acc_mps=0.08 / math.sqrt(3.0),
    ),
    uwb=UwbNoise(uniform_m=0.1, reported_sigma_m=0.1 / math.sqrt(3.0)),
)
"""Borelle et al. 2023, section IV-B: everything uniform, nothing late."""

REALISTIC = NoiseProfile(
    imu={
        "px4": ImuNoise(
            accel_sigma_mps2=0.35, accel_bias_sigma_mps2=0.03, gyro_sigma_rps=0.05, gyro_bias_sigma_rps=0.001
        ),
        "ardupilot": ImuNoise(
            accel_sigma_mps2=0.03, accel_bias_sigma_mps2=0.05, gyro_sigma_rps=0.003, gyro_bias_sigma_rps=0.002
        ),
    },
    attitude=AttitudeNoise(tilt_sigma_rad=math.radians(0.4), heading_sigma_rad=math.radians(2.0)),
    gps=GpsNoise(
        horizontal_sigma_m=0.15,
        vertical_sigma_m=0.3,
        velocity_sigma_mps=0.08,
        horizontal_wander_m=0.6,
        vertical_wander_m=1.0,
        delivery_s=0.15,
        stamp_lag_s=0.05,
        h_acc_m=0.7,
        v_acc_m=1.1,
        speed_acc_mps=0.12,
    ),
    uwb=UwbNoise(
        sigma_m=0.1,
        bias_uniform_m=0.1,
        orientation_m=0.15,
        nlos_probability=0.03,
        reported_sigma_m=0.1,
    ),
    barometer=BarometerNoise(sigma_m=0.12, offset_sigma_m=3.0, drift_sigma_m=1.0, scale_sigma=0.03),
)
"""Recorded flights and public UWB data: biased pairs, a tail without line of sight, late wandering GPS."""

_NOM_IMU = ImuNoise(
    accel_sigma_mps2=0.16,
    accel_bias_sigma_mps2=0.1,
    accel_walk_mps2=0.01,
    gyro_sigma_rps=0.003,
    gyro_bias_sigma_rps=0.001,
)

NOM = NoiseProfile(
    imu={"px4": _NOM_IMU, "ardupilot": _NOM_IMU},
    attitude=AttitudeNoise(
        tilt_sigma_rad=math.radians(1.0), heading_offset_rad=math.radians(2.0), correlation_s=40.0
    ),
    gps=GpsNoise(
        horizontal_sigma_m=0.15,
        vertical_sigma_m=0.225,
        velocity_sigma_mps=0.1,
        horizontal_wander_m=1.0,
        vertical_wander_m=1.5,
        wander_correlation_s=60.0,
        wander_common=0.5,
        delivery_s=0.05,
        h_acc_m=0.4,
        v_acc_m=0.6,
        speed_acc_mps=0.2,
    ),
    uwb=UwbNoise(sigma_m=0.1, bias_mean_m=0.35, bias_uniform_m=0.15, nlos_probability=0.03, nlos_max_m=math.inf),
    barometer=BarometerNoise(sigma_m=0.12, offset_sigma_m=3.0, drift_sigma_m=0.8, scale_sigma=0.03),
)
"""The usual errors of sensors that nobody has calibrated, and that claim to be good: they do not average out."""

PROFILES: dict[ProfileName, NoiseProfile] = {"paper": PAPER, "realistic": REALISTIC, "nom": NOM}


def uncalibrated(noise: UwbNoise) -> UwbNoise:
    """The same modules as delivered, their antenna delays not calibrated: pairs biased by 0.3 +- 0.15 m."""
    return replace(noise, bias_mean_m=0.3, bias_sigma_m=0.15, bias_uniform_m=0.0)


class GaussMarkov:
    """First-order Gauss-Markov process of several axes, in its stationary state from the start."""

    def __init__(self, sigma: Array, correlation_s: float, rng: np.random.Generator) -> None:
        """``sigma`` ``(k,)`` is the standard deviation of each axis."""
        self._sigma = np.asarray(sigma, float)
        self._correlation_s = correlation_s
        self._rng = rng
        self._time_s: float | None = None
        self.value: Array = self._sigma * rng.standard_normal(len(self._sigma))

    def at(self, time_s: float) -> Array:
        """The value at a time not before the last one asked for."""
        if self._time_s is not None and time_s > self._time_s and self._sigma.any():
            kept = math.exp(-(time_s - self._time_s) / self._correlation_s)
            fresh = math.sqrt(1.0 - kept * kept)
            self.value = kept * self.value + fresh * self._sigma * self._rng.standard_normal(len(self._sigma))
        self._time_s = time_s
        return self.value
