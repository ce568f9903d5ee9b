"""Simulated autopilots that lose their positions do what real firmware did in recorded flights, and when."""

from __future__ import annotations

import csv
import gzip
import struct
from pathlib import Path

import pytest

from agent.feedback.autopilot_watch import AIDED_FLAGS
from agent.mavlink.codec import Decoder
from sim_bridge.autopilot.flavours import FlightMode
from tests.support.fed_vehicle import FedVehicle

Event = tuple[float, str, str]
RECORDED = Path(__file__).parents[2] / "data/feedback/px4_feed_stops.csv"
RECORDED_BEGIN = RECORDED.with_name("px4_feed_begins.csv")
ARDUCOPTER = Path(__file__).parents[4] / "shared/data/sitl_external_nav/ext_gpsloss.tlog.gz"
PX4_LAND = "4/6"
ARDUPILOT_LAND, ARDUPILOT_GUIDED = "9", "4"
LOST_S, STOPPED_S = 12.0, 20.0
TOLD_S = 0.5
"""Flags and modes are told once to five times a second."""


def px4_events(recorded: Path = RECORDED) -> list[Event]:
    """Time, what, value."""
    with recorded.open(encoding="utf-8") as file:
        return [(float(row["at_s"]), row["what"], row["value"]) for row in csv.DictReader(file)]


def arducopter_events() -> list[Event]:
    """The same of a flight whose GPS was switched off for thirty seconds, nothing fed."""
    if not ARDUCOPTER.exists():
        pytest.skip(f"{ARDUCOPTER} is not beside the repository")
    data, decoder, events = gzip.decompress(ARDUCOPTER.read_bytes()), Decoder(datagrams=False), []
    now: dict[str, str] = {}
    at = 0
    while at + 20 <= len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        signed = data[at + 10] & 1
        size = data[at + 9] + (25 if signed else 12)
        for message in decoder.feed(data[at + 8 : at + 8 + size]):
            found = {
                "HEARTBEAT": ("mode", str(getattr(message, "custom_mode", ""))),
                "EKF_STATUS_REPORT": ("flags", hex(getattr(message, "flags", 0))),
                "GPS_RAW_INT": ("gps", "on" if getattr(message, "fix_type", 0) >= 3 else "off"),
            }.get(message.get_type())
            if found is not None and message.get_srcComponent() == 1 and now.get(found[0]) != found[1]:
                now[found[0]] = found[1]
                events.append((stamp_us * 1e-6, *found))
        at += 8 + size
    return events


def first_s(events: list[Event], what: str, value: str, after_s: float = 0.0) -> float:
    """When something was first so."""
    return next(at_s for at_s, each, found in events if (each, found) == (what, value) and at_s > after_s)


def unaided_s(events: list[Event], after_s: float) -> float:
    """When its estimator first said that it has no position."""
    flags = ((at_s, int(value, 16)) for at_s, what, value in events if what == "flags" and at_s > after_s)
    return next(at_s for at_s, value in flags if not value & AIDED_FLAGS)


def loss_of(flight: FedVehicle, after_s: float) -> tuple[float, float]:
    """The same of a simulated one, and when it landed."""
    later = [each for each in flight.flown if each[0] > after_s]
    return (
        next(at_s for at_s, aided, _ in later if not aided),
        next(at_s for at_s, _, mode in later if mode is FlightMode.LAND),
    )


def landing_s(events: list[Event]) -> float:
    """When the recorded ArduCopter went into LAND."""
    return first_s(events, "mode", ARDUPILOT_LAND)


def test_px4_that_is_no_longer_fed_loses_flags_and_lands_as_the_recorded_one() -> None:
    events = px4_events()
    stopped_s = first_s(events, "feed", "off")

    flight = FedVehicle("px4", outage_s=(LOST_S, 60.0), alive=lambda at_s: at_s < STOPPED_S).fly(STOPPED_S + 8.0)
    flags_s, landed_s = loss_of(flight, STOPPED_S)

    assert flags_s - STOPPED_S == pytest.approx(unaided_s(events, stopped_s) - stopped_s, abs=TOLD_S / 2)
    assert landed_s - STOPPED_S == pytest.approx(first_s(events, "mode", PX4_LAND) - stopped_s, abs=TOLD_S)
    assert {mode for at_s, _, mode in flight.flown if at_s < STOPPED_S} == {FlightMode.MISSION}


def test_px4_counts_on_its_receiver_as_long_as_the_recorded_one_and_is_set_to_a_feed_only_then() -> None:
    events = px4_events(RECORDED_BEGIN)
    lost_s = first_s(events, "gps", "off")
    given_up_s = first_s(events, "gnss_pos", "0") - lost_s
    assert [at_s > lost_s + given_up_s for at_s, what, _ in events if what == "reset_xy_m"] == [True]

    flight = FedVehicle("px4", outage_s=(LOST_S, 60.0)).fly(LOST_S + given_up_s - 1.0)
    assert flight.autopilot.state.feed.accepted > 20
    assert flight.autopilot.state.navigation.resets == 0
    flight.fly(LOST_S + given_up_s + 1.0)

    assert flight.autopilot.state.navigation.resets == 1


def test_the_recorded_px4_flew_on_while_it_was_fed() -> None:
    events = px4_events()
    stopped_s = first_s(events, "feed", "off")

    assert first_s(events, "gps", "off") < stopped_s - 45.0
    assert [value for at_s, what, value in events if what == "mode" and at_s < stopped_s] == ["4/3"]
    assert all(int(value, 16) & AIDED_FLAGS for at_s, what, value in events if what == "flags" and at_s < stopped_s)


def test_arducopter_without_gps_and_feed_does_as_the_recorded_one() -> None:
    events = arducopter_events()
    flying_s = first_s(events, "mode", ARDUPILOT_GUIDED)
    lost_s = first_s(events, "gps", "off", flying_s)
    back_s = first_s(events, "gps", "on", lost_s)

    outage_s = (LOST_S, LOST_S + back_s - lost_s)
    flight = FedVehicle("ardupilot", outage_s=outage_s, alive=lambda _at_s: False).fly(outage_s[1] + 4.0)
    flags_s, landed_s = loss_of(flight, LOST_S)
    again_s = next(at_s for at_s, aided, _ in flight.flown if aided and at_s > flags_s)

    assert flags_s - LOST_S == pytest.approx(unaided_s(events, lost_s) - lost_s, abs=TOLD_S)
    assert landed_s - LOST_S == pytest.approx(landing_s(events) - lost_s, abs=TOLD_S)
    recorded_s = first_s(events, "flags", "0x33f", back_s - 0.1) - back_s
    assert again_s - outage_s[1] == pytest.approx(recorded_s, abs=TOLD_S)
    assert flight.flown[-1][2] is FlightMode.LAND  # it stays there, as the recorded one
    assert {value for at_s, what, value in events if what == "mode" and at_s > landing_s(events)} <= {ARDUPILOT_LAND}
