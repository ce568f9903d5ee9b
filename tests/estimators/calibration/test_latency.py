"""The latency's estimation: it finds it in manoeuvres, claims nothing without, and is as sure as it is right."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from estimators.calibration.latency import AccelerationHistory, FixOutcome, LatencyEstimator, LatencyModel, TimedFix
from tests.support.manoeuvres import Course, Markov

TICK_S = 0.1
KEEP_S = 5.0
LATE_S = 0.8
"""A fix comes this long after its stamp."""
TILT_MPS2 = 9.81 * math.radians(0.4)


@dataclass(frozen=True)
class Errors:
    """What is wrong (1-sigma), and what the receiver claims; ``reported_*`` absent = the white part."""

    latency_s: float = 0.0
    white_m: float = 0.15
    wander_m: float = 0.0
    velocity_mps: float = 0.08
    reported_m: float | None = None
    reported_mps: float | None = None
    accel_mps2: float = 0.05
    bias_mps2: float = 0.0
    bias_correlation_s: float = 30.0
    heading_rad: float = 0.0
    heading_correlation_s: float = 60.0


MODEL = LatencyModel()
AS_MODELLED = Errors(
    white_m=0.3,
    wander_m=0.3,
    velocity_mps=0.1,
    accel_mps2=0.1,
    bias_mps2=MODEL.bias_sigma_mps2,
    bias_correlation_s=MODEL.bias_correlation_s,
    heading_rad=MODEL.heading_sigma_rad,
)
REALISTIC = Errors(
    white_m=0.15,
    wander_m=0.6,
    velocity_mps=0.08,
    reported_m=0.7,
    reported_mps=0.12,
    accel_mps2=0.12,
    bias_mps2=math.hypot(0.03, TILT_MPS2),
    heading_rad=math.radians(2.0),
    heading_correlation_s=30.0,
)
"""The simulator's realistic profile."""
GOOD = Errors(white_m=0.02, velocity_mps=0.02, accel_mps2=0.02)


def fly(
    course: Course,
    errors: Errors,
    prior: tuple[float, float],
    duration_s: float = 60.0,
    seed: int = 0,
    with_velocity: bool = True,
) -> LatencyEstimator:
    """A flight with five fixes a second, each late; what is known at its end."""
    rng = np.random.default_rng(seed)
    made = LatencyEstimator(*prior, AccelerationHistory(KEEP_S))
    wander = Markov(errors.wander_m, MODEL.wander_s, 2 * TICK_S, rng)
    bias = Markov(errors.bias_mps2, errors.bias_correlation_s, TICK_S, rng)
    heading = Markov(errors.heading_rad, errors.heading_correlation_s, TICK_S, rng)
    for k in range(round(duration_s / TICK_S)):
        end_s = (k + 1) * TICK_S
        true, psi = course.mean_accel(k * TICK_S, end_s), heading.step()[0]
        accel = true + psi * np.array((-true[1], true[0])) + bias.step()
        accel += errors.accel_mps2 * rng.standard_normal(2)
        made.history.add(k * TICK_S, end_s, (float(accel[0]), float(accel[1])), errors.accel_mps2**2)
        if k % 2 == 0 and k >= 20:
            stamp_s = end_s - LATE_S
            of_s = stamp_s - errors.latency_s
            p = course.position(of_s) + wander.step() + errors.white_m * rng.standard_normal(2)
            v = course.velocity(of_s) + errors.velocity_mps * rng.standard_normal(2)
            fix = TimedFix(
                stamp_s,
                (float(p[0]), float(p[1])),
                (errors.reported_m or errors.white_m) ** 2,
                (float(v[0]), float(v[1])) if with_velocity else None,
                (errors.reported_mps or errors.velocity_mps) ** 2,
            )
            made.update(fix)
    return made


@pytest.mark.parametrize("latency_s", [-0.05, 0.0, 0.085, 0.26])
def test_the_latency_is_found_in_turns(latency_s: float) -> None:
    # GIVEN a good receiver whose latency is one and a half sigma off what was believed
    # WHEN the drone flies eights for two minutes
    made = fly(Course.eight(), replace(GOOD, latency_s=latency_s), (latency_s - 0.12, 0.08), 120.0)
    # THEN it is found, and the uncertainty says how well
    assert made.sigma_s < 0.025
    assert made.latency_s == pytest.approx(latency_s, abs=2.5 * made.sigma_s)


def test_position_alone_tells_it_too() -> None:
    made = fly(Course.eight(), replace(GOOD, latency_s=0.2), (0.1, 0.08), 60.0, with_velocity=False)
    assert made.sigma_s < 0.04
    assert made.latency_s == pytest.approx(0.2, abs=2.5 * made.sigma_s)


