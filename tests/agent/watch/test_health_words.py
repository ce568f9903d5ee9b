"""The health in words: which state and reasons follow from findings, and when a change is told."""

from __future__ import annotations

import pytest

from agent.watch.health import Health, HealthMonitor, State, assess
from estimators.integrity.finding import Finding, Gravity, What

NO_FIX = Finding(What.NO_FIX, Gravity.DEGRADED)
FEW = Finding(What.TOO_FEW_RANGED, Gravity.ALARM, value=2, limit=3)
PLANE = Finding(What.ONE_PLANE, Gravity.ALARM, value=2, limit=3)
TWO_PLACES = Finding(What.AMBIGUOUS, Gravity.ALARM, value=1, limit=0)
UNOBSERVABLE = Finding(What.NOT_OBSERVABLE, Gravity.ALARM)
NOT_YET = Finding(What.NOT_ALIGNED, Gravity.NOT_YET, value=3.0, limit=2.0)
CLOCK = Finding(What.CLOCK, Gravity.DEGRADED, detail="clock at 2001-09-09")


def silent(*agents: int) -> tuple[Finding, ...]:
    return tuple(Finding(What.SILENT, Gravity.DEGRADED, agent, 3.0, 1.0) for agent in agents)


@pytest.mark.parametrize(
    ("findings", "expected"),
    [
        ((), Health(State.OK, ())),
        ((Finding(What.LATENCY, Gravity.NOTED, value=2.0, limit=1.0),), Health(State.OK, ())),
        ((Finding(What.NO_ESTIMATE, Gravity.ABSENT, detail="fixes"),), Health(State.INIT, ("fixes",))),
        ((Finding(What.NO_ESTIMATE, Gravity.ABSENT), NO_FIX), Health(State.INIT, ("no GPS",))),
        ((NOT_YET, NO_FIX), Health(State.ALIGNING, ("no GPS",))),
        ((Finding(What.UNKNOWN, Gravity.UNUSABLE), NO_FIX), Health(State.FAULT, ("position unknown", "no GPS"))),
        ((Finding(What.UNCERTAIN, Gravity.DEGRADED),), Health(State.DEGRADED, ("position uncertain",))),
        ((Finding(What.FELL_BACK, Gravity.DEGRADED),), Health(State.DEGRADED, ("estimate fell back",))),
        ((Finding(What.NO_DATA, Gravity.DEGRADED),), Health(State.DEGRADED, ("estimate no data",))),
        ((NO_FIX,), Health(State.DEGRADED, ("no GPS",))),
        ((Finding(What.IMU_GAP, Gravity.DEGRADED),), Health(State.DEGRADED, ("IMU incomplete",))),
        ((Finding(What.AUTOPILOT, Gravity.DEGRADED, detail="lost"),), Health(State.DEGRADED, ("autopilot lost",))),
        (silent(2, 5), Health(State.DEGRADED, ("not heard: 2, 5",))),
        (
            silent(*range(901, 943)),
            Health(State.DEGRADED, ("not heard: 901, 902, 903, 904, 905, 906, 907, 908, ... and 34 more",)),
        ),
        ((UNOBSERVABLE,), Health(State.DEGRADED, ("not observable",), alarm=True)),
        (
            (FEW, NO_FIX),
            Health(
                State.DEGRADED, ("not observable: ranges to 2 located neighbours, 3 needed", "no GPS"), alarm=True
            ),
        ),
        (
            (NOT_YET, TWO_PLACES, NO_FIX),
            Health(State.ALIGNING, ("not observable: the ranges leave more than one place", "no GPS"), alarm=True),
        ),
    ],
)
def test_the_state_is_that_of_the_gravest_finding_and_each_has_its_reason(
    findings: tuple[Finding, ...], expected: Health
) -> None:
    assert assess(findings) == expected


@pytest.mark.parametrize(
    ("findings", "told"),
    [
        ((TWO_PLACES, FEW, UNOBSERVABLE), "not observable: the ranges leave more than one place"),
        ((FEW, UNOBSERVABLE), "not observable: ranges to 2 located neighbours, 3 needed"),
        ((PLANE, UNOBSERVABLE), "not observable: all located neighbours in one plane"),
    ],
)
def test_why_a_position_is_not_observable_is_told_once_as_exactly_as_can_be(
    findings: tuple[Finding, ...], told: str
) -> None:
    assert assess(findings).reasons == (told,)


def test_what_is_held_comes_first_until_it_is_over_and_makes_no_fault_of_a_start() -> None:
    monitor = HealthMonitor()
    monitor.hold((CLOCK,))
    monitor.update((Finding(What.NO_ESTIMATE, Gravity.ABSENT, detail="waiting for fixes"),), 1.0)
    assert str(monitor.health) == "init: clock at 2001-09-09; waiting for fixes"
    monitor.update((), 2.0)
    assert str(monitor.health) == "degraded: clock at 2001-09-09"
    monitor.hold(())
    monitor.update((), 3.0)
    assert str(monitor.health) == "ok"


def test_a_flapping_state_is_reported_once_a_second_and_the_last_word_comes_through() -> None:
    monitor, reported = HealthMonitor(), []
    for step in range(500):
        flapping = step < 400 and step % 2
        health = monitor.update((NO_FIX,) if flapping else (), 100.0 + 0.01 * step)
        if health is not None:
            reported.append(health)
    assert 2 <= len(reported) <= 6
    assert monitor.changes > 300
    assert reported[-1].state is monitor.health.state is State.OK


def test_the_alarm_is_raised_and_cleared_as_changes_of_health() -> None:
    monitor, reported = HealthMonitor(), []
    for step in range(60):
        health = monitor.update((FEW, NO_FIX) if 20 <= step < 40 else (), 100.0 + 0.1 * step)
        if health is not None:
            reported.append(health)
    assert [health.alarm for health in reported] == [False, True, False]
    assert str(reported[1]).startswith("ALARM, degraded: not observable: ranges to 2")
    assert str(reported[2]) == "ok"


@pytest.mark.parametrize("what", What)
def test_whatever_is_grave_has_its_words(what: What) -> None:
    health = assess((Finding(what, Gravity.DEGRADED, about=2, value=1.0, limit=2.0, detail="in words"),))
    assert health.state is State.DEGRADED
    assert len(health.reasons) == (what is not What.NOT_ALIGNED)  # that is the state itself
