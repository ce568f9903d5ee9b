"""Why an autopilot does not use what it is given, by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from agent.feedback.autopilot_watch import AutopilotWatch
from agent.feedback.fusion import FusionWatch
from agent.feedback.gatekeeper import FeedPhase
from agent.feedback.requirements import ParameterReader, parameter_value, requirements
from agent.mavlink.codec import mavlink
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AutopilotEstimate

FRAME = FleetFrame(47.0, 8.0, 400.0, msl=True)
AIDED, UNAIDED = 0x17F, 0x7F
RIGHT = {
    "px4": {"EKF2_EV_CTRL": 5.0, "EKF2_DELAY_MAX": 300.0},
    "ardupilot": {"VISO_TYPE": 1.0, "EK3_SRC2_POSXY": 6.0, "VISO_DELAY_MS": 150.0},
}


@dataclass
class Feed:
    """A feed of an autopilot that says what it is told to; ``said`` is what was found, and when first."""

    flavour: str = "px4"
    values: dict[str, float] = field(default_factory=dict)
    flags: int = UNAIDED
    ratio: float = 0.1
    text: str = ""
    rate_hz: float = 10.0
    age_s: float = 0.15
    global_off_m: float = 0.0
    own_off_m: float = 0.0
    phase: FeedPhase = FeedPhase.FEEDING

    def run(self, seconds: float = 2.0) -> tuple[str, float]:
        """What is said at the end, and when it was said first."""
        fusion, watch = FusionWatch(), AutopilotWatch(FRAME)
        watch.on_message(mavlink.MAVLink_gps_global_origin_message(470000000, 80000000, 400000), 0.0)
        values = RIGHT[self.flavour] | self.values
        wanted = requirements(self.flavour, "odometry")
        said, first_s, next_s = "", float("inf"), 0.0
        for step in range(round(seconds * 10) + 1):
            now_s = step * 0.1
            position = np.array((now_s, 0.0, -5.0))
            watch.on_own(AutopilotEstimate(now_s, (now_s + self.own_off_m, 0.0, -5.0), (1.0, 0.0, 0.0)))
            lat_deg, lon_deg, _ = FRAME.geodetic((now_s + self.own_off_m, self.global_off_m, -5.0))
            place = round(lat_deg * 1e7), round(lon_deg * 1e7), 405_000
            watch.on_global(mavlink.MAVLink_global_position_int_message(0, *place, 0, 0, 0, 0, 0), now_s, now_s)
            status = mavlink.MAVLink_estimator_status_message(0, self.flags, 0, self.ratio, 0, 0, 0, 0, 0, 0)
            watch.on_message(status, now_s)
            if self.text:
                watch.on_message(mavlink.MAVLink_statustext_message(2, self.text.encode()), now_s)
            if now_s >= next_s - 1e-9:
                next_s += 1.0 / self.rate_hz
                fusion.on_sent(now_s - self.age_s, now_s, position)
            said = fusion.observe(self.phase, self.flavour, wanted, values, watch, now_s, now_s)
            first_s = min(first_s, now_s) if said else first_s
        return said, first_s


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_nothing_is_said_of_a_feed_that_is_used(flavour: str) -> None:
    assert Feed(flavour, flags=AIDED).run(10.0) == ("", float("inf"))


@pytest.mark.parametrize(
    ("feed", "said"),
    [
        (Feed(values={"EKF2_EV_CTRL": 0.0}), "parameter EKF2_EV_CTRL is 0, not 5"),
        (Feed("ardupilot", values={"VISO_TYPE": 0.0}), "parameter VISO_TYPE is 0, not 1"),
        (Feed("ardupilot", values={"EK3_SRC2_POSXY": 3.0}), "parameter EK3_SRC2_POSXY is 3, not 6"),
        (Feed(rate_hz=3.0), "rate"),
        (Feed(age_s=0.4), "delay: estimates are 0.40 s old"),
        (Feed(global_off_m=12.0), "origin: its global and local positions are 12 m apart"),
        (Feed(text="ODOMETRY: estimator_type 5 rejected"), "frame: it says"),
        (Feed("ardupilot", text="PreArm: VisOdom: not healthy"), "frame: it says"),
        (Feed(ratio=3.2), "variance: innovations are 3.2 times"),
        (Feed(), "frame: messages come in time and are dropped"),
        (Feed(flags=AIDED, own_off_m=6.0), "frame: messages come in time"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_each_cause_is_said_by_name_within_two_seconds(feed: Feed, said: str) -> None:
    found, first_s = feed.run()

    assert found.startswith(said)
    assert first_s <= 2.0


def test_a_parameter_is_said_before_gps_is_lost() -> None:
    found, first_s = Feed(values={"EKF2_EV_CTRL": 4.0}, flags=AIDED, phase=FeedPhase.READY).run()

    assert (found.startswith("parameter EKF2_EV_CTRL is 4"), first_s) == (True, 0.0)


def test_flags_that_go_while_nothing_is_fed_are_not_our_doing() -> None:
    assert Feed(phase=FeedPhase.WITHHELD).run(10.0)[0] == ""


def test_an_autopilot_is_given_a_second_to_begin() -> None:
    assert Feed().run(0.9)[0] == ""


def test_integers_of_px4_come_as_their_bytes() -> None:
    def value(encoded: float, kind: int) -> Any:
        return mavlink.MAVLink_param_value_message(b"EKF2_EV_CTRL", encoded, kind, 1, 0)

    assert parameter_value(value(7.006492321624085e-45, mavlink.MAV_PARAM_TYPE_INT32), "px4") == 5.0
    assert parameter_value(value(5.0, mavlink.MAV_PARAM_TYPE_INT32), "ardupilot") == 5.0
    assert parameter_value(value(0.5, mavlink.MAV_PARAM_TYPE_REAL32), "px4") == 0.5


def test_parameters_are_asked_for_one_at_a_time_and_given_up_where_there_are_none() -> None:
    reader, wanted = ParameterReader(), requirements("px4", "odometry")
    answered = wanted[0].name
    asked: list[str] = []
    for step in range(2000):
        name = reader.due(wanted, step * 0.05)
        if name is None:
            continue
        asked.append(name)
        if name == answered:
            reader.on_value(
                mavlink.MAVLink_param_value_message(name.encode(), 0.0, mavlink.MAV_PARAM_TYPE_INT32, 1, 0), "px4"
            )

    assert asked.count(answered) == 1
    assert {asked.count(each.name) for each in wanted[1:]} == {5}


@pytest.mark.parametrize(
    ("flavour", "kind", "names"),
    [
        ("px4", "gps_input", set()),
        ("ardupilot", "global", set()),
        ("ardupilot", "gps_input", {"GPS2_TYPE", "GPS_AUTO_SWITCH"}),
        ("px4", "global", {"EKF2_AGP0_ID", "EKF2_AGP0_CTRL", "EKF2_AGP0_NOISE", "EKF2_AGP0_DELAY"}),
    ],
)
def test_each_kind_has_its_parameters(flavour: str, kind: Any, names: set[str]) -> None:
    assert {each.name for each in requirements(flavour, kind)} == names