@pytest.mark.parametrize("velocity_mps", [(0.0, 0.0), (15.0, -3.0)])
@pytest.mark.parametrize("white_m", [0.02, 0.5])
@pytest.mark.parametrize("accel_mps2", [0.05, 0.4])
def test_steady_flight_teaches_nothing(velocity_mps: tuple[float, float], white_m: float, accel_mps2: float) -> None:
    # GIVEN a latency of 0.15 s where 0.1 s is believed, and a drone that hovers or flies straight on
    errors = Errors(0.15, white_m=white_m, accel_mps2=accel_mps2, bias_mps2=0.05)
    # WHEN it has done so for a minute
    made = fly(Course(velocity_mps), errors, (0.1, 0.05))
    # THEN the prior stands, and is as unsure as it was
    assert made.sigma_s == pytest.approx(0.05, rel=0.05)
    assert made.latency_s == pytest.approx(0.1, abs=0.01)


def flights(errors: Errors, runs: int) -> np.ndarray:
    """Error and 1-sigma of the latency ``(runs, 2)``; truths are drawn from the prior."""
    rows = []
    for seed in range(runs):
        rng = np.random.default_rng((seed, 7))
        true_s = 0.1 + 0.04 * rng.standard_normal()
        made = fly(Course.eight(rng), replace(errors, latency_s=true_s), (0.1, 0.04), 40.0, seed)
        rows.append((made.latency_s - true_s, made.sigma_s))
    return np.array(rows)


def test_a_receiver_that_wanders_is_not_taken_for_a_late_one() -> None:
    # GIVEN fixes that wander by the metre that the receiver claims, with little white noise on it
    error_s, sigma_s = flights(Errors(white_m=0.1, wander_m=1.0, reported_m=1.0), 40).T
    # THEN turns teach something, and the error is what the uncertainty allows for. The model takes the white part to
    # be as large as what is claimed, so it may say up to twice the error, but neither less nor more than that
    assert np.sqrt(np.mean(error_s**2)) < 0.75 * 0.04
    assert sigma_s.mean() < 0.75 * 0.04
    assert 0.25 < np.mean((error_s / sigma_s) ** 2) < 1.84


@pytest.mark.parametrize("errors", [AS_MODELLED, REALISTIC], ids=["as modelled", "realistic"])
def test_it_is_as_sure_as_it_is_right(errors: Errors) -> None:
    # WHEN forty flights with latencies of the prior are flown
    error_s, sigma_s = flights(errors, 40).T
    # THEN the mean NEES is in the 99.8 % band of chi-square with 40 degrees of freedom, over 40
    assert 0.44 < np.mean((error_s / sigma_s) ** 2) < 1.84
    # AND the flights have taught something
    assert sigma_s.mean() < 0.75 * 0.04
    assert np.sqrt(np.mean(error_s**2)) < 0.75 * 0.04


def learned(latency_s: float = 0.1) -> tuple[LatencyEstimator, float]:
    """After half a minute of turns, and the stamp that comes next."""
    made = fly(Course.eight(), replace(GOOD, latency_s=latency_s), (latency_s, 0.04), 30.0)
    assert made.sigma_s < 0.03
    return made, 30.0 - LATE_S + TICK_S


def hold(made: LatencyEstimator, from_s: float, count: int) -> None:
    """Go on without acceleration."""
    for k in range(count):
        made.history.add(from_s + k * TICK_S, from_s + (k + 1) * TICK_S, (0.0, 0.0), 0.0025)


def test_an_outlier_is_left_out_and_a_jump_is_followed() -> None:
    # GIVEN an estimator in flight
    made, stamp_s = learned()
    before_s, sigma_s = made.latency_s, made.sigma_s
    hold(made, 30.0, 20)
    # WHEN fixes are 3 km off
    outcomes = [made.update(TimedFix(stamp_s + 0.1 * k, (3000.0, 0.0), 1.0, None, 1.0)) for k in range(6)]
    # THEN four are outliers, the fifth is the new truth, and nothing of it is latency
    assert outcomes == [FixOutcome.REJECTED] * 4 + [FixOutcome.RESTARTED, FixOutcome.USED]
    assert made.means[:, 0] == pytest.approx(3000.0, abs=3.0)
    assert made.latency_s == pytest.approx(before_s, abs=0.01)
    assert made.sigma_s == pytest.approx(sigma_s, rel=0.1)


def test_after_a_gap_the_motion_starts_anew_and_the_latency_is_kept() -> None:
    made, _ = learned()
    before = made.latency_s, made.sigma_s
    hold(made, 500.0, 20)
    assert made.update(TimedFix(501.2, (900.0, 0.0), 1.0, (1.0, 2.0), 0.1)) is FixOutcome.RESTARTED
    assert made.velocity_mps == pytest.approx((1.0, 2.0))
    assert (made.latency_s, made.sigma_s) == before


def test_a_fix_whose_time_is_not_known_is_left_out() -> None:
    made, stamp_s = learned()
    before = made.latency_s, made.sigma_s
    assert not made.ready(stamp_s + 1.0)
    assert made.update(TimedFix(stamp_s + 1.0, (0.0, 0.0), 1.0, None, 1.0)) is FixOutcome.UNCOVERED
    assert (made.latency_s, made.sigma_s) == before
    assert made.update(TimedFix(stamp_s, (0.0, 0.0), 1.0, None, 1.0)) is not FixOutcome.UNCOVERED


