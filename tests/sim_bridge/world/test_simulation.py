"""The whole simulated fleet in virtual time: repeatable, on the tick grid, seen by the fleet as configured."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.config.reading import config_from, load_config
from sim_bridge.faults.fault_tables import GpsOff
from sim_bridge.world.guidance import Circle, FigureEight, Waypoints
from sim_bridge.world.scenario import Interval, Reboot, ScenarioError, Vehicle
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.simulation import Simulation, aligned_start
from sim_bridge.world.uwb_frames import UwbDrivers
from transport.messages.uwb_body import UwbIntake

CONFIGS = Path(__file__).parents[3] / "configs"
TABLES = {file: tomllib.loads(file.read_text()) for file in sorted(CONFIGS.glob("*.toml"))}
FLEETS = [file for file, tables in TABLES.items() if "paths" in tables.get("sim", {})]
FLEET = (Vehicle(1, "px4", 1), Vehicle(2, "ardupilot", 2), Vehicle(3, "px4", 3))


def everything(simulation: Simulation, times: list[float]) -> tuple[list[tuple[int, bytes]], list[bytes]]:
    """Frames and range payloads of a run whose driver calls at these times."""
    drivers = UwbDrivers()
    frames, payloads = [], []
    for time in times:
        outputs = simulation.advance(time)
        frames += outputs.frames
        payloads += [drivers.payload(taken_s, ranges) for taken_s, ranges in outputs.ranges]
    return frames, payloads


@pytest.mark.parametrize("profile", ["paper", "realistic"])
def test_one_seed_gives_one_run_to_the_bit_and_another_a_different_one(make_scenario, profile):
    times = [0.05 * k for k in range(60)]
    runs = [
        everything(Simulation(make_scenario(*FLEET, seed=seed, profile=profile), 0.0, 1e9), times)
        for seed in (7, 7, 8)
    ]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


@settings(max_examples=10, deadline=None)
@given(gaps=st.lists(st.floats(0.0, 0.4), min_size=1, max_size=20))
def test_what_happens_does_not_depend_on_when_the_driver_calls(make_scenario, gaps):
    scenario = make_scenario(*FLEET)
    end = sum(gaps)
    steadily = everything(Simulation(scenario), [*np.arange(0.0, end, 0.005).tolist(), end])
    assert everything(Simulation(scenario), np.cumsum(gaps).tolist()) == steadily


def test_nothing_happens_before_the_start(make_scenario):
    simulation = Simulation(make_scenario(*FLEET), 100.0)
    outputs = simulation.advance(100.0)
    assert outputs.frames == outputs.ranges == []
    assert simulation.world.step_index == 0


@settings(max_examples=50, deadline=None)
@given(now=st.floats(0.0, 1e6), offset=st.floats(1e9, 2e9))
def test_a_run_starts_on_a_tick(make_scenario, now, offset):
    scenario = make_scenario(*FLEET, epoch_unix_s=1e9, period_s=0.1)
    start = aligned_start(now, offset, scenario)
    assert now <= start <= now + 0.1 + 1e-6
    ticks = (start + offset - 1e9) / 0.1
    assert ticks == pytest.approx(round(ticks), abs=1e-4)


def test_starts_are_drawn_about_the_paths_as_in_the_studies(make_scenario):
    starts = np.array(
        [Simulation(make_scenario(*FLEET, seed=seed)).world.position_m for seed in range(60)]
    ) - np.array([[5.0, 0.0, 5.0], [0.0, 5.0, 6.0], [-5.0, 0.0, 7.0]])
    assert np.abs(starts).max() <= 15.0
    assert starts.std() == pytest.approx(15.0 / np.sqrt(3.0), rel=0.08)


def test_ranges_reach_an_agents_intake(make_scenario):
    simulation = Simulation(make_scenario(*FLEET, edges=((1, 2), (2, 3)), profile="realistic"), 500.0)
    drivers, intake = UwbDrivers(), UwbIntake(2)
    taken = []
    for _ in range(400):
        now = simulation.next_step_s()
        for taken_s, ranges in simulation.advance(now).ranges:
            payload = drivers.payload(taken_s, ranges)
            if ranges.observer == 2:
                accepted = intake.accept(payload, unix_s=0.0, monotonic_s=now)
                assert accepted is not None
                frame, age_s = accepted
                assert age_s == pytest.approx(0.0, abs=1e-6)
                taken.append((frame.seq, {entry.other for entry in frame.ranges}))
    assert [seq for seq, _ in taken] == list(range(20))
    assert all(others == {1, 3} for _, others in taken)
    assert intake.skipped == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": ((1, 9),)}, r"edges: expected one of the agents \[1, 2, 3\], found 9"),
        ({"gps_outages": (Interval(5, 0, 1),)}, "gps_outages"),
        ({"faults": (GpsOff(agents=(5,)),)}, "faults"),
        ({"reboots": (Reboot(5, 1.0),)}, "reboots"),
        ({"silences": (Interval(5, 0, 1),)}, "silences"),
        ({"imu_hz": 1000.0}, "imu_hz: expected more than 0 and at most 200"),
        ({"uwb_hz": 0.0}, "uwb_hz"),
        ({"period_s": float("nan")}, "period_s"),
    ],
)
def test_impossible_scenarios_are_refused_by_name(make_scenario, changes, message):
    with pytest.raises(ScenarioError, match=message):
        make_scenario(*FLEET, **changes)


def test_vehicles_must_be_distinct_and_their_paths_flyable(make_scenario):
    with pytest.raises(ScenarioError, match="distinct system_id"):
        make_scenario(Vehicle(1), Vehicle(2))
    with pytest.raises(ScenarioError, match=r"system_id: expected 1\.\.255, found 300"):
        make_scenario(Vehicle(300, system_id=300))
    with pytest.raises(ScenarioError, match="needs at most 2"):
        make_scenario(Vehicle(1, path=Circle((0.0, 0.0, 0.0), 10.0, 5.0)))


def document(**sim):
    return {
        "fleet": {
            "name": "line3",
            "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 500.0, "altitude": "ellipsoid"},
            "edges": [[1, 2], [2, 30]],
            "epoch_unix_s": 12.0,
        },
        "agents": [
            {"id": 1, "mavlink": "udpin:127.0.0.1:14551", "autopilot": "ardupilot", "system_id": 11},
            {"id": 2, "mavlink": "udpin:127.0.0.1:14552", "autopilot": "px4"},
            {"id": 30, "mavlink": "udpin:127.0.0.1:14553"},
        ],
        "sensors": {"gps_speed": "norm"},
        "sim": sim,
    }


def test_a_configuration_becomes_the_scenario_it_describes():
    config = config_from(
        document(
            seed=9,
            profile="realistic",
            gps_hz=5.0,
            gps_outages=[{"agent": 2, "from_s": 20.0, "to_s": 40.0}],
            paths=[
                {"agent": 1, "kind": "circle", "center_m": [0.0, 0.0, -5.0], "radius_m": 4.0},
                {"agent": 2, "kind": "figure_eight", "center_m": [0.0, 0.0, -5.0]},
                {"agent": 30, "kind": "waypoints", "points_m": [[1.0, 2.0, -3.0]]},
            ],
        ),
        "test",
    )
    scenario = scenario_from_config(config)
    assert [(v.agent, v.flavour, v.system_id) for v in scenario.vehicles] == [
        (1, "ardupilot", 11),
        (2, "px4", 2),
        (30, "px4", 30),
    ]
    assert [type(v.path) for v in scenario.vehicles] == [Circle, FigureEight, Waypoints]
    assert (scenario.seed, scenario.profile, scenario.gps_hz, scenario.gps_speed) == (9, "realistic", 5.0, "norm")
    assert scenario.gps_outages == (Interval(2, 20.0, 40.0),)
    assert scenario.ranged_by(2) == (1, 30)
    assert scenario.epoch_unix_s == 12.0
    assert not scenario.frame.msl
    # gravity is the one that the daemons remove
    assert scenario.gravity == pytest.approx(9.8069, abs=2e-3)


def test_a_configuration_beyond_the_simulator_is_refused():
    steep = {"agent": 2, "kind": "circle", "center_m": [0.0, 0.0, -5.0], "radius_m": 50.0, "lap_s": 10.0}
    with pytest.raises(ScenarioError, match=r"agent 2: path: expected one that needs at most 2\.0 m/s2 per axis"):
        scenario_from_config(config_from(document(paths=[steep]), "test"))


@pytest.mark.parametrize("file", FLEETS, ids=lambda file: file.stem)
def test_the_fleets_that_come_with_the_project_can_be_flown(file):
    config = load_config(file)
    simulation = Simulation(scenario_from_config(config))
    frames, payloads = everything(simulation, [1.0])
    assert {agent for agent, _ in frames} == set(config.ids)
    assert len(payloads) >= 8 * len(config.ids)
