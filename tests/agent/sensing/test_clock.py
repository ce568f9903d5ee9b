"""The fleet's clock: slewed, stepped, and an epoch or a host's time that cannot be."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agent.config.tables import FleetConfig
from agent.errors import ConfigError
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, Send
from agent.sensing.clock import FleetClock, require_epoch, step_fault
from agent.watch.health import State
from estimators.factory import make_estimator
from transport.messages.measurement_body import Measurements
from transport.security.auth import Identity

MakeConfig = Callable[..., FleetConfig]


def test_small_differences_are_slewed_and_time_never_goes_back() -> None:
    clock = FleetClock(1000.0, unix_s=5000.0, host_s=10.0)
    assert clock.fleet_s(10.0) == 4000.0
    last = 0.0
    for step in range(1, 300):
        host_s = 10.0 + step
        assert not clock.sync(unix_s=4990.0 + host_s - 0.2, host_s=host_s)
        assert clock.fleet_s(host_s) > last
        last = clock.fleet_s(host_s)
    assert clock.fleet_s(309.0) == pytest.approx(4299.0 - 0.2, abs=1e-9)
    assert clock.steps == 0


@given(st.floats(0.6, 1e6), st.booleans())
def test_a_step_of_utc_is_followed_at_once_and_said(size_s: float, forward: bool) -> None:
    clock = FleetClock(0.0, unix_s=2e6, host_s=0.0)
    size_s = size_s if forward else min(size_s, 59.0)
    jumped = 2e6 + 1.0 + (size_s if forward else -size_s)
    assert clock.sync(unix_s=jumped, host_s=1.0)
    assert clock.fleet_s(1.0) == pytest.approx(jumped)
    assert clock.steps == 1


def test_a_step_far_back_is_not_followed_and_said(make_config: MakeConfig) -> None:
    clock = FleetClock(0.0, unix_s=2e6, host_s=0.0)
    assert not clock.sync(unix_s=2e6 + 1.0 - 3600.0, host_s=1.0)
    assert clock.fleet_s(1.0) == pytest.approx(2e6 + 1.0)
    assert step_fault(clock) == "clock stepped back by 3600 s, not followed: start the daemon anew"
    # until it is right again
    assert not clock.sync(unix_s=2e6 + 2.0, host_s=2.0)
    assert step_fault(clock) is None


@given(back_s=st.floats(0.6, 2.0), at_s=st.floats(0.0, 0.3))
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_tick_comes_twice_after_a_step_back(make_config: MakeConfig, back_s: float, at_s: float) -> None:
    # GIVEN an agent in flight, WHEN its clock is set back in the midst of whatever it does
    config = make_config(2)
    start_s = config.fleet.epoch_unix_s + 1000.0
    agent = OnboardAgent(config, 1, make_estimator, Identity(), unix_s=start_s, host_s=0.0)
    ticks, told, host_s, stepped = [], [], 0.0, False
    while host_s < 3.0 + back_s:
        outputs = agent.advance(host_s)
        if host_s >= 1.0 + at_s and not stepped:
            stepped = True
            outputs += agent.keep_house(unix_s=start_s + host_s - back_s, host_s=host_s)
        ticks += [each.estimate.tick for each in outputs if isinstance(each, EstimateReady)]
        told += [each.message for each in outputs if isinstance(each, Send)]
        host_s += 0.01
    # THEN its estimates' ticks rise, it says nothing twice of a tick, and it comes back as soon as may be
    assert all(later > earlier for earlier, later in pairwise(ticks))
    sent = [(message.tick, message.exchange) for message in told if isinstance(message, Measurements)]
    assert len(set(sent)) == len(sent)
    now = (1000.0 + host_s - back_s) / config.fleet.period_s
    assert ticks[-1] == pytest.approx(now, abs=3)
    longest = max(later - earlier for earlier, later in pairwise(ticks))
    assert longest <= 3


def test_an_epoch_that_leaves_now_without_a_tick_is_refused(make_config: MakeConfig) -> None:
    now_s = 1_790_000_000.0
    assert require_epoch(make_config(), unix_s=now_s) is None
    for epoch_s in (0.0, 4_000_000_000.0):
        config = make_config(3, f"fleet.epoch_unix_s={epoch_s}")
        expected = r"--set: fleet.epoch_unix_s: expected 1360503270..1790000000, .* found "
        with pytest.raises(ConfigError, match=f"{expected}{epoch_s:.0f}$"):
            require_epoch(config, unix_s=now_s)


def test_a_host_that_was_never_told_the_time_is_no_fault_of_the_epoch(make_config: MakeConfig) -> None:
    assert require_epoch(make_config(), unix_s=1e9) == "clock at 2001-09-09, outside the fleet's time"
    # nor where it went on from its last shutdown, a month before the fleet's epoch
    config = make_config(3, "fleet.epoch_unix_s=1790000000")
    assert require_epoch(config, unix_s=1_790_000_000.0 - 30 * 86_400.0) is not None


def test_the_health_says_while_ticks_fit_no_packet(make_config: MakeConfig) -> None:
    # GIVEN a companion computer that starts before its clock is set
    config = make_config()
    onboard = OnboardAgent(config, 1, make_estimator, Identity(), unix_s=1e9, host_s=0.0)
    for step in range(20):
        onboard.advance(0.05 * step)
    health = onboard.core.health.health
    assert health.state is State.INIT
    assert health.reasons[0] == "clock at 2001-09-09, outside the fleet's time"
    # WHEN it is set THEN that is over
    assert onboard.keep_house(unix_s=1_790_000_000.0, host_s=1.0)
    for step in range(20):
        onboard.advance(1.0 + 0.05 * step)
    assert not [reason for reason in onboard.core.health.health.reasons if reason.startswith("clock")]
