"""Samples as values: those that the autopilots' messages would have."""

from __future__ import annotations

import numpy as np
import pytest

from agent.mavlink.dialect import mavlink
from agent.sensing.barometer import pressure_altitude_m
from agent.sensing.samples import BaroSample
from sim_bridge.world import geodesy
from sim_bridge.world.scenario import Vehicle
from sim_bridge.world.sensor_feed import SensorFeed
from sim_bridge.world.simulation import Simulation

SECONDS, START_FLEET_S = 5.0, 10_000.0
SETTINGS = {"profile": "nom", "seed": 5}


def true_altitude_m(simulation: Simulation, slot: int = 0) -> float:
    frame = simulation.scenario.frame
    return float(geodesy.msl_m(frame, frame.alt_m - simulation.world.position_m[slot, 2]))


def as_values(simulation: Simulation) -> list[tuple[BaroSample, float]]:
    """What the first vehicle's barometer says, and the true altitude at the time."""
    feed = SensorFeed(simulation, 50.0, 50.0, START_FLEET_S)
    said = []
    for _ in range(round(SECONDS / simulation.world.step_s)):
        for agent, sample in feed.step().samples:
            if agent == 1 and isinstance(sample, BaroSample):
                assert sample.t_s == START_FLEET_S + simulation.world.time_s
                said.append((sample, true_altitude_m(simulation)))
    return said


@pytest.mark.parametrize(
    ("flavour", "message", "rate_hz"), [("px4", "HIGHRES_IMU", 50.0), ("ardupilot", "SCALED_PRESSURE", 4.0)]
)
def test_a_barometer_says_what_the_autopilot_sends_of_it(make_scenario, connect, flavour, message, rate_hz):
    # GIVEN one flight, as values and over MAVLink, WHEN both are compared with the truth
    vehicle = Vehicle(1, flavour, 1)
    values = as_values(Simulation(make_scenario(vehicle, **SETTINGS), 0.0))
    client = connect(vehicle, **SETTINGS)
    client.set_rate(getattr(mavlink, f"MAVLINK_MSG_ID_{message}"), rate_hz)
    sent = []
    for k in range(1, round(SECONDS / 0.02) + 1):
        before = len(client.received[message])
        client.run_to(0.02 * k)
        for each in client.received[message][before:]:
            pressure_hpa = each.abs_pressure if message == "HIGHRES_IMU" else each.press_abs
            sent.append(pressure_altitude_m(pressure_hpa) - true_altitude_m(client.simulation))
    # THEN they come as often, are off by the same, and scatter alike
    assert len(values) == pytest.approx(len(sent), abs=2)
    assert len(values) == pytest.approx(rate_hz * SECONDS, abs=2)
    off = [sample.altitude_m - true_m for sample, true_m in values]
    assert abs(np.mean(off)) > 0.3
    assert np.mean(off) == pytest.approx(np.mean(sent), abs=0.15)
    assert np.std(off) == pytest.approx(np.std(sent), rel=0.5)


def test_a_profile_without_barometers_has_none(make_scenario):
    assert as_values(Simulation(make_scenario(Vehicle(1), profile="paper"), 0.0)) == []
