"""Heights of a barometer: pressure to metres, and metres to those above the fleet's origin.

A barometer has no zero of its own: the weather moves it by 8 m per hPa, and nobody tells the daemon. So its first
sample is put to where the estimate has the drone, and only what it changes by is used; how far off it was put, and
how it drifts from there, are slow errors of the estimator (`estimators.systematic.slow_errors`).
"""

from __future__ import annotations

import math

from agent.sensing.samples import BaroSample

INTERVAL_S = 0.5
"""Between measurements: what a barometer knows lasts for minutes, and each costs bytes on the radio."""
SIGMA_M = 0.3
"""1-sigma of a measurement, the slow errors aside: gusts and the propellers' own wind are more than its noise."""
JUMP_M, FASTEST_MPS = 5.0, 20.0
"""No drone climbs so far at once, nor faster: another sensor."""
GAP_S = 5.0
"""After a longer silence it may be another sensor, or the autopilot was restarted."""
FROZEN_S = 3.0
"""No barometer says the same for longer, to the last digit: what does is a constant that somebody filled in."""
LEAST_HPA, MOST_HPA = 100.0, 1200.0
"""From 16 km up to 1.4 km below the sea."""
PA_PER_HPA = 100.0
SEA_LEVEL_HPA = 1013.25
SEA_LEVEL_K = 288.15
LAPSE_K_PER_M = 0.0065
EXPONENT = 0.190263
"""R L / g of the standard atmosphere (ICAO Doc 7488), with the lapse rate L."""


def pressure_altitude_m(pressure: float) -> float | None:
    """Altitude in the standard atmosphere of a pressure in hPa or Pa; ``None`` if it is none of either.

    MAVLink has hPa, and so had PX4's ``sensor_baro`` before 1.14; other logs have Pa. No drone flies where the one
    could be taken for the other.
    """
    if not math.isfinite(pressure):
        return None
    if LEAST_HPA * PA_PER_HPA <= pressure <= MOST_HPA * PA_PER_HPA:
        pressure /= PA_PER_HPA
    if not LEAST_HPA <= pressure <= MOST_HPA:
        return None
    return SEA_LEVEL_K / LAPSE_K_PER_M * (1.0 - math.pow(pressure / SEA_LEVEL_HPA, EXPONENT))


class Barometer:
    """One barometer's altitudes above the fleet's origin."""

    def __init__(self) -> None:
        self._shift_m: float | None = None
        """From pressure altitudes to those of the fleet."""
        self._last: BaroSample | None = None
        self._changed_s: float | None = None
        """When it last said something else than before."""
        self._given_s = -math.inf
        """Time of the last one that was given out."""

    def take(self, sample: BaroSample, altitude_m: float | None) -> BaroSample | str:
        """The altitude of a sample above the fleet's origin, or why there is none.

        ``altitude_m``: where the drone is above it, ``None`` while that is not known. Of samples that come in close
        succession most are left out.
        """
        if self._last is not None:
            if self._is_another(sample, self._last):
                self._shift_m = None
            if sample.altitude_m != self._last.altitude_m:
                self._changed_s = sample.t_s
        self._last = sample
        if self._changed_s is None or abs(sample.t_s - self._changed_s) > FROZEN_S:
            return "always the same"
        if self._shift_m is None:
            if altitude_m is None:
                return "place unknown"
            self._shift_m = altitude_m - sample.altitude_m
        if 0.0 <= sample.t_s - self._given_s < INTERVAL_S:
            return "more than are needed"
        self._given_s = sample.t_s
        return BaroSample(sample.t_s, sample.altitude_m + self._shift_m)

    @staticmethod
    def _is_another(sample: BaroSample, last: BaroSample) -> bool:
        """Whether a sample is of another sensor than the last one, or of one that was started anew."""
        elapsed_s = abs(sample.t_s - last.t_s)
        return abs(sample.altitude_m - last.altitude_m) > JUMP_M + FASTEST_MPS * elapsed_s or elapsed_s > GAP_S
