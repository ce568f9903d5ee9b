"""GLOBAL_POSITION_SENSOR and GPS_INPUT on fake autopilots: taken, refused and weighed as by the real ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim_bridge.autopilot.flavours import FLAVOURS
from sim_bridge.autopilot.global_feed import GlobalFeed
from sim_bridge.world.noise import FlavourName

LAT, LON = 470_000_000, 80_000_000


def feed(flavour: FlavourName, **changed: float) -> GlobalFeed:
    """With parameters as the firmware has them, but for some."""
    values = {name: each.value for name, each in FLAVOURS[flavour].parameters.items()} | changed
    return GlobalFeed(flavour, values.__getitem__, lambda lat, lon, alt: (1e5 * (lat - 47), 1e5 * (lon - 8), -alt))


def sensor(**changed: Any) -> Any:
    fields: dict[str, Any] = {
        "target_system": 1, "target_component": 1, "id": 1, "time_usec": 1, "processing_time": 0, "source": 6,
        "flags": 0, "lat": LAT + 1000, "lon": LON, "alt_ellipsoid": 0.0, "alt": 400.0, "eph": 0.4, "epv": 0.5,
    }  # fmt: skip
    return mavlink.MAVLink_global_position_sensor_message(**{**fields, **changed})


def receiver(**changed: Any) -> Any:
    fields: dict[str, Any] = {
        "time_usec": 1, "gps_id": 1, "ignore_flags": 0, "time_week_ms": 0, "time_week": 2000, "fix_type": 3,
        "lat": LAT + 1000, "lon": LON, "alt": 10.0, "hdop": 0.8, "vdop": 1.0, "vn": 1.0, "ve": 2.0, "vd": 0.5,
        "speed_accuracy": 0.1, "horiz_accuracy": 0.4, "vert_accuracy": 0.6, "satellites_visible": 10, "yaw": 0,
    }  # fmt: skip
    return mavlink.MAVLink_gps_input_message(**{**fields, **changed})


def test_px4_takes_it_horizontally_no_surer_than_its_parameter_and_for_so_old_as_another_says() -> None:
    taken = feed("px4").of_sensor(sensor(), 50.0)

    assert taken is not None
    assert taken.position_m[:2] == pytest.approx((10.0, 0.0), abs=0.02)
    assert np.isnan(taken.position_m[2])
    assert (taken.position_sigma_m[0], taken.taken_s, taken.velocity_mps) == (1.0, 49.85, None)
    poor = feed("px4").of_sensor(sensor(eph=2.5), 50.0)
    assert poor is not None
    assert poor.position_sigma_m[0] == 2.5


@pytest.mark.parametrize(
    ("changed", "parameters", "reason"),
    [
        ({"id": 2}, {}, "id 2"),
        ({}, {"EKF2_AGP0_CTRL": 0}, "EKF2_AGP0_CTRL"),
        ({"eph": float("nan")}, {}, "no position"),
        ({"lat": 0, "lon": 0}, {}, "no position"),
    ],
)
def test_px4_drops_the_rest(changed: dict[str, Any], parameters: dict[str, float], reason: str) -> None:
    judge = feed("px4", **parameters)

    assert judge.of_sensor(sensor(**changed), 1.0) is None
    assert judge.rejected == {reason: 1}


def test_the_delay_counts_as_it_was_at_boot() -> None:
    values = {name: each.value for name, each in FLAVOURS["px4"].parameters.items()}
    judge = GlobalFeed("px4", values.__getitem__, lambda _lat, _lon, _alt: (0.0, 0.0, 0.0))
    values["EKF2_AGP0_DELAY"] = 0.0

    taken = judge.of_sensor(sensor(), 50.0)

    assert taken is not None
    assert taken.taken_s == 49.85


def test_a_second_receiver_is_used_while_the_first_has_no_fix() -> None:
    judge = feed("ardupilot")

    assert judge.of_receiver(receiver(), 1.0, True) is None
    used = judge.of_receiver(receiver(), 1.0, False)

    assert used is not None
    assert used.position_ned_m == pytest.approx((10.0, 0.0, -10.0), abs=0.02)
    assert (used.velocity_ned_mps, used.h_acc_m) == ((1.0, 2.0, 0.5), pytest.approx(0.4))
    assert judge.accepted == 2


@pytest.mark.parametrize(
    ("changed", "parameters"),
    [
        ({}, {"GPS2_TYPE": 1}),
        ({}, {"GPS_AUTO_SWITCH": 0}),
        ({"gps_id": 0}, {}),
        ({"gps_id": 7}, {}),
        ({"fix_type": 1}, {}),
    ],
)
def test_what_is_no_receiver_of_its_is_not_used(changed: dict[str, Any], parameters: dict[str, float]) -> None:
    assert feed("ardupilot", **parameters).of_receiver(receiver(**changed), 1.0, False) is None


def test_the_only_receiver_may_be_ours() -> None:
    assert feed("ardupilot", GPS1_TYPE=14).of_receiver(receiver(gps_id=0), 1.0, False) is not None


def test_each_reads_its_own_message_only() -> None:
    px4, ardupilot = feed("px4"), feed("ardupilot")

    assert px4.of_receiver(receiver(), 1.0, False) is None
    assert ardupilot.of_sensor(sensor(), 1.0) is None
    assert (px4.rejected, ardupilot.rejected) == (
        {"GPS_INPUT not handled": 1},
        {"GLOBAL_POSITION_SENSOR not handled": 1},
    )
