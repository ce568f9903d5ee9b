"""Fake autopilots that fuse: they use, refuse, reset, time out and fail safe with the firmware's figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.autopilot.failsafe import EstimatorFailsafe
from sim_bridge.autopilot.feed_clock import FeedClock
from sim_bridge.autopilot.flavours import FlightMode
from sim_bridge.autopilot.fusing import FIGURES, FusingNavigation
from sim_bridge.autopilot.navigation import OutsideState
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.quaternions import Array
from sim_bridge.world.scenario import Interval, Vehicle
from sim_bridge.world.sensors import GpsFix

STEP_S = 0.02
SPEED = np.array((2.0, 0.0, 0.0))


class Straight:
    """A vehicle that flies north at 2 m/s, its autopilot fed now and then."""

    def __init__(self, flavour: FlavourName) -> None:
        self.navigation = FusingNavigation(flavour)
        self.now_s = 0.0

    @property
    def truth_m(self) -> Array:
        return self.now_s * SPEED

    @property
    def error_m(self) -> float:
        return float(np.linalg.norm(self.navigation.position_m - self.truth_m))

    def go(
        self,
        seconds: float,
        *,
        gps: bool = False,
        feed_hz: float = 0.0,
        off_m: float = 0.0,
        age_s: float = 0.0,
        taken_late_s: float = 0.0,
        counter: int = 1,
        relative: bool = False,
        fixes_off_m: float = 0.0,
        off_mps: float = 0.0,
    ) -> None:
        """Fly on; a feed is ``off_m`` east of the truth, of ``age_s`` ago, and taken for that much younger; its
        velocity is ``off_mps`` off, and fixes are ``fixes_off_m`` east of the truth."""
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            self.navigation.predict(np.zeros(3), self.now_s)
            step = round(self.now_s / STEP_S)
            if gps and step % 10 == 0:
                place = tuple(float(each) for each in self.truth_m + np.array((0.0, fixes_off_m, 0.0)))
                moves = {"position_ned_m": place, "velocity_ned_mps": (2.0, 0.0, 0.0)}
                self.navigation.on_fix(GpsFix(self.now_s, True, **moves, h_acc_m=0.5, v_acc_m=0.5), self.now_s)
            if feed_hz and step % round(1.0 / (feed_hz * STEP_S)) == 0:
                then = (self.now_s - age_s) * SPEED + (0.0, off_m, 0.0)
                sigma = np.full(3, 0.3)
                taken_s = self.now_s - age_s + taken_late_s
                fed_mps = SPEED + np.array((0.0, off_mps, 0.0))
                fed = OutsideState(then, fed_mps, sigma, sigma, taken_s, counter, relative=relative)
                self.navigation.on_outside(fed, self.now_s)


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_it_follows_gps_and_then_a_feed(flavour: FlavourName) -> None:
    flight = Straight(flavour)
    flight.go(10.0, gps=True)
    flight.go(1.2)
    flight.go(10.0, feed_hz=10.0, age_s=0.16)

    assert flight.error_m < 0.05
    assert flight.navigation.aided(flight.now_s)


def test_a_feed_that_is_taken_for_younger_than_it_is_leaves_it_behind() -> None:
    flight = Straight("px4")
    flight.go(10.0, gps=True)
    flight.go(20.0, feed_hz=10.0, age_s=0.2, taken_late_s=0.2)

    assert flight.error_m == pytest.approx(0.4, abs=0.1)  # 2 m/s for 0.2 s


def test_px4_takes_only_the_motion_of_a_feed_while_it_counts_on_its_receiver_and_is_set_to_it_then() -> None:
    # as in tests/data/feedback/px4_feed_begins.csv
    flight = Straight("px4")
    flight.go(10.0, gps=True)
    flight.go(1.2)
    flight.go(5.6, feed_hz=10.0, off_m=1.0, relative=True)
    assert (flight.error_m, flight.navigation.resets) == (pytest.approx(0.2, abs=0.1), 0)  # as late as its fixes
    flight.go(0.6, feed_hz=10.0, off_m=1.0, relative=True)

    assert (flight.error_m, flight.navigation.resets) == (pytest.approx(1.0, abs=0.1), 1)


@pytest.mark.parametrize(("fixes_off_m", "used"), [(0.5, True), (5.0, False)])
def test_px4_leaves_a_receiver_out_that_comes_back_far_from_a_feed(fixes_off_m: float, used: bool) -> None:
    flight = Straight("px4")
    flight.go(5.0, gps=True)
    flight.go(10.0, feed_hz=10.0, relative=True)
    flight.go(4.0, gps=True, feed_hz=10.0, fixes_off_m=fixes_off_m, relative=True)

    assert (flight.navigation.refused == 0) is used
    assert flight.error_m == pytest.approx(fixes_off_m if used else 0.0, abs=0.3)


def test_a_velocity_that_is_refused_for_a_second_is_set() -> None:
    flight = Straight("px4")
    flight.go(5.0, gps=True)
    flight.go(8.0, feed_hz=10.0)
    flight.go(1.5, feed_hz=10.0, off_mps=3.0)

    assert flight.navigation.velocity_mps[1] > 1.0


@pytest.mark.parametrize(("flavour", "flag_s"), [("px4", 0.7), ("ardupilot", 7.0)])
def test_the_flag_goes_so_long_after_the_last_position(flavour: FlavourName, flag_s: float) -> None:
    flight = Straight(flavour)
    flight.go(5.0, gps=True)
    last_s = flight.now_s
    while flight.navigation.aided(flight.now_s):
        flight.go(STEP_S)

    assert flight.now_s - last_s == pytest.approx(flag_s, abs=0.1)


def test_what_is_far_off_is_refused_then_set_by_px4_after_a_second_of_nothing_else() -> None:
    flight = Straight("px4")
    flight.go(10.0, gps=True)
    flight.go(0.9, gps=True, feed_hz=10.0, off_m=30.0)
    assert flight.navigation.ratio(flight.now_s) > 1.0 or flight.navigation.refused > 0
    assert flight.error_m < 0.5
    flight.go(3.0, feed_hz=10.0, off_m=30.0)

    assert flight.error_m == pytest.approx(30.0, abs=1.0)  # a wrong feed that is sure wins in the end


def test_a_jump_that_is_announced_is_taken_at_once_and_one_that_is_not_is_refused() -> None:
    for counter, moved in ((2, True), (1, False)):
        flight = Straight("px4")
        flight.go(5.0, gps=True)
        flight.go(5.0, feed_hz=10.0)
        flight.go(0.2, feed_hz=10.0, off_m=8.0, counter=counter)
        assert (flight.error_m > 7.0) is moved
        assert (flight.navigation.refused > 0) is not moved


@pytest.mark.parametrize(("flavour", "landed_s", "returns"), [("px4", 4.5, True), ("ardupilot", 8.0, False)])
def test_it_lands_without_positions_and_only_px4_goes_on(
    flavour: FlavourName, landed_s: float, returns: bool
) -> None:
    failsafe, mode, now, modes = EstimatorFailsafe(FIGURES[flavour]), FlightMode.MISSION, 0.0, []
    while now < 30.0:
        now += 0.1
        unaided_s = now if now < 20.0 else 0.0
        entered = failsafe.step(mode, unaided_s, now)
        if entered is not None:
            mode = entered
            modes.append((entered, now))

    assert modes[0] == (FlightMode.LAND, pytest.approx(landed_s, abs=0.11))
    assert [each for each, _ in modes[1:]] == ([FlightMode.MISSION] if returns else [])


def test_a_pilot_who_takes_over_ends_the_failsafe() -> None:
    failsafe = EstimatorFailsafe(FIGURES["px4"])
    assert failsafe.step(FlightMode.MISSION, 5.0, 5.0) is FlightMode.LAND
    assert failsafe.step(FlightMode.HOLD, 0.0, 6.0) is None
    assert failsafe.step(FlightMode.HOLD, 0.0, 16.0) is None


def test_px4_takes_a_message_for_one_of_its_arrival_until_its_clock_filter_has_converged() -> None:
    clock = FeedClock("px4", {"EKF2_EV_DELAY": 0.0}.__getitem__)
    stamp_us = 1_000_000_000

    assert clock.taken_s(stamp_us, 5.0) == 5.0
    for _ in range(500):
        clock.on_timesync(1000.2, 5.0)
    assert clock.taken_s(stamp_us, 5.0) == pytest.approx(4.8)


def test_ardupilot_cannot_see_a_constant_age_and_takes_it_from_its_parameter() -> None:
    clock = FeedClock("ardupilot", {"VISO_DELAY_MS": 150.0}.__getitem__)
    for tick in range(200):
        now = 0.1 * tick + 0.2
        late_s = 0.05 if tick % 3 else 0.0
        taken_s = clock.taken_s(round(0.1 * tick * 1e6), now + late_s)

    assert now + late_s - taken_s == pytest.approx(0.15 + late_s, abs=1e-3)


HOVER = {"start_m": (5.0, 0.0, -20.0), "start_velocity_mps": (0.0, 0.0, 0.0)}


@pytest.mark.parametrize(("flavour", "lands_s"), [("px4", 9.5), ("ardupilot", 13.0)])
def test_without_gps_and_feed_the_simulated_vehicle_lands(connect: Any, flavour: FlavourName, lands_s: float) -> None:
    client = connect(Vehicle(1, flavour, 7, **HOVER), fusing=True, gps_outages=(Interval(1, 5.0, 1e9),))
    client.run_to(lands_s - 0.7)
    assert client.received["STATUSTEXT"] == []
    client.run_to(lands_s + 0.7)

    [text] = client.received["STATUSTEXT"]
    assert (text.text, text.severity) == ("EKF Failsafe: LAND", mavlink.MAV_SEVERITY_CRITICAL)
    assert client.simulation.autopilots[1].state.mode is FlightMode.LAND
