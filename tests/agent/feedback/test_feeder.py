"""The feed of one drone put together: origin, stamps, kinds, what is told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.errors import ConfigError
from agent.feedback.feeder import FedAutopilot, Feeder, Ready
from agent.feedback.gatekeeper import FeedPhase
from agent.mavlink.codec import Message, mavlink
from agent.outputs import EstimateReady, Faulted
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AutopilotEstimate, GpsSample
from estimators.estimator import Status
from estimators.integrity.finding import What
from estimators.integrity.protection.levels import ProtectionLevel
from estimators.integrity.protection.statement import IntegrityState
from tests.support.onboard import onboard_of
from tests.support.statements import statement

FRAME = FleetFrame(47.0, 8.0, 400.0, msl=True)
ORIGIN_M = (30.0, -20.0, 2.0)
AT_M = np.array((35.0, -10.0, -6.0))


def config(kind: str = "odometry", **more: Any) -> Any:
    """One drone that is fed."""
    return config_from(
        {
            "fleet": {"name": "fed", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
            "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14561"}],
            "feedback": {"kind": kind, "agree_s": 2.0, **more},
        },
        "test",
    )


class Hover:
    """A hovering drone whose autopilot's origin is not the fleet's."""

    def __init__(self, flavour: str = "px4", kind: str = "odometry", **more: Any) -> None:
        self.feeder = Feeder(config(kind, **more), 1)
        self.link = FedAutopilot(True, flavour, 1, 1)
        self.now_s = 0.0
        self.fix_off_m = 0.0
        self.own_off_m = np.zeros(3)
        """Of the autopilot's own position."""
        self.off: dict[int, float] = {}
        """Whose fixes are off, by integrity."""
        self.questions: list[Message] = []
        self.given: list[Message] = []
        self.tell_origin(ORIGIN_M)

    def tell_origin(self, origin_m: tuple[float, float, float]) -> None:
        """GPS_GLOBAL_ORIGIN."""
        lat_deg, lon_deg, alt_m = FRAME.geodetic(origin_m)
        place = round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3)
        self.feeder.on_message(mavlink.MAVLink_gps_global_origin_message(*place), None, self.now_s)

    def go(
        self, seconds: float, state: IntegrityState = IntegrityState.NOMINAL, *, lost: bool = False, life: int = 0
    ) -> None:
        """Hover on."""
        for _ in range(round(seconds * 10)):
            self.now_s += 0.1
            t_s = self.now_s - 0.15
            local = AT_M - ORIGIN_M + self.own_off_m
            self.feeder.on_sample(AutopilotEstimate(t_s, tuple(local), (0.0, 0.0, 0.0)))
            if not lost:
                place = (AT_M[0] + self.fix_off_m, AT_M[1], AT_M[2])
                self.feeder.on_sample(GpsSample(t_s, place, 1.0, 2.0, None, None, 0.3, 3))
            self.feeder.on_life(self.link, (life,))
            self.questions += self.feeder.to_send(self.link, self.now_s)
            self.given += self.feeder.on_estimate(self.ready(t_s, state, lost), self.link, self.now_s)

    def ready(self, t_s: float, state: IntegrityState, lost: bool) -> Ready:
        """An estimate."""
        return Ready(
            t_s,
            self.now_s,
            1_800_000_000.0 + t_s,
            np.array((*AT_M, 0.0, 0.0, 0.0)),
            np.eye(6) * 0.04,
            Status.OK,
            replace(statement(state, ProtectionLevel(0.5, 0.8), 0.3), off=self.off),
            (1.0, 0.0, 0.0, 0.0),
            round(t_s * 1e6) if t_s > 0 else None,
            lost,
        )

    def kinds(self) -> set[str]:
        """Of what the autopilot was given."""
        return {message.get_type() for message in self.given if message.get_type() != "STATUSTEXT"}


@pytest.mark.parametrize(("flavour", "frame"), [("px4", 1), ("ardupilot", 20)])
def test_positions_count_from_the_autopilots_origin_and_stamps_are_of_the_estimate(flavour: str, frame: int) -> None:
    hover = Hover(flavour)
    hover.go(5.0)
    hover.go(1.0, lost=True)

    [*_, last] = [each for each in hover.given if each.get_type() == "ODOMETRY"]
    assert (last.x, last.y, last.z) == pytest.approx(tuple(AT_M - ORIGIN_M), abs=0.02)
    assert last.frame_id == frame
    assert last.time_usec == round((hover.now_s - 0.15) * 1e6)


def test_px4_is_given_nothing_while_its_gps_is_good_and_ardupilot_only_what_was_checked() -> None:
    for flavour, kinds in (("px4", set()), ("ardupilot", {"ODOMETRY"})):
        hover = Hover(flavour)
        hover.go(1.0)
        assert hover.kinds() == set()
        hover.go(5.0)
        assert hover.kinds() == kinds


