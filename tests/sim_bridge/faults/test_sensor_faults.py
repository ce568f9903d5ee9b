"""Injected faults of sensors: what is measured with them, and that nothing else changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import load_config
from agent.errors import ConfigError
from sim_bridge.faults.fault_tables import (
    AccelWrong,
    GpsDrift,
    GpsOff,
    GpsStuck,
    GpsWrong,
    UwbStuck,
    UwbSwapped,
    UwbWrong,
)
from sim_bridge.world.scenario import Scenario, Vehicle
from sim_bridge.world.sensors import GpsFix
from sim_bridge.world.sim_table import sim_table
from sim_bridge.world.simulation import Simulation

LINE3 = Path(__file__).parents[3] / "configs" / "line3.toml"
THREE = tuple(Vehicle(agent, "px4", agent) for agent in (1, 2, 3))
FROM_S, TO_S, END_S = 1.0, 2.0, 3.0


class Measured:
    """Everything that the sensors of a fleet say in a few seconds, by agent and time since the start."""

    def __init__(self, scenario: Scenario) -> None:
        simulation = Simulation(scenario, 500.0)
        self.fixes: dict[tuple[int, float], GpsFix] = {}
        self.force: dict[tuple[int, float], np.ndarray] = {}
        self.ranges: dict[tuple[int, int, float], tuple[float, float]] = {}
        for _ in range(round(END_S / simulation.world.step_s)):
            simulation.world.step()
            time_s = round(simulation.world.time_s, 6)
            for slot, fix in simulation.sensors.fixes():
                self.fixes[scenario.ids[slot], round(fix.time_s, 6)] = fix
            for slot, agent in enumerate(scenario.ids):
                self.force[agent, time_s] = simulation.sensors.imu(slot).accel_mps2
            for taken in simulation.sensors.ranges():
                for each in taken.ranges:
                    self.ranges[taken.observer, each.target, time_s] = (each.range_m, each.nlos)


@pytest.fixture(scope="module")
def clean(make_scenario):
    return Measured(make_scenario(*THREE, profile="nom"))


@pytest.fixture
def with_fault(make_scenario):
    return lambda *faults: Measured(make_scenario(*THREE, profile="nom", faults=faults))


def in_fault(time_s: float) -> bool:
    return FROM_S - 1e-9 <= time_s < TO_S - 1e-9


def assert_fixes_change_only(clean: Measured, faulty: Measured, agents: tuple[int, ...]) -> None:
    """Fixes of the others, and all outside the fault, are equal to the bit."""
    for (agent, time_s), fix in clean.fixes.items():
        if agent not in agents or not in_fault(time_s):
            assert faulty.fixes[agent, time_s] == fix
    assert faulty.ranges == clean.ranges


def hit(clean: Measured, agent: int) -> list[float]:
    times = [time_s for at, time_s in clean.fixes if at == agent and in_fault(time_s)]
    assert len(times) >= 9
    return times


def test_a_jump_moves_the_position_and_not_the_velocity(clean, with_fault):
    faulty = with_fault(GpsWrong(agents=(2,), from_s=FROM_S, to_s=TO_S, offset_m=(30.0, -4.0, 1.0)))
    assert_fixes_change_only(clean, faulty, (2,))
    for time_s in hit(clean, 2):
        was, now = clean.fixes[2, time_s], faulty.fixes[2, time_s]
        np.testing.assert_allclose(np.subtract(now.position_ned_m, was.position_ned_m), (30.0, -4.0, 1.0), atol=1e-9)
        assert now.velocity_ned_mps == was.velocity_ned_mps
        assert now.h_acc_m == was.h_acc_m
        assert now.lat_deg - was.lat_deg == pytest.approx(30.0 / 111_200, rel=5e-3)


def test_a_drift_drags_position_and_velocity_alike(clean, with_fault):
    faulty = with_fault(GpsDrift(agents=(1, 3), from_s=FROM_S, to_s=TO_S, rate_mps=(0.0, 5.0, 0.0)))
    assert_fixes_change_only(clean, faulty, (1, 3))
    for agent in (1, 3):
        for time_s in hit(clean, agent):
            was, now = clean.fixes[agent, time_s], faulty.fixes[agent, time_s]
            moved_m = np.subtract(now.position_ned_m, was.position_ned_m)
            np.testing.assert_allclose(moved_m, (0.0, 5.0 * (time_s - FROM_S), 0.0), atol=1e-6)
            gained = np.subtract(now.velocity_ned_mps, was.velocity_ned_mps)
            np.testing.assert_allclose(gained, (0.0, 5.0, 0.0), atol=1e-9)
            assert now.speed_mps != was.speed_mps


def test_a_stuck_receiver_repeats_one_fix_with_rising_stamps(clean, with_fault):
    faulty = with_fault(GpsStuck(agents=(2,), from_s=FROM_S, to_s=TO_S))
    assert_fixes_change_only(clean, faulty, (2,))
    times = hit(clean, 2)
    said = {
        (fix.valid, fix.position_ned_m, fix.lat_deg, fix.alt_msl_m, fix.speed_mps, fix.course_rad, fix.h_acc_m)
        for fix in (faulty.fixes[2, time_s] for time_s in times)
    }
    assert len(said) == 1
    assert faulty.fixes[2, times[0]] == clean.fixes[2, times[0]]
    assert [faulty.fixes[2, time_s].time_s for time_s in times] == pytest.approx(times)


def test_without_gps_there_is_no_fix(clean, with_fault):
    faulty = with_fault(GpsOff(agents=(1, 2), from_s=FROM_S, to_s=TO_S))
    assert_fixes_change_only(clean, faulty, (1, 2))
    assert not any(faulty.fixes[agent, time_s].valid for agent in (1, 2) for time_s in hit(clean, agent))


def test_an_accelerometer_has_a_bias_and_clips(clean, with_fault):
    faulty = with_fault(
        AccelWrong(agents=(3,), from_s=FROM_S, to_s=TO_S, bias_mps2=(0.5, 0.0, -0.2), limit_mps2=9.0)
    )
    for (agent, time_s), force in clean.force.items():
        expected = force
        if agent == 3 and in_fault(time_s):
            expected = np.clip(np.add(force, (0.5, 0.0, -0.2)), -9.0, 9.0)
        np.testing.assert_array_equal(faulty.force[agent, time_s], expected)
    clipped = [force[2] for (agent, time_s), force in faulty.force.items() if agent == 3 and in_fault(time_s)]
    assert min(clipped) == -9.0  # less than 1 g: it believes that it falls
    assert faulty.fixes == clean.fixes


def test_a_pair_is_biased_both_ways(clean, with_fault):
    faulty = with_fault(UwbWrong(pairs=((3, 1),), from_s=FROM_S, to_s=TO_S, bias_m=0.4))
    changed = set()
    for (observer, target, time_s), (range_m, nlos) in clean.ranges.items():
        now_m, now_nlos = faulty.ranges[observer, target, time_s]
        expected_m = 0.4 if {observer, target} == {1, 3} and in_fault(time_s) else 0.0
        assert now_m - range_m == pytest.approx(expected_m, abs=1e-9)
        assert now_nlos == nlos
        changed |= {(observer, target)} if expected_m else set()
    assert changed == {(1, 3), (3, 1)}


def test_a_block_without_line_of_sight_lengthens_its_share_of_ranges_and_shows_in_their_power(clean, with_fault):
    faulty = with_fault(UwbWrong(agents=(2,), from_s=FROM_S, nlos_share=0.7, nlos_mean_m=2.0))
    extra, told = [], []
    for (observer, target, time_s), (range_m, _) in clean.ranges.items():
        now_m, nlos = faulty.ranges[observer, target, time_s]
        if 2 in (observer, target) and time_s >= FROM_S:
            extra.append(now_m - range_m)
            told.append(nlos)
        else:
            assert now_m == range_m
    hidden = np.array(extra) > 1e-9
    assert len(extra) == pytest.approx(4 * 20, abs=4)
    assert hidden.mean() == pytest.approx(0.7, abs=0.15)
    assert np.array(extra)[hidden].mean() == pytest.approx(2.0, abs=0.8)
    assert min(np.array(told)[hidden]) >= 0.5
    assert np.array(extra).min() > -1e-9


def test_stuck_modules_repeat_the_first_range_since_each_way_its_own(clean, with_fault):
    faulty = with_fault(UwbStuck(pairs=((1, 2),), from_s=FROM_S, to_s=TO_S))
    held: dict[tuple[int, int], float] = {}
    for (observer, target, time_s), (range_m, nlos) in clean.ranges.items():
        if {observer, target} == {1, 2} and in_fault(time_s):
            range_m = held.setdefault((observer, target), range_m)
        assert faulty.ranges[observer, target, time_s] == (range_m, nlos)
    assert held.keys() == {(1, 2), (2, 1)}


def test_a_module_that_mixes_up_two_others_says_of_each_what_it_measured_of_the_other(clean, with_fault):
    faulty = with_fault(UwbSwapped(agents=(2,), between=(1, 3), from_s=FROM_S, to_s=TO_S))
    swapped = 0
    for (observer, target, time_s), measured in clean.ranges.items():
        wrong = observer == 2 and in_fault(time_s)
        assert faulty.ranges[observer, {1: 3, 3: 1}[target] if wrong else target, time_s] == measured
        swapped += wrong
    assert swapped > 10


def test_one_seed_draws_the_same_fault_and_another_seed_another(make_scenario):
    block = UwbWrong(nlos_share=0.5)
    runs = [Measured(make_scenario(*THREE, faults=(block,), seed=seed)).ranges for seed in (3, 3, 4)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


@pytest.mark.parametrize(
    ("fault", "key", "expected"),
    [
        ('{kind="gps_off", agents=[9]}', "sim.faults, entry 1, agents", "ids of agents (1, 2, 3)"),
        ('{kind="gps_off", agents=[]}', "sim.faults, entry 1, agents", "length >= 1"),
        ('{kind="gps_off", agents=[1], from_s=5.0, to_s=4.0}', "sim.faults, entry 1, to_s", "later than from_s = 5"),
        ('{kind="gps_wrong", agents=[1]}', "sim.faults, entry 1, offset_m", "found nothing"),
        ('{kind="gps_of", agents=[1]}', "sim.faults, entry 1, kind", "gps_off"),
        ('{kind="uwb_wrong", pairs=[[1, 1]], bias_m=1.0}', "sim.faults, entry 1, pairs", "two different agents"),
        ('{kind="uwb_wrong", agents=[1]}', "sim.faults, entry 1, bias_m", "other than 0"),
        ('{kind="uwb_stuck", pairs=[[1, 7]]}', "sim.faults, entry 1, pairs", "ids of agents (1, 2, 3)"),
        ('{kind="uwb_swapped", agents=[2], between=[3, 3]}', "sim.faults, entry 1, between", "two different agents"),
        ('{kind="accel_wrong", agents=[1]}', "sim.faults, entry 1, bias_mps2", "limit_mps2"),
    ],
)
def test_a_fault_that_cannot_be_is_refused_with_key_and_expectation(fault, key, expected):
    config = load_config(LINE3, [f"sim.faults=[{fault}]"])
    with pytest.raises(ConfigError) as refused:
        sim_table(config)
    assert key in str(refused.value)
    assert expected in str(refused.value)
