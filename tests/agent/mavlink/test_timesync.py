"""The autopilot's clock in virtual time: offset, drift, queues, steps, and no TIMESYNC at all."""

from __future__ import annotations

import numpy as np
import pytest

from agent.mavlink.timesync import BootClock

TAG = 197


class VirtualAutopilot:
    """Answers with a boot clock that started at ``boot_s`` of host time and runs fast by ``drift``."""

    def __init__(self, boot_s: float, drift: float = 0.0) -> None:
        self.boot_s, self.drift = boot_s, drift

    def time_s(self, host_s: float) -> float:
        return (host_s - self.boot_s) * (1 + self.drift)

    def exchange(self, clock: BootClock, now_s: float, there_s: float, back_s: float) -> bool:
        ts1 = clock.request(now_s, TAG)
        if ts1 is None:
            return False
        clock.on_reply(round(self.time_s(now_s + there_s) * 1e9), ts1, now_s + there_s + back_s)
        return True


def test_requests_come_fast_at_first_then_once_a_second_and_each_is_ours_alone() -> None:
    clock, seen = BootClock(), []
    for step in range(2000):
        ts1 = clock.request(100.0 + 0.01 * step, TAG)
        if ts1 is not None:
            seen.append(ts1)
    assert 105 <= len(seen) <= 115
    assert len(set(seen)) == len(seen)
    assert all(ts1 % 1000 == TAG for ts1 in seen)


@pytest.mark.parametrize("drift", [0.0, 50e-6, -0.017])
def test_offset_and_drift_are_found_through_queues(drift: float) -> None:
    rng = np.random.default_rng(1)
    autopilot, clock = VirtualAutopilot(90.0, drift), BootClock()
    for step in range(3000):
        there_s, back_s = 0.0005 + rng.exponential(0.001, 2)
        autopilot.exchange(clock, 100.0 + 0.01 * step, float(there_s), float(back_s))
    now_s = 130.0
    assert clock.synchronised
    assert clock.host_s(autopilot.time_s(now_s)) == pytest.approx(now_s, abs=1e-3)
    assert clock.rtt_s == pytest.approx(0.001, abs=1e-3)


def test_replies_nobody_asked_for_and_slow_ones_are_rejected() -> None:
    autopilot, clock = VirtualAutopilot(90.0), BootClock()
    assert autopilot.exchange(clock, 100.0, 0.001, 0.001)
    clock.on_reply(10**9, 12345, 100.1)
    assert autopilot.exchange(clock, 100.2, 0.001, 0.2)
    assert clock.rejected == 2
    assert clock.host_s(10.5) == pytest.approx(100.5, abs=1e-6)


def test_a_reply_counts_once() -> None:
    clock = BootClock()
    ts1 = clock.request(100.0, TAG)
    assert ts1 is not None
    clock.on_reply(10**10, ts1, 100.001)
    clock.on_reply(10**10, ts1, 100.002)
    assert clock.rejected == 1


def test_one_outlier_is_rejected_but_a_step_is_followed() -> None:
    clock, autopilot = BootClock(), VirtualAutopilot(90.0)
    now_s = 100.0
    while now_s < 105.0:
        autopilot.exchange(clock, now_s, 0.001, 0.001)
        now_s += 0.1
    stepped = VirtualAutopilot(90.0 - 7.0)
    stepped.exchange(clock, now_s, 0.001, 0.001)
    assert clock.host_s(autopilot.time_s(now_s)) == pytest.approx(now_s, abs=1e-4)
    for _ in range(8):
        now_s += 0.1
        stepped.exchange(clock, now_s, 0.001, 0.001)
    assert clock.host_s(stepped.time_s(now_s)) == pytest.approx(now_s, abs=1e-3)


def test_without_timesync_the_smallest_latency_serves() -> None:
    rng = np.random.default_rng(2)
    clock = BootClock()
    assert clock.host_s(1.0) is None
    for step in range(1000):
        boot_s = 10.0 + 0.01 * step
        clock.on_arrival(boot_s, boot_s + 90.0 + 0.002 + float(rng.exponential(0.02)))
    assert not clock.synchronised
    assert clock.host_s(20.0) == pytest.approx(110.002, abs=2e-3)


def test_after_a_reset_nothing_of_the_old_clock_is_left() -> None:
    clock, autopilot = BootClock(), VirtualAutopilot(90.0)
    autopilot.exchange(clock, 100.0, 0.001, 0.001)
    clock.reset()
    assert clock.host_s(10.0) is None
    assert clock.rtt_s is None


@pytest.mark.parametrize("drift", [0.0, 3e-3, -2e-2])
def test_boot_times_of_host_times_are_the_way_back(drift: float) -> None:
    clock, autopilot = BootClock(), VirtualAutopilot(40.0, drift)
    assert clock.boot_s(100.0) is None
    for step in range(2000):
        autopilot.exchange(clock, 100.0 + 0.01 * step, 0.001, 0.001)

    for host_s in (115.0, 119.5, 120.3):
        boot_s = clock.boot_s(host_s)
        assert boot_s is not None
        assert clock.host_s(boot_s) == pytest.approx(host_s, abs=1e-5)
        assert boot_s == pytest.approx(autopilot.time_s(host_s), abs=2e-3)
