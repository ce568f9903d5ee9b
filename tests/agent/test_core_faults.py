"""The agent core when something in it fails: every tick has an estimate, and none is waited for in vain."""

from __future__ import annotations

import numpy as np
import pytest

from agent.outputs import EstimateReady, Faulted
from estimators.estimator import Status
from tests.support.notebook_estimator import MakeConfig, lone, tick_through
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
