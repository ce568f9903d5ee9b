"""The agent core when something in it fails: every tick has an estimate, and none is waited for in vain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.outputs import EstimateReady, Faulted
from estimators.estimator import Status
from tests.support.notebook_estimator import MakeConfig, fix, lone, tick_through
from tests.support.onboard import CONNECTED

Patch = pytest.MonkeyPatch


@pytest.mark.parametrize(
    ("fault", "counter"),
    [(np.linalg.LinAlgError("singular"), "estimator faults"), (IndexError("no such slot"), "core faults")],
)
@pytest.mark.parametrize("call", ["begin", "outgoing", "mix", "solve"])
def test_a_broken_estimator_falls_back_and_starts_anew(
    make_config: MakeConfig, call: str, fault: Exception, counter: str
) -> None:
    core, made = lone(make_config, count=2)

    def fail(what: str, tick: int) -> None:
        if (what, tick) == (call, 1003):
            raise fault

    core.advance(100.0, CONNECTED)
    tick_through(core, 100.0, 0.25)
    made[0].fail = fail
    made[0].mean[3] = 3.0
    outputs = tick_through(core, 100.25, 0.5)
    ready = [o for o in outputs if isinstance(o, EstimateReady)]
    statuses = {r.estimate.tick: r.estimate.status for r in ready}
    assert statuses[1003] is Status.FELL_BACK
    assert all(status is Status.OK for tick, status in statuses.items() if tick != 1003)
    assert len(made) == 2
    fallen = next(r.estimate for r in ready if r.estimate.tick == 1003)
    assert fallen.mean[:3] == pytest.approx([0.3, 0.0, 0.0])  # one tick further at 3 m/s
    assert fallen.covariance[0, 0] == pytest.approx(made[0].covariance[0, 0] + 1.0)
    assert core.counters[counter] == 1
    [told] = [o for o in outputs if isinstance(o, Faulted)]
    assert told.error is fault
    assert told.of_estimator is (counter == "estimator faults")


def test_an_estimate_that_is_not_finite_never_gets_out(make_config: MakeConfig) -> None:
    core, made = lone(make_config)
    tick_through(core, 100.0, 0.25)
    made[0].fail = lambda what, tick: (what, tick) == ("nan", 1003)  # type: ignore[assignment,return-value]
    ready = [o for o in tick_through(core, 100.25, 0.5) if isinstance(o, EstimateReady)]
    assert all(np.isfinite(r.estimate.mean).all() for r in ready)
    assert core.counters["estimator faults"] == 1


def test_no_fault_holds_up_a_core_for_longer_than_a_tick(make_config: MakeConfig, monkeypatch: Patch) -> None:
    # GIVEN a core whose every estimate fails, and what follows from the last one as well
    core, made = lone(make_config, count=2)
    tick_through(core, 100.0, 0.25)
    (estimator,) = made

    def broken(*_: object) -> None:
        raise RuntimeError("broken")

    with monkeypatch.context() as patch:
        patch.setattr(estimator, "solve", broken)
        patch.setattr(core.fleet, "fall_back", broken)
        # THEN each tick raises once, for the daemon to count, and is gone then
        raised = []
        for step in range(50):
            try:
                core.advance(100.25 + 0.01 * step, CONNECTED)
            except RuntimeError as error:
                raised.append(str(error))
    assert 3 <= len(raised) <= 5
    # and once the cause is gone estimates come again
    ready = [o for o in tick_through(core, 100.75, 0.4) if isinstance(o, EstimateReady)]
    assert [r.estimate.status for r in ready][-2:] == [Status.OK, Status.OK]
    assert ready[-1].estimate.tick >= 1008


def test_a_fault_while_a_tick_is_closed_costs_that_tick_alone(make_config: MakeConfig, monkeypatch: Patch) -> None:
    core, _ = lone(make_config, count=2)
    tick_through(core, 100.0, 0.25)
    close = core.timeline.close

    def failing(tick: int) -> object:
        if tick == 1004:
            raise KeyError(tick)
        return close(tick)

    monkeypatch.setattr(core.timeline, "close", failing)
    ready = [o for o in tick_through(core, 100.25, 0.5) if isinstance(o, EstimateReady)]
    assert [r.estimate.tick for r in ready] == list(range(1002, 1007))
    fell = [r.estimate.tick for r in ready if r.estimate.status is Status.FELL_BACK]
    assert fell == [1004]
    assert core.counters["core faults"] == 1


def test_three_faults_in_a_row_give_the_last_good_estimate_up(make_config: MakeConfig) -> None:
    # GIVEN a core that has an estimate, and fixes to come
    core, made = lone(make_config, "initial.fixes=5")
    core.advance(100.0, CONNECTED)
    tick_through(core, 100.0, 0.25)

    def fail(what: str, tick: int) -> None:
        if what == "solve" and tick >= 1003:
            raise np.linalg.LinAlgError("singular")

    def flown(start_s: float, duration_s: float) -> list[EstimateReady]:
        ready = []
        for step in range(round(duration_s / 0.01)):
            now_s = start_s + 0.01 * step
            if step % 20 == 0:
                core.on_gps(fix(now_s), now_s)
            ready += [o for o in core.advance(now_s, CONNECTED) if isinstance(o, EstimateReady)]
        return ready

    # WHEN every estimate made of the last good one fails
    made[0].fail = fail
    old = len(made)
    factory = core.fleet._make_estimator

    def remake(*arguments: Any) -> Any:
        estimator = factory(*arguments)
        if len(made) < old + 3:
            made[-1].fail = fail
        return estimator

    core.fleet._make_estimator = remake
    ready = flown(100.25, 3.0)
    # THEN the third fault is the last: it begins anew from its own fixes, not from what it was told at the start
    statuses = {r.estimate.tick: r.estimate.status for r in ready}
    assert [statuses[tick] for tick in (1003, 1004, 1005)] == [Status.FELL_BACK, Status.FELL_BACK, Status.NO_DATA]
    assert core.counters["begun anew"] == 1
    back = min(tick for tick, status in statuses.items() if tick > 1005 and status is Status.OK)
    assert back - 1003 <= 30
    assert made[-1].mean[:3] == pytest.approx([1.0, 2.0, 3.0])
    assert core.counters["estimator faults"] == 3
    # AND says so, as an alarm, for a while
    assert str(core.health.health).startswith("ALARM, aligning: estimate given up and begun anew, after 3 faults")
    flown(103.25, 8.0)
    assert "anew" not in str(core.health.health)


def test_an_estimate_that_stands_against_all_own_fixes_is_given_up_where_nothing_else_holds_it(
    make_config: MakeConfig,
) -> None:
    core, made = lone(make_config, "initial.fixes=5")
    tick_through(core, 100.0, 0.25)
    for step in range(700):
        now_s = 100.25 + 0.01 * step
        if step % 20 == 0:
            there = replace(fix(now_s), position_m=(5000.0, 2.0, 3.0))
            core.on_gps(there, now_s)
        core.advance(now_s, CONNECTED)
        if step == 100:
            assert "own measurements impossible, off by 5000" in str(core.health.health)
    assert core.counters["begun anew"] == 1
    assert core.counters["impossible rows of 1"] >= 10
    assert made[-1].mean[:3] == pytest.approx([5000.0, 2.0, 3.0])
    assert "begun anew, against its own fixes" in str(core.health.health)
