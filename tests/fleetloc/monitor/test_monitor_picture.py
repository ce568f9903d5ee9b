"""The picture of a fleet in virtual time: states, alarms, links, ellipses, and who is lost when."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from fleetloc.monitor import table
from fleetloc.monitor.links import LOSS_WINDOW_S, LinkHistory
from fleetloc.monitor.picture import FleetPicture, ellipse_of
from fleetloc.monitor.views import Alarm, Drone, Picture
from tests.support.beacon import diagnostics, fleet_estimate
from transport.messages.far_body import FarReport, FarReports
from transport.messages.report_body import Diagnostics

UNIX_S = 1_800_000_000.0
FLEET = {"name": "watched", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0}}


def fleet(**tables: object) -> FleetConfig:
    document = {
        "fleet": FLEET,
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24550 + i}"} for i in (1, 2, 3)],
    }
    return config_from(document | tables, "test")


class Flight:
    """A fleet in virtual time: everyone of ``alive`` sends as daemons do, ten estimates and a report a second."""

    def __init__(self, config: FleetConfig) -> None:
        self.config = config
        self.picture = FleetPicture(config)
        self.now_s = 100.0
        self.steps = 0
        self.reports: dict[int, dict[str, object]] = {}
        for agent_id in config.ids:
            self.picture.on_presence(agent_id, True, self.now_s)

    def fly(self, seconds: float, alive: tuple[int, ...] = (1, 2, 3)) -> Picture:
        for _ in range(round(seconds * 10)):
            self.steps += 1
            self.now_s += 0.1
            for agent_id in alive:
                estimate = fleet_estimate(self.config, self.steps * 0.1, own=agent_id)
                self.picture.on_estimate(agent_id, estimate, self.now_s)
                if self.steps % 10 == 1:
                    self.picture.on_diagnostics(self.report_of(agent_id), self.now_s)
        return self.shown()

    def report_of(self, agent_id: int) -> Diagnostics:
        report = diagnostics(self.config, agent_id, seconds=1 + self.steps // 10)
        return msgspec.structs.replace(report, **self.reports.get(agent_id, {}))

    def shown(self) -> Picture:
        return self.picture.at(self.now_s, UNIX_S + self.now_s)


def drone(picture: Picture, agent_id: int) -> Drone:
    return next(one for one in picture.drones if one.agent_id == agent_id)


def alarms(picture: Picture, agent_id: int) -> list[Alarm]:
    return [alarm for alarm in picture.alarms if alarm.agent_id == agent_id]


def test_a_fleet_that_is_well_has_no_alarms() -> None:
    picture = Flight(fleet()).fly(5.0)
    assert [one.status for one in picture.drones] == ["ok"] * 3
    assert picture.alarms == ()
    assert {link.level for link in picture.links} == {"ok"}
    assert len(picture.links) == 6


def test_before_anyone_is_heard_the_picture_says_so() -> None:
    picture = FleetPicture(fleet()).at(0.0, UNIX_S)
    assert [one.status for one in picture.drones] == ["unseen"] * 3
    assert any("no drone heard" in alarm.text for alarm in alarms(picture, 0))


def test_a_drone_whose_presence_is_withdrawn_is_lost_at_once() -> None:
    flight = Flight(fleet())
    flight.fly(5.0)
    flight.picture.on_presence(2, False, flight.now_s)
    picture = flight.shown()
    assert drone(picture, 2).status == "lost"
    assert [alarm.level for alarm in alarms(picture, 2)] == ["bad"]
    assert drone(picture, 2).position_m is not None  # where it was last
    assert drone(picture, 1).status == "ok"


def test_a_silent_drone_is_stale_and_then_lost_within_three_seconds_though_its_presence_stands() -> None:
    flight = Flight(fleet())
    flight.fly(5.0)
    statuses = [drone(flight.fly(0.1, alive=(1, 3)), 2).status for _ in range(30)]
    assert statuses[-1] == "lost"
    assert list(dict.fromkeys(statuses)) == ["ok", "stale", "lost"]
    assert statuses.index("stale") in (9, 10, 11)
    assert statuses.index("lost") in (19, 20, 21)


def test_what_is_lost_comes_back_with_its_first_packet() -> None:
    flight = Flight(fleet())
    flight.fly(3.0)
    flight.picture.on_presence(2, False, flight.now_s)
    assert drone(flight.fly(1.0, alive=(1, 3)), 2).status == "lost"
    assert drone(flight.fly(1.5), 2).status == "ok"
    assert alarms(flight.shown(), 2) == []


def test_a_slow_fleet_is_not_called_lost_between_two_ticks() -> None:
    config = fleet()
    slow = msgspec.structs.replace(config, fleet=msgspec.structs.replace(config.fleet, period_s=2.0))
    picture = FleetPicture(slow)
    picture.on_estimate(1, fleet_estimate(slow, 0.0, own=1), 10.0)
    assert drone(picture.at(15.9, UNIX_S), 1).status == "there"
    assert drone(picture.at(16.5, UNIX_S), 1).status == "stale"
    assert drone(picture.at(22.5, UNIX_S), 1).status == "lost"


def test_neighbours_tell_where_a_lost_drone_should_be() -> None:
    flight = Flight(fleet())
    flight.fly(3.0)
    flight.picture.on_presence(2, False, flight.now_s)
    seen = drone(flight.fly(1.0, alive=(1, 3)), 2).seen_by
    assert seen is not None
    expected = fleet_estimate(flight.config, flight.steps * 0.1, own=1).mean[6:9]
    np.testing.assert_allclose(seen.position_m, expected)
    assert seen.sigma_m == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("report", "level", "text"),
    [
        ({"state": "degraded", "reasons": ("not observable: all in one plane",)}, "bad", "one plane"),
        ({"state": "degraded", "reasons": ("autopilot lost",)}, "warning", "autopilot lost"),
        ({"state": "fault", "reasons": ("position unknown",)}, "bad", "position unknown"),
        (
            {"state": "degraded", "reasons": ("no GPS",), "gauges": {"gps_age_s": 7.2, "gps_fix_type": 1.0}},
            "warning",
            "no GPS fix for 7 s, receiver says no fix",
        ),
        ({"state": "degraded", "reasons": ("no GPS",), "gauges": {}}, "warning", "no GPS"),
    ],
)
def test_what_a_drone_complains_of_is_an_alarm(report: dict[str, object], level: str, text: str) -> None:
    flight = Flight(fleet())
    flight.reports[3] = report
    (first,) = alarms(flight.fly(2.0), 3)
    assert (first.level, text in first.text) == (level, True)
    (later,) = alarms(flight.fly(2.0), 3)
    assert later.since_unix_s == first.since_unix_s


@pytest.mark.parametrize(("status", "level"), [(1, "warning"), (2, "warning"), (3, "bad"), (4, "warning")])
def test_the_status_of_the_estimate_is_an_alarm_where_the_reasons_do_not_say_it(status: int, level: str) -> None:
    flight = Flight(fleet())
    flight.fly(1.0)
    estimate = fleet_estimate(flight.config, flight.steps * 0.1, own=1)
    flight.picture.on_estimate(1, replace(estimate, status=status), flight.now_s)
    assert [alarm.level for alarm in alarms(flight.shown(), 1)] == [level]


def test_a_drone_that_its_neighbours_have_elsewhere_is_an_alarm() -> None:
    # GIVEN drone 1 that is off by 20 m and sure of itself
    flight = Flight(fleet())
    flight.fly(2.0)
    lying = fleet_estimate(flight.config, flight.steps * 0.1, own=1)
    lying.mean[0] += 20.0
    flight.picture.on_estimate(1, lying, flight.now_s)
    # THEN it is said how far apart they are
    (alarm,) = alarms(flight.shown(), 1)
    assert alarm.level == "bad"
    assert "20.0 m" in alarm.text


def test_a_drone_that_waits_for_its_first_fix_is_nowhere_and_no_alarm() -> None:
    flight = Flight(fleet())
    flight.reports[1] = {"state": "init", "reasons": ("waiting for fixes", "no GPS"), "gauges": {}}
    flight.fly(2.0)
    nowhere = fleet_estimate(flight.config, flight.steps * 0.1, own=1)
    flight.picture.on_estimate(1, replace(nowhere, status=4, own_covariance=np.eye(6) * 1e8), flight.now_s)
    picture = flight.shown()
    assert drone(picture, 1).position_m is None
    assert drone(picture, 1).ellipse is None
    assert {alarm.level for alarm in alarms(picture, 1)} == {"info"}


def test_a_link_that_its_receiver_does_not_hear_is_bad_and_loss_is_that_of_the_last_seconds() -> None:
    config = fleet()
    flight = Flight(config)
    flight.fly(20.0)
    deaf = {str(other): {"received": 9e3, "lost": 1e3, "heard_age_s": 0.1} for other in (2, 3)}
    deaf["2"]["heard_age_s"] = 6.5
    flight.reports[1] = {"neighbours": deaf}
    links = {(link.sender, link.receiver): link for link in flight.fly(2.0).links}
    assert links[2, 1].level == "bad"
    assert links[3, 1].level == "ok"
    assert links[1, 2].loss == pytest.approx(0.1)


def test_refused_packets_are_an_alarm_while_they_come() -> None:
    flight = Flight(fleet())
    flight.picture.on_refused({"stale": 0}, flight.now_s)
    flight.fly(1.0)
    flight.picture.on_refused({"stale": 40, "replay": 2}, flight.now_s)
    (alarm,) = alarms(flight.shown(), 0)
    assert "42 packets refused" in alarm.text
    assert "clock" in alarm.text
    flight.fly(LOSS_WINDOW_S + 1.0)
    flight.picture.on_refused({"stale": 40, "replay": 2}, flight.now_s)
    assert alarms(flight.shown(), 0) == []


def test_tracks_hold_the_last_minute_and_no_more() -> None:
    flight = Flight(fleet(monitor={"track_s": 5.0}))
    flight.fly(12.0)
    tracks = flight.picture.tracks()
    assert 20 <= len(tracks.points[1]) <= 27
    np.testing.assert_allclose(tracks.points[2][-1], drone(flight.shown(), 2).position_m, atol=0.2)


def test_the_picture_is_json_that_browsers_read_and_fits_a_terminal() -> None:
    picture = Flight(fleet()).fly(2.0)
    assert msgspec.json.decode(msgspec.json.encode(picture), type=Picture) == picture
    assert "drone 1: ok" in table.lines(picture)[1]
    table.table(picture, "")


angles = st.floats(-math.pi / 2 + 0.01, math.pi / 2 - 0.01)
sigmas = st.floats(0.01, 100.0)


@given(major=sigmas, ratio=st.floats(0.05, 0.9), angle=angles, up=sigmas)
def test_an_ellipse_is_that_of_the_covariance(major: float, ratio: float, angle: float, up: float) -> None:
    # GIVEN a covariance with known axes, the major one turned from north towards east
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([major**2, (ratio * major) ** 2]) @ turn.T
    covariance[2, 2] = up**2
    ellipse = ellipse_of(covariance)
    assert ellipse.major_m == pytest.approx(3 * major, rel=1e-6)
    assert ellipse.minor_m == pytest.approx(3 * ratio * major, rel=1e-5)
    assert ellipse.up_m == pytest.approx(3 * up)
    assert abs(math.sin(ellipse.angle_rad - angle)) < 1e-4  # an axis points both ways


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 50)), min_size=2, max_size=40))
def test_loss_is_a_share_whatever_the_counters_do(steps: list[tuple[int, int]]) -> None:
    history = LinkHistory()
    received = lost = 0
    for second, (more, missing) in enumerate(steps):
        received, lost = received + more, lost + missing
        history.add(float(second), received, lost)
    loss = history.loss
    assert loss is None or 0.0 <= loss <= 1.0


def test_loss_starts_anew_with_the_receiver() -> None:
    history = LinkHistory()
    for when_s, received, lost in [(0.0, 500, 500), (1.0, 510, 510), (2.0, 5, 0), (3.0, 15, 0)]:
        history.add(when_s, received, lost)
    assert history.loss == 0.0


def test_a_drone_that_only_others_report_of_is_shown_with_its_age_until_its_fleet_lets_it_go() -> None:
    # GIVEN a monitor that hears drone 1 alone, which passes on what drone 3 said of itself 0.7 s before
    picture = FleetPicture(fleet(fleet={**FLEET, "joint_bodies": 2}))
    sigmas = (0.3, 0.3, 0.4)
    report = FarReport(3, 993, 0, (100.0, 20.0, -30.0), (2.0, 0.0, 0.0), sigmas, (0.1, 0.1, 0.1))
    picture.on_far_reports(1, FarReports(1000, (report,)), 50.0)
    picture.on_far_reports(2, FarReports(1001, (replace(report, tick=983),)), 50.1)  # an older one, by another way
    # WHEN one looks
    seen = drone(picture.at(50.0, UNIX_S), 3).seen_by
    later = drone(picture.at(51.0, UNIX_S), 3)
    # THEN it is where it flew on to, less sure than it was, and the older the less
    assert seen is not None
    assert later.seen_by is not None
    assert (seen.agent_id, seen.age_s, later.seen_by.age_s) == (1, pytest.approx(0.7), pytest.approx(1.7))
    assert seen.position_m == pytest.approx((101.4, 20.0, -30.0))
    assert later.seen_by.position_m == pytest.approx((103.4, 20.0, -30.0))
    assert math.hypot(*sigmas) < seen.sigma_m < later.seen_by.sigma_m
    assert later.position_m is None
    north, _, up, *_, age_s = table.cells(later, ())[:6]
    assert (north, up, age_s) == ("103.4", "30.0", "1.7")
    # WHEN nothing more comes for as long as a drone is kept
    assert drone(picture.at(50.0 + 9.2, UNIX_S), 3).seen_by is not None
    assert drone(picture.at(50.0 + 9.4, UNIX_S), 3).seen_by is None


def test_a_report_of_the_future_does_not_stand_for_good() -> None:
    config = fleet(fleet={**FLEET, "joint_bodies": 2})
    picture, sigmas = FleetPicture(config), (0.3, 0.3, 0.4)
    wild = FarReport(3, 10**6, 0, (9000.0, 0.0, 0.0), (0.0, 0.0, 0.0), sigmas, (0.1, 0.1, 0.1))
    picture.on_far_reports(1, FarReports(10**6, (wild,)), 50.0)
    later_s = 50.0 + config.fleet.absent_after_s + 1.0
    picture.on_far_reports(1, FarReports(1100, (replace(wild, tick=1095, position_m=(7.0, 0.0, 0.0)),)), later_s)
    seen = drone(picture.at(later_s, UNIX_S), 3).seen_by
    assert seen is not None
    assert seen.position_m[0] == pytest.approx(7.0)


def test_what_is_promised_is_shown_and_an_alert_is_an_alarm() -> None:
    flight = Flight(fleet())
    said = "horizontal protection level 5.2 m above 4 m"
    gauges = {"protection_horizontal_m": 5.2, "protection_vertical_m": 3.1, "integrity_alert": 1.0}
    flight.reports[2] = {"gauges": gauges, "integrity": f"ALERT: {said}"}
    flight.reports[3] = {"gauges": {"protection_horizontal_m": 4e4, "protection_vertical_m": 4e4}}
    shown = flight.fly(2.0)
    assert drone(shown, 2).protection_m == (5.2, 3.1)
    assert drone(shown, 2).integrity == f"ALERT: {said}"
    assert [alarm.text for alarm in alarms(shown, 2)] == [said]
    assert drone(shown, 3).protection_m is None  # as good as unknown
    assert "5.2/3.1" in table.cells(drone(shown, 2), shown.links)
    # a reason that the drone gives itself is not told twice
    flight.reports[2] = {"gauges": gauges, "integrity": "ALERT: not observable", "reasons": ("not observable",)}
    assert [alarm.text for alarm in alarms(flight.fly(2.0), 2)].count("not observable") == 1
