"""Latency profiles, and the latency of GPS learned and applied in the agent core."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from agent.config.tables import FleetConfig, SensorsTable
from agent.outputs import EstimateReady
from agent.sensing.latency import GpsLatency, gps_prior, imu_latency_s
from agent.sensing.samples import NO_LATENCY, AttitudeSample, GpsSample, ImuSample, LatencyPrior
from agent.sensing.timeline import TickInput
from tests.support.manoeuvres import Course
from tests.support.onboard import CONNECTED, onboard_of

PERIOD_S = 0.1
GRAVITY_MPS2 = 9.80665
PRIOR = LatencyPrior("test arrival", 0.20, 0.08)
TRUE_S = 0.26


def fix_at(course: Course, stamp_s: float, true_s: float = TRUE_S, prior: LatencyPrior = PRIOR) -> GpsSample:
    """A perfect fix that is older than its stamp says."""
    (north, east), (v_north, v_east) = course.position(stamp_s - true_s), course.velocity(stamp_s - true_s)
    velocity = float(v_north), float(v_east)
    return GpsSample(stamp_s, (float(north), float(east), -5.0), 0.05, 0.1, velocity, None, 0.05, 3, prior)


def tick_of(course: Course, tick: int) -> TickInput:
    """The exact mean acceleration of a tick."""
    north, east = course.mean_accel(tick * PERIOD_S, (tick + 1) * PERIOD_S)
    return TickInput(tick, (float(north), float(east), 0.0), (0.01, 0.01, 0.01), 1.0, 10)


def fly(made: GpsLatency, course: Course, ticks: range, true_s: float = TRUE_S, prior: LatencyPrior = PRIOR) -> None:
    """Fixes at 5 Hz that come when they are stamped."""
    for tick in ticks:
        if tick % 2 == 0:
            made.on_fix(fix_at(course, tick * PERIOD_S, true_s, prior))
        made.on_tick(tick_of(course, tick))


@pytest.mark.parametrize("flavour", ["ardupilot", "px4", "other"])
def test_profiles_cover_what_was_measured(flavour: str) -> None:
    # GIVEN latencies seen: simulated autopilots, and u-blox receivers as both autopilots' developers take them
    seen = {"ardupilot": {"boot": (0.085, 0.12), "arrival": (0.265, 0.32)}, "px4": {"boot": (0.0, 0.11)}}
    # THEN each is within one and a half sigma of its prior
    for stamp, values in seen.get(flavour, {}).items():
        prior = gps_prior(flavour, stamp, SensorsTable())  # type: ignore[arg-type]
        assert max(abs(value - prior.latency_s) for value in values) < 1.5 * prior.sigma_s
    # AND arrival is later than the autopilot's stamp, and less certain
    boot, arrival = (gps_prior(flavour, stamp, SensorsTable()) for stamp in ("boot", "arrival"))
    assert arrival.latency_s > boot.latency_s
    assert arrival.sigma_s > boot.sigma_s
    assert len({gps_prior(flavour, stamp, SensorsTable()).source for stamp in ("boot", "utc", "arrival")}) == 3


def test_the_configuration_overrides_the_profile() -> None:
    def configured(**sensors: float) -> tuple[float, float]:
        prior = gps_prior("ardupilot", "boot", SensorsTable(**sensors))
        return prior.latency_s, prior.sigma_s

    assert configured() == (0.10, 0.04)
    assert configured(gps_latency_s=0.2) == (0.2, 0.0)
    assert configured(gps_latency_s=0.2, gps_latency_sigma_s=0.05) == (0.2, 0.05)
    assert configured(gps_latency_sigma_s=0.1) == (0.10, 0.1)
    assert imu_latency_s("ardupilot", SensorsTable()) == 0.0125
    assert imu_latency_s("ardupilot", SensorsTable(imu_latency_s=0.0)) == 0.0
    assert imu_latency_s("auto", SensorsTable()) == 0.0


def test_a_fix_moves_to_its_instant_and_owns_up_to_the_doubt() -> None:
    # GIVEN a drone at 3, 4 m/s and a latency of 0.2 +- 0.08 s
    made = GpsLatency(PERIOD_S, SensorsTable())
    made.on_tick(TickInput(0, (0.0, 2.0, 9.0), (0.01,) * 3, 1.0, 10))
    sample = GpsSample(10.0, (1.0, 2.0, 3.0), 0.3, 0.5, (3.0, 4.0), None, 0.1, 3, PRIOR)
    # WHEN a fix comes
    moved = made.on_fix(sample)
    # THEN it is 0.2 s older, and 5 m/s 0.08 s = 0.4 m and 2 m/s2 0.08 s less sure
    assert moved.t_s == pytest.approx(9.8)
    assert moved.position_m == sample.position_m
    assert moved.horizontal_sigma_m == pytest.approx(0.5)
    assert moved.vertical_sigma_m == 0.5
    assert moved.speed_sigma_mps == pytest.approx(math.hypot(0.1, 0.16))
    for speed_mps, sigma_m in ((5.0, 0.5), (None, 0.3)):
        norm = replace(sample, ground_velocity_mps=None, speed_mps=speed_mps)
        assert made.on_fix(norm).horizontal_sigma_m == pytest.approx(sigma_m)


def test_an_exactly_known_latency_is_applied_and_not_estimated() -> None:
    for made, prior in (
        (GpsLatency(PERIOD_S, SensorsTable()), LatencyPrior("exact", 0.2, 0.0)),
        (GpsLatency(PERIOD_S, SensorsTable(estimate_latency=False)), PRIOR),
        (GpsLatency(1.0, SensorsTable()), PRIOR),
    ):
        fly(made, Course.eight(), range(300), prior=prior)
        assert (made.latency_s, made.sigma_s) == (0.2, prior.sigma_s)
        assert not made.counters
    untouched = fix_at(Course.eight(), 5.0, prior=NO_LATENCY)
    assert GpsLatency(PERIOD_S, SensorsTable()).on_fix(untouched) == untouched


def test_what_is_learned_is_applied() -> None:
    # GIVEN fixes 0.26 s old where 0.2 s is believed
    made, course = GpsLatency(PERIOD_S, SensorsTable()), Course.eight()
    assert (made.latency_s, made.sigma_s) == (None, None)
    # WHEN the drone has turned for a minute
    fly(made, course, range(600))
    # THEN fixes are moved by what they are really late, within what is said to be known
    assert made.sigma_s is not None
    assert made.sigma_s < 0.03
    moved = made.on_fix(fix_at(course, 60.0))
    assert moved.t_s == pytest.approx(60.0 - TRUE_S, abs=0.02)
    assert made.counters["used"] > 250


def test_fixes_of_both_kinds_of_stamp_are_learned_by_themselves() -> None:
    # GIVEN a receiver that is stamped by arrival for 40 s and has stamps of its own from then on
    made, course = GpsLatency(PERIOD_S, SensorsTable()), Course.eight()
    own = LatencyPrior("test boot", 0.10, 0.04)
    fly(made, course, range(400))
    arrival_s = made.latency_s
    assert arrival_s is not None
    # WHEN the stamps change
    made.on_fix(fix_at(course, 40.0, 0.085, own))
    # THEN the new kind begins at its own prior, and is learned in turn; the old one is not forgotten
    assert (made.latency_s, made.sigma_s) == pytest.approx((0.10, 0.04))
    fly(made, course, range(400, 900), 0.085, own)
    assert made.latency_s == pytest.approx(0.085, abs=0.02)
    moved = made.on_fix(fix_at(course, 90.0))
    assert 90.0 - moved.t_s == pytest.approx(arrival_s, abs=1e-3)


def test_late_early_and_broken_fixes_stop_nothing() -> None:
    made, course = GpsLatency(PERIOD_S, SensorsTable()), Course.eight()
    fly(made, course, range(100))
    made.on_fix(fix_at(course, 9.0))  # once more
    made.on_fix(replace(fix_at(course, 9.9), position_m=(math.nan, 0.0, 0.0)))
    fly(made, course, range(100, 130))
    assert made.counters["unusable"] == 2
    # ticks that were left out (a suspended computer): what is known stays, the motion starts anew
    before = made.latency_s
    fly(made, course, range(500, 560))
    assert made.counters["restarted"] == 1
    assert made.latency_s == pytest.approx(before, abs=0.02)
    # and hundreds of fixes without any tick do not pile up
    for k in range(500):
        made.on_fix(fix_at(course, 56.0 + 0.1 * k))
    fly(made, course, range(560, 600))
    assert made.latency_s is not None
    assert math.isfinite(made.latency_s)


@dataclass
class Flight:
    """One drone with perfect sensors whose fixes come late and unstamped."""

    config: FleetConfig
    course: Course

    def __post_init__(self) -> None:
        self.core = onboard_of(self.config).core
        self.errors_m: list[float] = []
        self.latencies: list[tuple[float | None, float | None]] = []

    def run(self, duration_s: float) -> Flight:
        for step in range(round(duration_s / 0.01)):
            now_s = step * 0.01
            if step % 2 == 0:
                north, east = self.course.mean_accel(now_s - 0.005, now_s + 0.005)
                force = (float(north), float(east), -GRAVITY_MPS2)
                self.core.on_imu(ImuSample(now_s, force, (0.0, 0.0, 0.0)), now_s)
                self.core.on_attitude(AttitudeSample(now_s, (1.0, 0.0, 0.0, 0.0)), now_s)
            if step % 20 == 4:
                self.core.on_gps(fix_at(self.course, now_s), now_s)
            for output in self.core.advance(now_s, CONNECTED):
                if isinstance(output, EstimateReady):
                    error = output.estimate.mean[:2] - self.course.position(output.t_s)
                    self.errors_m.append(float(np.linalg.norm(error)))
                    self.latencies.append((self.core.gps_latency.latency_s, self.core.gps_latency.sigma_s))
        return self


def test_in_the_core_the_estimate_follows_what_is_learned(make_config: Callable[..., FleetConfig]) -> None:
    # GIVEN the same flight of a minute with and without estimation of the latency
    # (with a window that late fixes fit into)
    changed = ["sensors.gps_position_half_width_m=0.1", "sensors.gps_speed_half_width_mps=0.1"]
    changed += ["estimator.kind=dmhe_shared", "estimator.window=6"]
    on = Flight(make_config(1, *changed), Course.eight()).run(60.0)
    off = Flight(make_config(1, *changed, "sensors.estimate_latency=false"), Course.eight()).run(60.0)
    again = Flight(make_config(1, *changed), Course.eight()).run(60.0)
    # THEN a latency wrong by 60 ms shows in the position, and is gone once it is learned
    last = slice(-150, None)
    assert np.median(off.errors_m[last]) > 0.1
    assert np.median(on.errors_m[last]) < 0.4 * np.median(off.errors_m[last])
    # AND the same inputs give the same answers, bit by bit
    assert again.errors_m == on.errors_m
    assert again.latencies == on.latencies
