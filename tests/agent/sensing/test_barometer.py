"""Barometers: units, the standard atmosphere, where their heights are put, and what is no barometer's."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.barometer import GAP_S, INTERVAL_S, JUMP_M, Barometer, pressure_altitude_m
from agent.sensing.samples import BaroSample


@pytest.mark.parametrize(
    ("pressure_hpa", "altitude_m"), [(1013.25, 0.0), (954.61, 500.0), (898.75, 1000.0), (701.09, 3000.0)]
)
def test_pressures_of_the_standard_atmosphere(pressure_hpa: float, altitude_m: float) -> None:
    """ICAO Doc 7488."""
    assert pressure_altitude_m(pressure_hpa) == pytest.approx(altitude_m, abs=0.3)


@given(st.floats(100.5, 1199.0))
def test_pascals_and_hectopascals_are_told_apart(pressure_hpa: float) -> None:
    assert pressure_altitude_m(100.0 * pressure_hpa) == pytest.approx(pressure_altitude_m(pressure_hpa), abs=1e-6)


@pytest.mark.parametrize("pressure", [0.0, -960.0, 99.0, 1201.0, 9999.0, 120_001.0, math.nan, math.inf, -math.inf])
def test_what_is_no_pressure_of_air_has_no_altitude(pressure: float) -> None:
    assert pressure_altitude_m(pressure) is None


def heard(barometer: Barometer, *altitudes_m: float, from_s: float = 0.0) -> None:
    """Samples a second apart, where the place is not known."""
    for k, altitude_m in enumerate(altitudes_m):
        assert isinstance(barometer.take(BaroSample(from_s + k, altitude_m), None), str)


def test_heights_begin_where_the_drone_is_and_go_on_from_there() -> None:
    barometer = Barometer()
    heard(barometer, 447.1, 447.2)
    assert barometer.take(BaroSample(2.0, 447.0), None) == "place unknown"
    assert barometer.take(BaroSample(3.0, 447.0), 30.0) == BaroSample(3.0, 30.0)
    # whatever the estimate says later: only what the barometer changes by counts
    assert barometer.take(BaroSample(4.0, 449.5), 99.0) == BaroSample(4.0, 32.5)


def test_a_constant_is_no_barometer() -> None:
    # GIVEN one that never changes THEN nothing is taken of it
    barometer = Barometer()
    assert {barometer.take(BaroSample(0.1 * k, 540.0), 10.0) for k in range(100)} == {"always the same"}
    # and of one that stops to change nothing more, until it changes again
    assert isinstance(barometer.take(BaroSample(10.0, 540.1), 10.0), BaroSample)
    stopped = [barometer.take(BaroSample(10.0 + 0.5 * k, 540.1), 10.0) for k in range(1, 20)]
    assert [isinstance(sample, BaroSample) for sample in stopped] == [True] * 6 + [False] * 13
    assert barometer.take(BaroSample(20.0, 540.2), 10.0) == BaroSample(20.0, pytest.approx(10.1))


def test_samples_in_close_succession_are_more_than_are_needed() -> None:
    barometer, taken = Barometer(), []
    heard(barometer, 447.0, 448.0, from_s=-2.0)
    for k in range(200):
        found = barometer.take(BaroSample(0.02 * k, 447.0 + 0.1 * (k // 5 % 2)), 0.0)
        if isinstance(found, BaroSample):
            taken.append(found.t_s)
        else:
            assert found == "more than are needed"
    assert len(taken) == pytest.approx(4.0 / INTERVAL_S, abs=1)


@pytest.mark.parametrize("then", [BaroSample(3.0, 448.0 + 3.0 * JUMP_M + 20.0), BaroSample(3.0 + GAP_S, 448.0)])
def test_another_sensor_and_one_that_was_silent_are_put_anew(then: BaroSample) -> None:
    barometer = Barometer()
    heard(barometer, 446.0, 447.0)
    assert barometer.take(BaroSample(2.0, 447.0), 10.0) == BaroSample(2.0, 10.0)
    assert barometer.take(then, 11.0) == BaroSample(then.t_s, 11.0)


def test_a_clock_that_was_set_back_does_not_silence_it() -> None:
    barometer = Barometer()
    heard(barometer, 446.0, 447.0, from_s=98.0)
    assert isinstance(barometer.take(BaroSample(100.0, 447.0), 10.0), BaroSample)
    assert isinstance(barometer.take(BaroSample(1.0, 447.5), 10.0), BaroSample)
