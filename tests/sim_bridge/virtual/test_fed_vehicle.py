"""What becomes of a drone without GPS that is fed, and of one where something is wrong: on fake autopilots that fuse.

The estimates are the truth, late and noisy; `test_fed_flights` has the estimator in the loop.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.feedback.feeder import Feeder
from agent.feedback.gatekeeper import FeedPhase
from agent.mavlink.codec import Message, mavlink
from estimators.integrity.protection.statement import IntegrityState
from sim_bridge.autopilot.flavours import FlightMode
from sim_bridge.faults.fault_tables import GpsDrift, GpsWrong
from tests.support.fed_vehicle import FedVehicle, with_fields

LOST_S, BACK_S = 12.0, 30.0
FLAVOURS = pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
LANDS_AFTER_S = {"px4": 4.5, "ardupilot": 8.0}


def landed_s(flight: FedVehicle) -> float:
    """When the failsafe took over."""
    return min((n.at_s for n in flight.noted if n.mode is FlightMode.LAND), default=np.inf)


@FLAVOURS
def test_it_flies_on_without_gps_and_hands_back(flavour: Any) -> None:
    flight = FedVehicle(flavour, outage_s=(LOST_S, BACK_S)).fly(40.0)

    assert flight.phases(LOST_S + 1.0, BACK_S) == {FeedPhase.FEEDING}
    assert flight.noted[-1].phase is FeedPhase.READY
    assert {n.mode for n in flight.noted} == {FlightMode.MISSION}
    errors_m = flight.errors_m(LOST_S + 2.0, BACK_S)
    assert np.sqrt(np.mean(errors_m**2)) < 0.6
    assert errors_m.max() < 1.5
    assert flight.autopilot.state.feed.rejected == {}
    assert flight.first_said("NOT_FUSED") == np.inf


@FLAVOURS
def test_the_hand_over_is_no_step(flavour: Any) -> None:
    flight = FedVehicle(flavour, outage_s=(LOST_S, BACK_S)).fly(40.0)

    # PX4 counts on its receiver for seven seconds after its last fix, and sets itself then
    assert flight.step_m(LOST_S, LOST_S + 12.0) < 0.3
    assert flight.step_m(BACK_S, BACK_S + 9.0) < 0.3


@pytest.mark.parametrize("seed", [11, 20])
def test_a_receiver_may_be_metres_off_when_its_fixes_end(seed: int) -> None:
    # GIVEN an autopilot whose receiver has wandered off by 1.7 or 2.1 m
    flight = FedVehicle("px4", outage_s=(LOST_S, 50.0), seed=seed).fly(36.0)
    before_m = flight.errors_m(LOST_S - 0.2, LOST_S).max()
    assert before_m > 1.5
    # THEN it is fed all the same, from where it believes to be, and does not drift while the difference is taken off
    assert flight.phases(LOST_S + 1.0, 36.0) == {FeedPhase.FEEDING}
    assert flight.step_m(LOST_S, 36.0) < 0.3
    assert flight.errors_m(LOST_S + 2.0, 36.0).max() < before_m + 0.7
    assert flight.errors_m(LOST_S + 17.0, 36.0).max() < 0.5
    assert flight.first_said("NOT_FUSED") == np.inf


def test_what_is_fed_moves_as_it_says() -> None:
    # WHEN a difference of 1.7 m is taken off, the positions that are fed follow from the velocities
    feedback = {"kind": "gps_input"}
    flight = FedVehicle("ardupilot", outage_s=(LOST_S, 40.0), seed=20, feedback=feedback).fly(16.0)
    fed = [(at_s, each) for at_s, each in flight.sent if each.get_type() == "GPS_INPUT" and at_s > LOST_S + 0.9]
    north_m = np.array([np.radians(each.lat * 1e-7) * 6_378_137.0 for _, each in fed])
    at_s, north_mps = np.array([t for t, _ in fed]), np.array([each.vn for _, each in fed])
    followed_m = np.sum(0.5 * (north_mps[1:] + north_mps[:-1]) * np.diff(at_s))
    assert len(fed) > 20
    assert north_m[-1] - north_m[0] == pytest.approx(followed_m, abs=0.3)


@pytest.mark.parametrize(
    ("flavour", "kind", "message", "parameters"),
    [
        ("px4", "global", "GLOBAL_POSITION_SENSOR", {"EKF2_AGP0_NOISE": 0.3}),
        ("ardupilot", "gps_input", "GPS_INPUT", {}),
    ],
)
def test_it_flies_on_as_a_position_sensor_or_as_a_receiver_too(
    flavour: Any, kind: str, message: str, parameters: dict[str, float]
) -> None:
    outage_s = (LOST_S, 60.0)
    flight = FedVehicle(flavour, outage_s=outage_s, feedback={"kind": kind}, parameters=parameters).fly(70.0)

    assert flight.phases(LOST_S + 1.0, 60.0) == {FeedPhase.FEEDING}
    assert {n.mode for n in flight.noted} == {FlightMode.MISSION}
    assert message in {each.get_type() for _, each in flight.sent}
    errors_m = flight.errors_m(LOST_S + 2.0, 60.0)
    assert np.sqrt(np.mean(errors_m**2)) < 0.6
    assert errors_m.max() < 1.5
    assert flight.step_m(LOST_S, LOST_S + 4.0) < 0.3
    assert flight.autopilot.state.global_feed.rejected == {}
    assert flight.first_said("NOT_FUSED") == np.inf
    assert flight.noted[-1].phase is FeedPhase.READY


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"feedback": {"kind": "global"}, "parameters": {"EKF2_AGP0_ID": 3.0}}, "parameter EKF2_AGP0_ID is 3"),
        ({"feedback": {"kind": "global"}, "parameters": {"EKF2_AGP0_CTRL": 0.0}}, "parameter EKF2_AGP0_CTRL is 0"),
        (
            {"flavour": "ardupilot", "feedback": {"kind": "gps_input"}, "parameters": {"GPS2_TYPE": 1.0}},
            "parameter GPS2_TYPE is 1",
        ),
        (
            {"flavour": "ardupilot", "feedback": {"kind": "gps_input"}, "parameters": {"GPS_AUTO_SWITCH": 0.0}},
            "parameter GPS_AUTO_SWITCH is 0",
        ),
    ],
)
def test_what_these_kinds_need_is_said_before_the_loss(settings: dict[str, Any], said: str) -> None:
    flight = FedVehicle(**settings).fly(8.0)

    assert flight.first_said(f"NOT_FUSED {said}") < 8.0


@FLAVOURS
def test_an_alarm_withholds_and_the_autopilot_lands_as_without_us(flavour: Any) -> None:
    def judged(at_s: float) -> IntegrityState:
        return IntegrityState.ALERT if at_s > 18.0 else IntegrityState.NOMINAL

    flight = FedVehicle(flavour, outage_s=(LOST_S, 60.0), judged=judged).fly(32.0)

    assert flight.phases(18.2, 32.0) == {FeedPhase.WITHHELD}
    assert flight.first_said("NOT_FED ALERT") < 18.3
    assert landed_s(flight) == pytest.approx(18.0 + LANDS_AFTER_S[flavour], abs=0.4)


def test_an_estimate_that_is_wrong_while_integrity_doubts_it_is_never_fed() -> None:
    def off_m(at_s: float) -> tuple[float, float, float]:
        return (5.0 * (at_s - 16.0), 0.0, 0.0) if at_s > 16.0 else (0.0, 0.0, 0.0)

    def judged(at_s: float) -> IntegrityState:
        return IntegrityState.NOT_OBSERVABLE if at_s > 15.9 else IntegrityState.DEGRADED

    flight = FedVehicle(outage_s=(LOST_S, 60.0), off_m=off_m, judged=judged).fly(22.0)

    assert max(at_s for at_s, message in flight.sent if message.get_type() == "ODOMETRY") < 16.0


def test_a_doubt_that_passes_costs_the_time_of_agreement_and_comes_back_with_a_reset() -> None:
    def judged(at_s: float) -> IntegrityState:
        return IntegrityState.ALERT if 18.0 < at_s < 18.3 else IntegrityState.NOMINAL

    flight = FedVehicle(outage_s=(LOST_S, BACK_S), feedback={"agree_s": 2.0}, judged=judged).fly(28.0)

    assert flight.phases(18.2, 20.1) == {FeedPhase.WITHHELD}
    assert flight.phases(20.6, 28.0) == {FeedPhase.FEEDING}
    before, after = (
        {message.reset_counter for at_s, message in flight.sent if a < at_s < b and message.get_type() == "ODOMETRY"}
        for a, b in ((13.0, 18.0), (20.5, 28.0))
    )
    assert len(before) == len(after) == 1
    assert before != after
    assert flight.errors_m(22.0, 28.0).max() < 1.5


@FLAVOURS
def test_a_daemon_that_dies_leaves_the_autopilot_to_its_failsafe(flavour: Any) -> None:
    flight = FedVehicle(flavour, outage_s=(LOST_S, 60.0), alive=lambda at_s: at_s < 18.0)
    flight.fly(18.0 + LANDS_AFTER_S[flavour] - 0.4)
    assert flight.autopilot.state.mode is FlightMode.MISSION
    flight.fly(18.0 + LANDS_AFTER_S[flavour] + 0.4)

    assert flight.autopilot.state.mode is FlightMode.LAND


def test_a_daemon_that_is_started_in_the_outage_feeds_nothing() -> None:
    flight = FedVehicle(outage_s=(LOST_S, 60.0)).fly(16.0)
    flight.feeder = Feeder(flight.config, 1)
    flight.fly(26.0)

    assert flight.phases(16.1, 26.0) <= {FeedPhase.WITHHELD, FeedPhase.CHECKING}
    assert flight.first_said("NOT_FED not checked", 16.0) < 17.0


def test_a_gps_that_returns_300_m_off_is_said_and_does_not_win_while_the_feed_is_good() -> None:
    wrong = GpsWrong(agents=(1,), from_s=LOST_S, offset_m=(300.0, 0.0, 0.0))
    flight = FedVehicle(outage_s=(LOST_S, 20.0), faults=(wrong,)).fly(32.0)

    assert flight.first_said("GPS_BACK_WRONG") < 20.0 + 2.0
    assert flight.phases(21.0, 32.0) == {FeedPhase.FEEDING}
    assert flight.errors_m(20.0, 32.0).max() < 3.0


@pytest.mark.parametrize("told", [True, False])
def test_an_ardupilot_that_is_told_of_its_spoofed_receiver_flies_on_the_estimate(told: bool) -> None:
    spoofed_s, named_s, end_s = 12.0, 17.0, 40.0
    drift = GpsDrift(agents=(1,), from_s=spoofed_s, rate_mps=(0.6, 0.0, 0.0))
    flight = FedVehicle(
        "ardupilot",
        outage_s=(900.0, 901.0),
        faults=(drift,),
        feedback={"tell_spoofing": told},
        judged=lambda at_s: IntegrityState.DEGRADED if at_s > named_s else IntegrityState.NOMINAL,
        fixes_off_m=lambda at_s: 0.6 * (at_s - spoofed_s) if at_s > named_s else None,
    )
    flight.autopilot.state.hears_of_spoofing = True
    flight.fly(end_s)

    error_m = flight.errors_m(end_s - 10.0, end_s)
    if told:
        assert flight.phases(named_s + 3.0, end_s) == {FeedPhase.FEEDING}
        assert error_m.max() < 1.5
    else:
        assert FeedPhase.FEEDING not in flight.phases(0.0, end_s)
        assert error_m.min() > 5.0  # it follows its receiver, as without us
    assert {n.mode for n in flight.noted} == {FlightMode.MISSION}


def test_an_origin_that_is_not_the_autopilots_is_never_fed() -> None:
    def heard(message: Message) -> Message:
        shifted = message.get_type() == "GPS_GLOBAL_ORIGIN"
        return with_fields(message, latitude=message.latitude + 500) if shifted else message  # 5.6 m

    flight = FedVehicle(outage_s=(LOST_S, 60.0), heard=heard).fly(16.0)

    assert not [message for _, message in flight.sent if message.get_type() == "ODOMETRY"]
    assert flight.first_said("NOT_FED") < LOST_S + 2.0


def test_another_system_id_gets_nothing() -> None:
    flight = FedVehicle(system_id=9, outage_s=(LOST_S, 60.0)).fly(16.0)

    assert flight.sent == []
    assert flight.session.ignored["heartbeat: other system"] > 10


@pytest.mark.parametrize(
    ("settings", "said", "from_s"),
    [
        ({"parameters": {"EKF2_EV_CTRL": 0.0}}, "parameter EKF2_EV_CTRL is 0", 0.0),
        ({"flavour": "ardupilot", "parameters": {"VISO_TYPE": 0.0}}, "parameter VISO_TYPE is 0", 0.0),
        ({"flavour": "ardupilot", "parameters": {"EK3_SRC2_POSXY": 3.0}}, "parameter EK3_SRC2_POSXY is 3", 0.0),
        ({"spoil": lambda m, _s: with_fields(m, frame_id=14)}, "frame: messages come in time", LOST_S),
        ({"spoil": lambda m, _s: with_fields(m, estimator_type=5)}, "frame: it says", LOST_S),
        ({"period_s": 0.3}, "rate 3", LOST_S),
        (
            {"spoil": lambda m, s: with_fields(m, x=m.x + 40.0) if s > 15.0 and m.get_type() == "ODOMETRY" else m},
            "variance: innovations are",
            15.0,
        ),
    ],
)
def test_why_it_is_not_used_is_said_by_name(settings: dict[str, Any], said: str, from_s: float) -> None:
    flight = FedVehicle(**settings).fly(17.5)

    found_s = flight.first_said(f"NOT_FUSED {said}")
    assert found_s < (10.0 if from_s == 0.0 else from_s + 3.2)  # before the loss, or 2 s after the feed's begin
    if from_s:
        assert flight.first_said("NOT_FUSED") >= from_s


def test_estimates_that_are_too_old_for_px4_are_said_to_be() -> None:
    # until its clock filter has converged, for which it has a minute, it is told where the drone is now
    flight = FedVehicle(outage_s=(64.0, 90.0), parameters={"EKF2_DELAY_MAX": 100.0}).fly(67.5)

    assert flight.first_said("NOT_FUSED delay: estimates are 0.15 s old, EKF2_DELAY_MAX is 100") < 64.0 + 3.2


def test_a_link_that_ends_stops_the_feed_and_its_return_is_checked_anew() -> None:
    flight = FedVehicle(outage_s=(80.0, 90.0)).fly(10.0)
    assert flight.noted[-1].phase is FeedPhase.READY
    flight.autopilot.reboot(flight.simulation.now, 1.0)
    flight.fly(16.0)

    assert FeedPhase.CHECKING in flight.phases(11.0, 16.0)
    assert flight.session.reboots == 1
    assert mavlink.MAVLINK_MSG_ID_ODOMETRY not in {message.get_msgId() for _, message in flight.sent}
