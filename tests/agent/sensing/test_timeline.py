"""From samples to ticks: exact where it can be, honest where samples are missing."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.frames import from_euler, rotated
from agent.sensing.samples import AttitudeSample, ImuSample, Quaternion
from agent.sensing.timeline import ACCEL_GAP_SIGMA_MPS2, MAX_SAMPLES, TickInput, Timeline, tick_of
from estimators.model.unknown_motion import TILTED_MPS2
from tests.agent.conftest import fleet_config
from tests.support.holding import held
from tests.support.onboard import onboard_of

GRAVITY = 9.80665
PERIOD_S = 0.1
ANGLE = st.floats(-3.1, 3.1)
ACCEL = st.tuples(*[st.floats(-20, 20)] * 3)


def conjugate(q: Quaternion) -> Quaternion:
    return q[0], -q[1], -q[2], -q[3]


def force(attitude: Quaternion, accel: tuple[float, float, float]) -> tuple[float, float, float]:
    """What an IMU in this attitude measures under an acceleration in NED."""
    return rotated(conjugate(attitude), (accel[0], accel[1], accel[2] - GRAVITY))


def timeline(**sensors: float) -> Timeline:
    given = {"accel_sigma_mps2": 0.1, **sensors}
    return onboard_of(fleet_config(1, *(f"sensors.{key}={value}" for key, value in given.items()))).core.timeline


def fill(made: Timeline, start_s: float, end_s: float, accel: tuple[float, float, float] = (1.0, -2.0, 0.5)) -> None:
    count = round((end_s - start_s) / 0.01)
    for i in range(count):
        made.add_imu(ImuSample(start_s + 0.01 * i, force((1, 0, 0, 0), accel), (0, 0, 0)))
        if i % 2 == 0:
            made.add_attitude(AttitudeSample(start_s + 0.01 * i, (1, 0, 0, 0)))


@given(st.integers(0, 10**9), st.sampled_from([0.02, 0.05, 0.1, 0.3, 1.0]))
def test_every_tick_begins_at_its_own_time(tick: int, period_s: float) -> None:
    assert tick_of(tick * period_s, period_s) == tick
    assert tick_of((tick + 0.5) * period_s, period_s) == tick
    assert tick_of((tick + 0.999) * period_s, period_s) == tick


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE, ACCEL, st.integers(0, 10_000_000))
def test_a_constant_acceleration_is_recovered_in_any_attitude(
    roll: float, pitch: float, yaw: float, accel: tuple[float, float, float], tick: int
) -> None:
    attitude, made = from_euler(roll, pitch, yaw), timeline()
    start_s = tick * PERIOD_S
    for i in range(-1, 11):
        made.add_imu(ImuSample(start_s + 0.01 * i, force(attitude, accel), (0, 0, 0)))
        made.add_attitude(AttitudeSample(start_s + 0.01 * i, attitude))
    closed = made.close(tick)
    assert closed.accel_mps2 == pytest.approx(accel, abs=1e-9)
    assert closed.coverage == pytest.approx(1.0, abs=1e-6)
    assert closed.variance == pytest.approx((0.01,) * 3)


@given(st.floats(-50, 50), st.floats(-20, 20), st.lists(st.floats(0.001, 0.04), min_size=5, max_size=40))
def test_a_linear_acceleration_is_integrated_exactly_whatever_the_sampling(
    slope: float, offset: float, steps: list[float]
) -> None:
    made, t_s = timeline(), 0.95
    for step in [*steps, *[0.02] * 10]:
        made.add_imu(ImuSample(t_s, force((1, 0, 0, 0), (offset + slope * (t_s - 1), 0, 0)), (0, 0, 0)))
        made.add_attitude(AttitudeSample(t_s, (1, 0, 0, 0)))
        t_s += step
    assert made.close(10).accel_mps2[0] == pytest.approx(offset + slope * 0.05, abs=1e-6)


def test_attitude_is_taken_at_the_time_of_each_imu_sample() -> None:
    rate, accel, made = 3.0, (2.0, 1.0, -0.5), timeline()
    for i in range(-2, 14):
        t_s = 1.0 + 0.01 * i
        made.add_imu(ImuSample(t_s, force(from_euler(0, 0, rate * t_s), accel), (0, 0, rate)))
    for i in range(-1, 4):
        t_s = 1.0 + 0.037 * i
        made.add_attitude(AttitudeSample(t_s, from_euler(0, 0, rate * t_s)))
    assert made.close(10).accel_mps2 == pytest.approx(accel, abs=1e-9)


def test_beyond_the_last_attitude_the_turn_rate_carries_on() -> None:
    made = timeline()
    made.add_attitude(AttitudeSample(1.0, from_euler(0.2, -0.1, 0.5)))
    spun = made.attitude_at(1.1, (0.0, 0.0, 2.0))
    assert spun is not None
    body_x = rotated(spun, (1, 0, 0))
    expected = rotated(from_euler(0.2, -0.1, 0.5), (math.cos(0.2), math.sin(0.2), 0))
    assert body_x == pytest.approx(expected, abs=1e-12)
    assert made.attitude_at(1.31, (0, 0, 0)) is None


@given(st.integers(0, 1000))
def test_order_of_arrival_and_duplicates_do_not_matter(seed: int) -> None:
    samples = [ImuSample(1.0 + 0.01 * i, force((1, 0, 0, 0), (i, -i, 0)), (0, 0, 0)) for i in range(-1, 12)]
    attitudes = [AttitudeSample(1.0 + 0.02 * i, (1, 0, 0, 0)) for i in range(-1, 7)]
    orderly, shuffled = timeline(), timeline()
    mixed = [*samples, *samples[:4]]
    random.Random(seed).shuffle(mixed)
    for made, sequence in ((orderly, samples), (shuffled, mixed)):
        for attitude in attitudes:
            made.add_attitude(attitude)
        for sample in sequence:
            made.add_imu(sample)
    assert orderly.close(10) == shuffled.close(10)
    assert shuffled.skipped["imu: duplicate"] == 4


def test_a_gap_is_not_bridged_and_inflates_the_variance() -> None:
    made = timeline(imu_max_gap_s=0.02)
    fill(made, 0.95, 1.03)
    fill(made, 1.07, 1.15)
    closed = made.close(10)
    # The gap from 1.02 to 1.07 is longer than 0.02 s.
    assert closed.coverage == pytest.approx(0.5, abs=1e-6)
    assert closed.accel_mps2 == pytest.approx((1.0, -2.0, 0.5), abs=1e-9)
    assert closed.variance == pytest.approx((0.1**2 + (0.5 * ACCEL_GAP_SIGMA_MPS2) ** 2,) * 3)


def test_the_last_sample_holds_no_longer_than_a_gap() -> None:
    made = timeline(imu_max_gap_s=0.03)
    fill(made, 0.95, 1.051)
    assert made.close(10).coverage == pytest.approx(0.7, abs=1e-6)


def test_without_samples_there_is_no_acceleration_but_a_variance() -> None:
    for made in (timeline(), timeline()):
        closed = made.close(10)
        without = ACCEL_GAP_SIGMA_MPS2**2 + 0.1**2
        assert closed == TickInput(10, (0.0, 0.0, 0.0), (without, without, without), 0.0, 0)


def test_without_attitude_imu_samples_are_worth_nothing() -> None:
    made = timeline()
    for i in range(12):
        made.add_imu(ImuSample(1.0 + 0.01 * i, (0, 0, -GRAVITY), (0, 0, 0)))
    assert made.close(10).coverage == 0.0
    assert made.skipped == {"imu: no attitude": 10}
    assert made.waiting == 2


@given(
    st.lists(st.tuples(st.floats(0.0, 3.0), st.booleans()), max_size=150), st.sets(st.integers(0, 29), max_size=12)
)
def test_each_sample_is_counted_once(added: list[tuple[float, bool]], closed: set[int]) -> None:
    """GIVEN samples in any order, some again and some without attitudes, and ticks of which some are left out."""
    made, rng = timeline(), random.Random(6)
    ticks = sorted(closed)
    for t_s, turned in added:
        made.add_imu(ImuSample(t_s, (rng.gauss(0.0, 0.3), 9.0, -GRAVITY), (0, 0, 0)))
        if turned:
            made.add_attitude(AttitudeSample(t_s, (1, 0, 0, 0)))
        if ticks and rng.random() < 0.1:
            made.close(ticks.pop(0))
    for tick in ticks:
        made.close(tick)
    imu = sum(count for reason, count in made.skipped.items() if reason.startswith("imu"))
    attitude = sum(count for reason, count in made.skipped.items() if reason.startswith("attitude"))
    assert made.used["imu"] + imu + made.waiting == len(added)
    assert made.used["attitude"] + attitude == sum(turned for _, turned in added)


def test_samples_of_closed_ticks_are_counted() -> None:
    made = timeline()
    fill(made, 0.9, 1.2)
    made.close(10)
    made.add_imu(ImuSample(1.005, (0, 0, -GRAVITY), (0, 0, 0)))
    assert made.skipped["imu: late"] == 1


def test_memory_stays_bounded_in_use_and_in_a_flood() -> None:
    made = timeline()
    for k in range(100):
        fill(made, PERIOD_S * k, PERIOD_S * (k + 1))
        made.close(k)
    kept = held(made)
    assert kept[ImuSample] < 150
    assert kept[AttitudeSample] < 150
    for i in range(10_000):
        made.add_imu(ImuSample(20 + 1e-5 * i, (0, 0, 0), (0, 0, 0)))
        made.add_attitude(AttitudeSample(20 + 1e-5 * i, (1, 0, 0, 0)))
    kept = held(made)
    assert kept[ImuSample] <= MAX_SAMPLES
    assert kept[AttitudeSample] <= MAX_SAMPLES


def test_consecutive_ticks_share_no_time_and_miss_none() -> None:
    rng = np.random.default_rng(4)
    made, times = timeline(), np.cumsum(rng.uniform(0.002, 0.02, 2000))
    for t_s in times:
        made.add_imu(ImuSample(float(t_s), force((1, 0, 0, 0), (math.sin(t_s), 0, 0)), (0, 0, 0)))
        made.add_attitude(AttitudeSample(float(t_s), (1, 0, 0, 0)))
    velocity = sum(made.close(k).accel_mps2[0] * PERIOD_S for k in range(10, 100))
    inside = [t for t in times if 1.0 <= t <= 10.0]
    expected = math.cos(1.0) - math.cos(10.0)
    assert max(b - a for a, b in pairwise(inside)) < 0.05
    assert velocity == pytest.approx(expected, abs=2e-3)


def test_an_attitude_without_aiding_is_taken_for_tilted_at_once() -> None:
    made = timeline()
    fill(made, 0.0, 0.25)
    for i in range(13, 26, 2):
        made.add_attitude(AttitudeSample(0.02 * i + 0.001, (1, 0, 0, 0), aided=False))
    fill(made, 0.25, 0.5)
    first, later = made.close(0), made.close(4)
    assert first.aided
    assert not later.aided
    assert first.accel_mps2 == pytest.approx(later.accel_mps2)
    assert np.sqrt(later.variance) == pytest.approx([math.hypot(0.1, TILTED_MPS2)] * 3)


@given(st.integers(0, 2), st.sampled_from([-1.0, 1.0]), st.floats(5.0, 160.0))
def test_an_accelerometer_at_its_limit_is_as_good_as_none(axis: int, sign: float, limit_mps2: float) -> None:
    # GIVEN one component that stays at a limit for a second while the others have noise
    made, rng, closed = timeline(), random.Random(3), []
    for i in range(307):
        value = [rng.gauss(0.0, 0.3), rng.gauss(0.0, 0.3), rng.gauss(-GRAVITY, 0.3)]
        if 100 <= i < 200:
            value[axis] = sign * limit_mps2
        made.add_imu(ImuSample(0.01 * i, (value[0], value[1], value[2]), (0, 0, 0)))
        made.add_attitude(AttitudeSample(0.01 * i, (1, 0, 0, 0)))
        if i % 10 == 6 and i > 10:  # as a tick is closed some time after its end
            closed.append(made.close(i // 10 - 1))
    # THEN the accelerations of that second are unknown, its first samples among them, and no others
    assert made.skipped["imu: at its limit"] == 100
    for each in closed:
        assert each.coverage == (pytest.approx(0.0 if 10 <= each.tick < 20 else 1.0, abs=0.5))
        assert max(map(abs, each.accel_mps2)) < 1.0


def test_values_in_coarse_steps_repeat_by_chance() -> None:
    made, rng, step = timeline(), random.Random(4), 0.0098
    for i in range(2000):
        down = step * round(rng.gauss(-GRAVITY, 0.3 * step) / step)
        made.add_imu(ImuSample(0.01 * i, (step * rng.randrange(30), 0.0, down), (0, 0, 0)))
    assert not made.skipped


def test_samples_that_are_held_are_not_at_a_limit() -> None:
    # GIVEN an autopilot that sends each measured sample ten times
    made, rng = timeline(), random.Random(5)
    for i in range(2000):
        if i % 10 == 0:
            value = rng.gauss(0.0, 0.3), rng.gauss(0.0, 0.3), rng.gauss(-GRAVITY, 0.3)
        made.add_imu(ImuSample(0.01 * i, value, (0, 0, 0)))
    assert not made.skipped


def test_an_imu_without_noise_that_stands_still_or_turns_is_not_at_its_limit() -> None:
    made = timeline()
    fill(made, 0.0, 0.5, (0.0, 0.0, 0.0))
    assert made.close(4).coverage == pytest.approx(1.0, abs=1e-6)
    assert made.skipped == {"imu: in no tick": 40}  # the ticks before were never closed
