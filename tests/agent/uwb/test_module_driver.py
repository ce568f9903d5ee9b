"""What a driver makes of its module's readings: whose they are, and when they were taken."""

from __future__ import annotations

import numpy as np
import pytest

from agent.uwb.modules.driver import QUIET_S, ModuleDriver, TakenRanges
from agent.uwb.modules.kinds import KINDS
from agent.uwb.modules.module_clock import CONFIRM_S, MAX_JUMP_S, ModuleClock
from sim_bridge.uwb_modules.speech import SPEECHES, Dwm1001Speech, LinkTrackSpeech
from sim_bridge.world.sensors import SensedRange, SensedRanges

IDS = {1: 1, 2: 2, 3: 3}


def measured(*others: int) -> SensedRanges:
    return SensedRanges(1, 0.0, tuple(SensedRange(other, 5.0, 0.1, -80.0, -82.0, 0.0) for other in others))


def test_ranges_go_to_the_drones_that_carry_the_modules() -> None:
    driver = ModuleDriver(KINDS["uci"], 1, {1: 1, 7: 2}, sigma_m=0.05)
    (taken,) = driver.feed(SPEECHES["uci"](1).say(0.0, measured(7, 9, 1)), 3.0)
    assert taken.taken_s == 3.0
    assert [(each.other, each.range_m, each.sigma_m) for each in taken.ranges] == [(2, 5.0, 0.05)]
    assert dict(driver.left_out) == {"unknown module": 1, "of itself": 1}
    assert set(driver.strange) == {9}


def test_a_linktrack_that_belongs_to_another_drone_is_not_believed() -> None:
    driver, speech, found = ModuleDriver(KINDS["linktrack"], 1, IDS), LinkTrackSpeech(2), list[TakenRanges]()
    for k in range(10):
        found += driver.feed(speech.say(0.1 * k, measured(1, 3)), 0.1 * k)
    assert found == []
    assert driver.left_out["of another module"] == 20


def test_a_linktracks_own_clock_stamps_its_ranges_whatever_delays_them() -> None:
    # GIVEN frames every 0.1 s, which take 2 ms and up to 80 ms more, over a wrap of the module's clock
    rng, driver, speech = np.random.default_rng(5), ModuleDriver(KINDS["linktrack"], 1, IDS), LinkTrackSpeech(1)
    errors_s, arrival_s = [], 0.0
    for k in range(300):
        true_s = 0.1 * k
        arrival_s = max(arrival_s, true_s + 0.002 + rng.choice((0.0, rng.uniform(0.0, 0.08))))
        for taken in driver.feed(speech.say(true_s, measured(2, 3)), arrival_s):
            errors_s.append(taken.taken_s - true_s)
    assert len(errors_s) > 290
    assert 0.0 < np.mean(errors_s[10:]) < 0.005
    assert np.std(errors_s[10:]) < 0.002


def test_the_lag_that_is_known_is_taken_off() -> None:
    driver = ModuleDriver(KINDS["uci"], 1, IDS, lag_s=0.15)
    (taken,) = driver.feed(SPEECHES["uci"](1).say(0.0, measured(2)), 3.0)
    assert taken.taken_s == pytest.approx(2.85)


def test_a_module_that_begins_anew_is_believed_once_two_stamps_agree() -> None:
    clock = ModuleClock()
    assert [clock.taken_s(100.0 + t, 1.0 + t) is None for t in (0.0, 0.1, 0.3, 0.4)] == [True, True, False, False]
    # WHEN one stamp is wrong THEN it alone is left out
    assert clock.taken_s(7.0, 1.5) is None
    assert clock.taken_s(100.6, 1.6) == pytest.approx(1.6)
    # WHEN the module was switched off and on THEN it is believed again
    assert clock.taken_s(0.0, 5.0) is None
    assert clock.taken_s(CONFIRM_S + 0.01, 5.0 + CONFIRM_S + 0.01) == pytest.approx(5.0 + CONFIRM_S + 0.01)
    assert clock.jumps == 2


def test_what_waited_in_a_buffer_while_the_driver_stood_still_keeps_its_time() -> None:
    clock = ModuleClock()
    for k in range(10):
        clock.taken_s(0.1 * k, 50.0 + 0.1 * k)
    late = [clock.taken_s(0.1 * k, 50.0 + 1.9) for k in range(10, 19)]
    assert late[-1] == pytest.approx(50.0 + 1.8)
    assert all(taken is None or abs(taken - (50.0 + 0.1 * k)) < 1e-9 for k, taken in enumerate(late, 10))
    assert clock.jumps == 1
    assert MAX_JUMP_S <= 1.0  # older ones the daemon would refuse


def test_a_dwm1001_is_woken_once_it_is_silent_and_not_switched_off_again() -> None:
    driver, speech = ModuleDriver(KINDS["dwm1001"], 1, IDS), Dwm1001Speech(1)
    driver.plugged(0.0)
    found, sent = list[TakenRanges](), list[bytes]()
    for k in range(100):
        now_s = 0.1 * k
        typed = driver.to_send(now_s)
        sent += [typed] if typed else []
        found += driver.feed(speech.hear(typed), now_s) if typed else []
        found += driver.feed(speech.say(now_s, measured(2, 3)), now_s)
    assert sent == [b"\r\r", b"lec\r"]
    assert found[0].taken_s <= 2 * QUIET_S + 0.3
    assert len(found) >= 70