def test_in_steady_flight_it_forgets_slowly() -> None:
    course = Course.eight()
    brief = LatencyModel(memory_s=20.0)
    made, forgetful = (LatencyEstimator(0.1, 0.04, AccelerationHistory(KEEP_S), model) for model in (MODEL, brief))
    for k in range(1200):
        time_s = k * TICK_S
        turning = k < 300
        north, east = course.mean_accel(time_s, time_s + TICK_S) if turning else (0.0, 0.0)
        position = course.position(time_s - 0.6) if turning else (0.0, 0.0)
        for one in (made, forgetful):
            one.history.add(time_s, time_s + TICK_S, (float(north), float(east)), 0.0025)
            if k > 10:
                one.update(TimedFix(time_s - 0.5, (float(position[0]), float(position[1])), 0.01, None, 1.0))
    assert made.sigma_s < 0.035
    assert made.sigma_s < forgetful.sigma_s == pytest.approx(0.04, rel=0.05)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_what_is_not_finite_is_refused_and_changes_nothing(wrong: float) -> None:
    made, stamp_s = learned()
    means, covariance, known = made.means.copy(), made.covariance.copy(), (made.latency_s, made.sigma_s)
    good = TimedFix(stamp_s, (0.0, 0.0), 1.0, (0.0, 0.0), 1.0)
    for fix in (
        replace(good, position_m=(wrong, 0.0)),
        replace(good, velocity_mps=(0.0, wrong)),
        replace(good, position_variance_m2=wrong),
        replace(good, velocity_variance_m2ps2=-1.0),
        replace(good, stamp_s=wrong),
    ):
        with pytest.raises(ValueError, match="expected finite values and positive variances"):
            made.update(fix)
    with pytest.raises(ValueError, match="expected a fix after"):
        made.update(replace(good, stamp_s=stamp_s - 1.0))
    assert np.array_equal(made.means, means)
    assert np.array_equal(made.covariance, covariance)
    assert (made.latency_s, made.sigma_s) == known
    with pytest.raises(ValueError, match="positive sigma"):
        LatencyEstimator(wrong, 0.1, AccelerationHistory(KEEP_S))


def test_a_prior_without_data_is_given_back() -> None:
    made = LatencyEstimator(0.25, 0.08, AccelerationHistory(KEEP_S))
    assert made.latency_s == pytest.approx(0.25)
    assert made.sigma_s == pytest.approx(0.08)


@given(
    st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=12, max_size=40),
    st.floats(0.0, 0.3),
)
def test_integrals_are_those_of_the_smoothed_acceleration(pieces: list[tuple[float, float]], share: float) -> None:
    history = AccelerationHistory(100.0)
    for k, piece in enumerate(pieces):
        history.add(k * TICK_S, (k + 1) * TICK_S, piece, 0.01)
    # GIVEN a span well inside, and the smoothed acceleration on a fine grid
    from_s, to_s = 0.3 + share, len(pieces) * TICK_S - 0.3
    assume(from_s < to_s)
    fine = np.linspace(from_s, to_s, 400)
    inside = np.linspace(-0.25, 0.25, 200, endpoint=False) + 0.00125
    index = np.minimum((fine[:, None] + inside) / TICK_S, len(pieces) - 1).astype(int)
    smooth = np.array(pieces)[index].mean(axis=1)
    velocity = cumulative_trapezoid(smooth, fine, axis=0, initial=0.0)
    position = np.trapezoid(velocity, fine, axis=0)
    # THEN the integrals agree with the sums
    gained, moved = history.integrals(np.array([from_s]), np.array([to_s]))
    assert gained[0] == pytest.approx(velocity[-1], abs=0.1)
    assert moved[0] == pytest.approx(position, abs=0.1)


STEP = st.tuples(
    st.floats(0.01, 3.0),
    st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
    st.none() | st.tuples(st.floats(-60, 60), st.floats(-60, 60)),
    st.floats(1e-4, 1e4),
)


@settings(max_examples=50, deadline=None)
@given(st.lists(STEP, min_size=1, max_size=25))
def test_whatever_comes_it_stays_finite_and_within_its_grid(steps: list[tuple]) -> None:  # type: ignore[type-arg]
    made = LatencyEstimator(0.1, 0.04, AccelerationHistory(KEEP_S))
    time_s = 0.0
    for wait_s, accel, position, velocity, variance in steps:
        for _ in range(math.ceil(wait_s / TICK_S)):
            made.history.add(time_s, time_s + TICK_S, accel, 0.01)
            time_s += TICK_S
        made.update(TimedFix(time_s - 0.4, position, variance, velocity, variance))
        assert np.isfinite(made.means).all()
        eigenvalues = np.linalg.eigvalsh(made.covariance)
        assert eigenvalues[0] >= -1e-9 * eigenvalues[-1]
        assert made.grid_s[0] <= made.latency_s <= made.grid_s[-1]
        assert 0.0 < made.sigma_s < 0.12
