"""The gatekeeper: what is fed, what is not, and what is announced."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.feedback.feedback_table import FeedbackTable
from agent.feedback.gatekeeper import FeedPhase, FeedVerdict, Gatekeeper, Offer
from agent.feedback.handover import RATE_MPS
from estimators.integrity.protection.levels import ProtectionLevel
from estimators.model.measurements import Vector

PERIOD_S, AGE_S = 0.1, 0.15
TABLE = FeedbackTable(kind="odometry", agree_s=2.0, max_step_m=1.0, max_horizontal_m=3.0)
VELOCITY = np.array((2.0, 0.0, 0.0))


def offer(t_s: float, **changes: object) -> Offer:
    """A good estimate of a drone that flies north; the autopilot agrees and its GPS is good."""
    position = t_s * VELOCITY
    good = Offer(
        t_s=t_s,
        now_s=t_s + AGE_S,
        position_m=position,
        velocity_mps=VELOCITY,
        level=ProtectionLevel(1.0, 2.0),
        bad="",
        autopilot="",
        origin_m=np.zeros(3),
        own_m=position + np.array((0.2, 0.1, 0.3)),
        gps_lost=False,
        fix_off_m=0.4,
    )
    return replace(good, **changes)  # type: ignore[arg-type]


@dataclass
class Run:
    """Offers in their order, one per tick."""

    gate: Gatekeeper = field(default_factory=lambda: Gatekeeper(TABLE))
    t_s: float = 0.0

    def go(
        self, seconds: float, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0), **changes: object
    ) -> FeedVerdict:
        """Fly on; the last verdict."""
        verdict = None
        for _ in range(round(seconds / PERIOD_S)):
            self.t_s += PERIOD_S
            each = offer(self.t_s, **changes)
            verdict = self.gate.judge(replace(each, position_m=each.position_m + np.array(shift_m)))
        assert verdict is not None
        return verdict


@pytest.fixture
def ready() -> Run:
    """Checked, with GPS."""
    run = Run()
    assert run.go(4.0).phase is FeedPhase.READY
    return run


@pytest.fixture
def feeding(ready: Run) -> Run:
    """Without GPS, and fed."""
    assert ready.go(1.0, gps_lost=True).phase is FeedPhase.FEEDING
    return ready


def test_it_is_checked_before_it_is_ready_and_not_fed_while_gps_is_good() -> None:
    run = Run()

    assert run.go(1.0).phase is FeedPhase.CHECKING
    verdict = run.go(3.0)

    assert (verdict.phase, verdict.feed) == (FeedPhase.READY, False)


def test_the_loss_of_gps_begins_the_feed_at_once_with_a_reset(ready: Run) -> None:
    before = ready.gate.resets

    verdict = ready.go(0.1, gps_lost=True)

    assert (verdict.phase, verdict.feed, verdict.reset_counter) == (FeedPhase.FEEDING, True, before + 1)
    assert ready.go(5.0, gps_lost=True).reset_counter == before + 1


def test_the_first_position_that_is_fed_is_the_autopilots_own(ready: Run) -> None:
    verdict = ready.go(0.1, gps_lost=True)
    now = offer(ready.t_s)
    assert now.position_m + verdict.shift_m == pytest.approx(now.own_m)

    assert ready.go(1.0, gps_lost=True).shift_m[2] == pytest.approx(0.0, abs=1e-9)  # 0.3 m at 0.4 m/s
    assert ready.go(5.0, gps_lost=True).shift_m.tolist() == [0.0, 0.0, 0.0]


def test_an_autopilot_that_counts_on_its_receiver_is_fed_its_own_position_until_it_does_not(ready: Run) -> None:
    before = ready.go(0.1, gps_lost=True, counts_on_gps=True).reset_counter
    for tick in range(1, 51):  # it drifts meanwhile
        own_m = offer(ready.t_s + PERIOD_S).own_m + np.array((0.02 * tick, 0.0, 0.0))
        verdict = ready.go(PERIOD_S, gps_lost=True, counts_on_gps=True, own_m=own_m)
        assert offer(ready.t_s).position_m + verdict.shift_m == pytest.approx(own_m)
        assert verdict.shift_rate_mps @ verdict.shift_m < 0.0  # led back
        assert np.hypot(*verdict.shift_rate_mps[:2]) <= RATE_MPS + 1e-9
        assert verdict.reset_counter == before

    verdict = ready.go(1.0, gps_lost=True)
    assert 0.0 < np.hypot(*verdict.shift_m[:2]) < 1.0
    assert np.hypot(*verdict.shift_rate_mps[:2]) == pytest.approx(RATE_MPS)
    assert ready.go(4.0, gps_lost=True).shift_m.tolist() == [0.0, 0.0, 0.0]


def test_one_that_strays_meanwhile_is_fed_the_estimate(ready: Run) -> None:
    before = ready.go(1.0, gps_lost=True, counts_on_gps=True).reset_counter
    astray_m = offer(ready.t_s + PERIOD_S).own_m + np.array((5.0, 0.0, 0.0))

    verdict = ready.go(PERIOD_S, gps_lost=True, counts_on_gps=True, own_m=astray_m)

    assert verdict.shift_m.tolist() == [0.0, 0.0, 0.0]
    assert verdict.reset_counter == before  # the difference had been small: nothing that is fed has moved far


def test_an_autopilot_that_is_lost_already_is_set_to_the_estimate(ready: Run) -> None:
    ready.go(5.0, gps_lost=True, bad="ALERT")
    lost = offer(ready.t_s).own_m + np.array((40.0, 0.0, 0.0))

    verdict = ready.go(TABLE.agree_s + 0.2, gps_lost=True, own_m=lost)

    assert verdict.feed
    assert verdict.shift_m.tolist() == [0.0, 0.0, 0.0]


def test_what_is_sent_in_standby_is_where_the_autopilot_believes_to_be() -> None:
    run = Run(Gatekeeper(TABLE, standby=True))

    verdict = run.go(4.0)

    assert verdict.feed
    assert verdict.shift_m == pytest.approx((0.2, 0.1, 0.3))


def test_an_autopilot_with_a_switch_of_its_own_is_sent_what_is_ready() -> None:
    run = Run(Gatekeeper(TABLE, standby=True))

    assert not run.go(1.0).feed
    verdict = run.go(3.0)
    assert (verdict.phase, verdict.feed) == (FeedPhase.READY, True)
    assert run.go(1.0, gps_lost=True).reset_counter == verdict.reset_counter  # the stream goes on


@pytest.mark.parametrize(
    ("why", "changes"),
    [
        ("alarm", {"bad": "ALERT: fixes contradict the rest"}),
        ("not observable", {"bad": "NOT_OBSERVABLE: all located neighbours in one plane"}),
        ("horizontal protection level", {"level": ProtectionLevel(3.1, 2.0)}),
        ("vertical protection level", {"level": ProtectionLevel(1.0, 6.1)}),
        ("no promise", {"level": ProtectionLevel(np.nan, 2.0)}),
        ("link", {"autopilot": "no autopilot with the configured system id"}),
        ("origin", {"origin_m": None}),
        ("far origin", {"origin_m": np.array((20_000.0, 0.0, 0.0))}),
        ("not finite", {"velocity_mps": np.full(3, np.nan)}),
    ],
)
def test_it_stops_at_once_and_resumes_after_the_time_of_agreement_with_a_reset(
    feeding: Run, why: str, changes: dict[str, object]
) -> None:
    before = feeding.gate.resets

    stopped = feeding.go(0.1, gps_lost=True, **changes)
    soon = feeding.go(TABLE.agree_s - 0.2, gps_lost=True)
    later = feeding.go(0.5, gps_lost=True)

    assert (stopped.phase, stopped.feed) == (FeedPhase.WITHHELD, False), why
    assert stopped.reason
    assert not soon.feed
    assert (later.feed, later.reset_counter) == (True, before + 1)


def test_an_estimate_that_is_stale_is_not_fed(feeding: Run) -> None:
    late = feeding.gate.judge(offer(feeding.t_s + 0.1, now_s=feeding.t_s + 0.8, gps_lost=True))
    assert (late.feed, "old" in late.reason) == (False, True)

    feeding.t_s += 3.0
    gap = feeding.go(0.1, gps_lost=True)
    assert (gap.feed, "no estimate for" in gap.reason) == (False, True)


def test_what_was_never_checked_is_never_fed() -> None:
    run = Run()

    verdict = run.go(60.0, gps_lost=True)

    assert (verdict.phase, verdict.feed) == (FeedPhase.WITHHELD, False)
    assert "not checked" in verdict.reason


def test_a_restart_in_the_outage_withholds_for_the_rest_of_it(feeding: Run) -> None:
    feeding.gate.forget("begun anew")

    assert not feeding.go(30.0, gps_lost=True).feed
    assert feeding.go(4.0).phase is FeedPhase.READY  # GPS is back


@pytest.mark.parametrize("off_m", [(5.0, 0.0, 0.0), (0.0, -3.5, 0.0), (0.0, 0.0, 8.0), (0.0, 0.0, -300.0)])
def test_an_origin_that_is_wrong_is_found_before(off_m: tuple[float, float, float]) -> None:
    run = Run()

    assert run.go(10.0, shift_m=off_m).phase is FeedPhase.CHECKING
    verdict = run.go(10.0, shift_m=off_m, gps_lost=True)

    assert (verdict.phase, verdict.feed) == (FeedPhase.WITHHELD, False)


def test_a_frame_that_is_turned_is_found_before() -> None:
    run = Run()
    for _ in range(200):
        run.t_s += PERIOD_S
        good = offer(run.t_s)
        turned = np.array((-good.position_m[1], good.position_m[0], good.position_m[2]))
        verdict = run.gate.judge(replace(good, own_m=turned))

    assert verdict.phase is FeedPhase.CHECKING
    assert "origin or frame" in verdict.reason


def test_what_agreed_and_does_not_any_more_is_not_fed(ready: Run) -> None:
    ready.go(3.0, shift_m=(4.0, 0.0, 0.0))

    assert not ready.go(10.0, gps_lost=True, shift_m=(4.0, 0.0, 0.0)).feed


def test_a_gps_that_is_back_is_compared_before_it_is_handed_back(feeding: Run) -> None:
    assert feeding.go(TABLE.agree_s - 0.2).feed
    verdict = feeding.go(1.0)

    assert (verdict.phase, verdict.feed) == (FeedPhase.READY, False)


def test_a_gps_that_is_back_300_m_off_is_told_and_the_feed_goes_on(feeding: Run) -> None:
    verdict = feeding.go(30.0, fix_off_m=300.0)

    assert (verdict.phase, verdict.feed, verdict.gps_off_m) == (FeedPhase.FEEDING, True, 300.0)


def test_a_receiver_that_wanders_as_receivers_do_is_no_wrong_origin() -> None:
    run = Run()

    assert run.go(10.0, shift_m=(2.0, -1.5, 0.0)).phase is FeedPhase.READY
    assert run.go(2.0, shift_m=(2.0, -1.5, 0.0), gps_lost=True).phase is FeedPhase.FEEDING


def test_a_receiver_that_is_off_and_left_out_is_a_lost_one(ready: Run) -> None:
    pulled = np.array((5.0, 0.0, 0.0))
    for _ in range(10):  # the spoofer has pulled the autopilot away before anybody knows
        ready.t_s += PERIOD_S
        ready.gate.judge(offer(ready.t_s, own_m=offer(ready.t_s).own_m + pulled))
    assert ready.gate.phase is FeedPhase.CHECKING

    known = ready.go(1.0, own_m=pulled, gps_off=True, fix_off_m=6.0)
    assert (known.phase, known.feed) == (FeedPhase.READY, False)
    left_out = ready.go(1.0, own_m=pulled, gps_off=True, gps_unused=True, fix_off_m=6.0)
    assert (left_out.phase, left_out.feed, left_out.gps_off_m) == (FeedPhase.FEEDING, True, 6.0)
    assert ready.go(TABLE.agree_s + 0.2).phase is FeedPhase.READY


def test_one_that_was_never_checked_is_not_ready_because_its_receiver_is_off() -> None:
    run = Run()

    assert run.go(10.0, gps_off=True, gps_unused=True).phase is not FeedPhase.FEEDING


def test_steps_beyond_the_limit_are_announced(feeding: Run) -> None:
    before = feeding.gate.resets

    small = feeding.go(1.0, gps_lost=True, shift_m=(0.8, 0.0, 0.0))
    large = feeding.go(1.0, gps_lost=True, shift_m=(-0.2, 0.0, 0.0))

    assert small.reset_counter == before
    assert large.reset_counter == before  # each second for itself
    both = feeding.go(0.1, gps_lost=True, shift_m=(0.7, 0.0, 0.0))
    again = feeding.go(0.1, gps_lost=True, shift_m=(1.6, 0.0, 0.0))
    assert (both.reset_counter, again.reset_counter) == (before, before + 1)


def test_an_estimate_that_moves_further_than_it_said_is_withheld(feeding: Run) -> None:
    verdict = feeding.go(0.1, gps_lost=True, shift_m=(0.0, 5.0, 0.0))

    assert (verdict.feed, "further than it said" in verdict.reason) == (False, True)
    assert feeding.go(3.0, gps_lost=True, shift_m=(0.0, 5.0, 0.0)).feed


@settings(max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.floats(-2.0, 2.0),
            st.booleans(),
            st.sampled_from(["", "", "", "ALERT"]),
            st.sampled_from([1.0, 2.5, 4.0]),
        ),
        min_size=1,
        max_size=80,
    )
)
def test_whatever_comes_no_step_is_silent_and_nothing_bad_is_fed(
    events: list[tuple[float, bool, str, float]],
) -> None:
    run = Run()
    run.go(4.0)
    fed: list[tuple[float, int, Vector]] = []
    shift = np.zeros(3)
    for north_m, lost, bad, level_m in events:
        run.t_s += PERIOD_S
        shift = shift + np.array((north_m if abs(north_m) > 1.5 else 0.0, 0.0, 0.0))
        good = offer(run.t_s, gps_lost=lost, bad=bad, level=ProtectionLevel(level_m, 1.0))
        verdict = run.gate.judge(replace(good, position_m=good.position_m + shift))
        if verdict.feed:
            assert lost or run.gate.phase is FeedPhase.FEEDING
            assert (bad, level_m <= TABLE.max_horizontal_m) == ("", True)
            fed.append((run.t_s, verdict.reset_counter, shift + verdict.shift_m))
    for (t0, counter0, shift0), (t1, counter1, shift1) in pairwise(fed):
        if t1 - t0 < 1.0 and counter0 == counter1:
            assert np.linalg.norm(shift1 - shift0) <= TABLE.max_step_m + 1e-9