def test_the_origin_is_asked_for_until_it_is_known_and_followed() -> None:
    hover = Hover()
    hover.feeder.watch.reset()
    hover.go(5.0)

    asked = [each for each in hover.questions if each.get_type() == "COMMAND_LONG"]
    assert len(asked) >= 4
    assert {(each.command, each.param1) for each in asked} == {(mavlink.MAV_CMD_REQUEST_MESSAGE, 49.0)}
    assert hover.feeder.verdict.reason == "its origin is not known"
    hover.tell_origin(ORIGIN_M)
    hover.go(4.0)
    assert hover.feeder.verdict.phase is FeedPhase.READY
    hover.tell_origin((42.0, -20.0, 2.0))
    hover.go(4.0)
    assert hover.feeder.verdict.phase is FeedPhase.CHECKING  # its local positions do not fit that origin


def test_another_life_of_the_autopilot_is_checked_anew() -> None:
    hover = Hover()
    hover.go(4.0)
    hover.go(0.1, life=1)

    assert (hover.feeder.watch.origin_m, hover.feeder.verdict.phase) == (None, FeedPhase.CHECKING)


@pytest.mark.parametrize(
    ("flavour", "kind", "message"),
    [("px4", "global", "GLOBAL_POSITION_SENSOR"), ("ardupilot", "gps_input", "GPS_INPUT")],
)
def test_other_kinds(flavour: str, kind: str, message: str) -> None:
    hover = Hover(flavour, kind)
    hover.go(5.0)
    hover.go(1.0, lost=True)

    assert hover.kinds() == {message}


@pytest.mark.parametrize(("flavour", "kind"), [("px4", "gps_input"), ("ardupilot", "global"), ("other", "odometry")])
def test_what_an_autopilot_does_not_read_it_is_not_given(flavour: str, kind: str) -> None:
    hover = Hover(flavour, kind)
    hover.go(5.0)
    hover.go(5.0, lost=True)

    assert hover.kinds() == set()
    assert f'feedback.kind = "{kind}" is for' in hover.feeder.verdict.reason


def test_absurd_words_of_an_autopilot_are_survived_and_not_fed_by() -> None:
    hover = Hover()
    hover.go(4.0)
    absurd = (
        mavlink.MAVLink_param_value_message(b"EKF2_EV_CTRL", float("nan"), mavlink.MAV_PARAM_TYPE_REAL32, 1, 0),
        mavlink.MAVLink_global_position_int_message(0, 2**31 - 1, -(2**31), 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_estimator_status_message(0, 0xFFFF, *[float("nan")] * 8),
        mavlink.MAVLink_statustext_message(0, b"\xff\xfe"),
        mavlink.MAVLink_gps_global_origin_message(2**31 - 1, 2**31 - 1, 0),
    )
    for message in absurd:
        hover.feeder.on_message(message, hover.now_s, hover.now_s)
    hover.go(2.0, lost=True)

    assert hover.kinds() == set()
    assert "no place on earth" in hover.feeder.verdict.reason


def test_a_wrong_parameter_is_said_while_gps_is_still_good() -> None:
    hover = Hover()
    asked = mavlink.MAVLink_param_value_message(b"EKF2_EV_CTRL", 0.0, mavlink.MAV_PARAM_TYPE_INT32, 1, 0)
    hover.go(1.0)
    hover.feeder.on_message(asked, None, hover.now_s)
    hover.go(1.0)

    [finding] = [each for each in hover.feeder.findings() if each.what is What.NOT_FUSED]
    assert finding.detail.startswith("parameter EKF2_EV_CTRL is 0")


def test_the_source_set_is_switched_where_that_is_asked_for_until_it_is_acknowledged() -> None:
    def asked(hover: Hover) -> list[float]:
        commands = [each for each in hover.questions if each.get_type() == "COMMAND_LONG"]
        return [each.param1 for each in commands if each.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET]

    silent = Hover("ardupilot")
    switching = Hover("ardupilot", switch_source=True)
    for hover in (silent, switching):
        hover.go(5.0)
        hover.go(10.0, lost=True)

    assert asked(silent) == []
    assert asked(switching) == [2.0] * 5
    ack = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, mavlink.MAV_RESULT_ACCEPTED)
    switching.feeder.on_message(ack, None, switching.now_s)
    switching.go(5.0)
    assert asked(switching)[5] == 1.0
    assert switching.feeder.counters["feedback: source set switched"] == 1


def test_an_alarm_stops_the_feed_and_is_told() -> None:
    hover = Hover()
    hover.go(5.0)
    hover.go(1.0, lost=True)
    sent = len(hover.given)
    hover.go(1.0, IntegrityState.ALERT, lost=True)

    assert [each.get_type() for each in hover.given[sent:]] in ([], ["STATUSTEXT"])
    [finding] = hover.feeder.findings()
    assert (finding.what, finding.detail) == (What.NOT_FED, "ALERT")


def test_a_gps_that_returns_elsewhere_is_told() -> None:
    hover = Hover()
    hover.go(5.0)
    hover.go(2.0, lost=True)
    hover.fix_off_m = 300.0
    hover.go(10.0)

    [finding] = hover.feeder.findings()
    assert (finding.what, finding.value) == (What.GPS_BACK_WRONG, pytest.approx(300.0, abs=0.1))
    assert hover.feeder.verdict.phase is FeedPhase.FEEDING


def test_a_px4_is_fed_where_it_is_while_it_counts_on_fixes_that_ended_and_not_once_they_are_back_wrong() -> None:
    hover = Hover()
    hover.go(5.0)
    hover.own_off_m = np.array((1.0, 0.0, 0.0))
    hover.go(4.0, lost=True)
    assert hover.feeder.verdict.shift_m == pytest.approx((1.0, 0.0, 0.0), abs=0.02)

    hover.fix_off_m = 50.0
    hover.go(4.0)
    assert hover.feeder.verdict.phase is FeedPhase.FEEDING
    assert hover.feeder.verdict.shift_m.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("told", [False, True])
def test_a_spoofed_receiver_is_told_to_the_ground_always_and_to_ardupilot_where_asked_for(told: bool) -> None:
    def commands(hover: Hover) -> list[tuple[float, float]]:
        asked = [each for each in hover.questions if each.get_type() == "COMMAND_LONG"]
        return [(each.param1, each.param2) for each in asked if each.command == mavlink.MAV_CMD_USER_1]

    def texts(hover: Hover) -> list[str]:
        return [str(each.text) for each in hover.questions if each.get_type() == "STATUSTEXT"]

    hover = Hover("ardupilot", tell_spoofing=told)
    hover.go(5.0)
    hover.off = {1: 12.0}
    hover.go(3.0, IntegrityState.DEGRADED)

    assert texts(hover) == ["fleetloc: GPS 12 m off, spoofed or faulty"]
    assert commands(hover)[:1] == ([(1.0, 0.0)] if told else [])
    assert hover.feeder.verdict.phase is FeedPhase.READY
    if told:
        ack = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_USER_1, mavlink.MAV_RESULT_ACCEPTED)
        hover.feeder.on_message(ack, None, hover.now_s)
        hover.go(1.0, IntegrityState.DEGRADED)
        assert hover.feeder.verdict.phase is FeedPhase.FEEDING
        hover.off = {}
        hover.go(11.0)
        assert commands(hover)[-1] == (0.0, 0.0)
        hover.feeder.on_message(ack, None, hover.now_s)
        hover.go(3.0)
        assert hover.feeder.verdict.phase is FeedPhase.READY
        assert texts(hover)[1:] == ["fleetloc: GPS agrees again"]


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"feedback": {"kind": "odometry", "agents": [7]}}, "feedback.agents"),
        ({"fleet": {"period_s": 0.5}}, "fleet.period_s"),
        ({"feedback": {"kind": "gps_input"}, "autopilot": "px4"}, "agent 1, autopilot"),
        ({"mavlink": "serial:/dev/ttyAMA0:19200", "imu": 1.0}, "agent 1, mavlink: expected a baud rate of"),
    ],
)
def test_configurations_that_cannot_be_fed_are_refused(changes: dict[str, Any], key: str) -> None:
    fleet = {"name": "fed", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}} | changes.get("fleet", {})
    agent = {"id": 1, "mavlink": changes.get("mavlink", "udpin:127.0.0.1:1"), "autopilot": "auto"}
    document: dict[str, Any] = {
        "fleet": fleet,
        "agents": [agent | ({"autopilot": changes["autopilot"]} if "autopilot" in changes else {})],
        "feedback": {"kind": "odometry"} | changes.get("feedback", {}),
    }
    if "imu" in changes:
        document["mavlink"] = {"imu_hz": 1.0, "attitude_hz": 1.0, "gps_hz": 1.0}

    with pytest.raises(ConfigError, match=key):
        config_from(document, "test")


def test_nobody_is_fed_unless_it_is_asked_for() -> None:
    plain = config("off")

    assert not plain.feeds(1)
    assert config("odometry").feeds(1)
    assert config("gps_input").fed_receiver(1) == 1


def test_a_fault_of_the_feed_costs_no_estimate() -> None:
    onboard = onboard_of(config(), linked=True)
    assert onboard.feeder is not None
    onboard.feeder.on_estimate = raising  # type: ignore[method-assign]

    outputs: list[Any] = []
    for step in range(200):
        outputs += onboard.advance(step * 0.05)

    ready = [each for each in outputs if isinstance(each, EstimateReady)]
    faults = [each for each in outputs if isinstance(each, Faulted)]
    assert len(ready) > 50
    assert len(faults) == len(ready)


def raising(*_arguments: object) -> list[Message]:
    """A feed that fails."""
    raise ValueError("made up")
