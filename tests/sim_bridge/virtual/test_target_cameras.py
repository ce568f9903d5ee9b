"""Simulated cameras that detect targets: what they see, and a fleet that finds a rover by them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.errors import ConfigError
from agent.fleet.membership import is_absent
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from sim_bridge.companions.target_camera import CameraTable, SensedDetections, TargetCamera
from sim_bridge.virtual.fleet_lockstep import Fidelity, FleetLockstep
from sim_bridge.world.sim_table import sim_table

ROVER = 101
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
UPSIDE_DOWN = np.array([0.0, 1.0, 0.0, 0.0])
DURATION_S = 8.0


def looked(
    table: CameraTable, place_m: tuple[float, float, float], pictures: int, attitude: np.ndarray = LEVEL
) -> list[SensedDetections]:
    """What a camera at the origin sees of a body in some pictures, asked ten times as often as it looks."""
    camera, step_s = TargetCamera(table, np.random.default_rng(3)), 0.1 / table.rate_hz
    seen = [
        camera.look(k * step_s, np.zeros(3), attitude, [(ROVER, np.array(place_m))])
        for k in range(1, 10 * pictures + 1)
    ]
    return [each for each in seen if each is not None]


def test_a_camera_is_off_by_what_it_says() -> None:
    # GIVEN a body 50 m below and to the side
    place = np.array((10.0, 15.0, 45.0))
    away_m = float(np.linalg.norm(place))
    seen = looked(CameraTable(1, rate_hz=10.0, sigma_rad=0.02, distance_sigma_m=2.0), (10.0, 15.0, 45.0), 400)
    # THEN there is one detection a picture, whose errors are of the sizes told
    assert [each.time_s for each in seen] == pytest.approx(np.arange(1, 401) / 10.0)
    directions = np.array([each.detections[0].direction for each in seen])
    across = directions / np.linalg.norm(directions, axis=1)[:, None] - place / away_m
    assert np.sqrt((across**2).sum(axis=1).mean() / 2.0) == pytest.approx(0.02, rel=0.1)
    distances = np.array([each.detections[0].distance_m for each in seen])
    assert np.std(distances - away_m) == pytest.approx(2.0, rel=0.15)
    assert {each.detections[0].distance_sigma_m for each in seen} == {2.0}
    assert {each.detections[0].sigma_rad for each in seen} == {0.02}


@pytest.mark.parametrize(
    ("place_m", "attitude", "visible"),
    [
        ((0.0, 0.0, 39.0), LEVEL, True),
        ((0.0, 0.0, 41.0), LEVEL, False),  # beyond its reach
        ((0.0, 19.0, 20.0), LEVEL, True),
        ((0.0, 21.0, 20.0), LEVEL, False),  # beside its picture, which ends at 45 degrees
        ((0.0, 0.0, 20.0), UPSIDE_DOWN, False),
        ((0.0, 0.0, -20.0), UPSIDE_DOWN, True),
    ],
)
def test_a_camera_sees_what_is_below_its_vehicle(
    place_m: tuple[float, float, float], attitude: np.ndarray, visible: bool
) -> None:
    seen = looked(CameraTable(1, reach_m=40.0, view_rad=math.pi / 2), place_m, 3, attitude)
    assert len(seen) == 3 * visible
    assert all(each.detections[0].distance_m is None for each in seen)  # nothing was asked for


def document() -> dict[str, Any]:
    """Three drones over a rover that carries no UWB module; the first sees its distance, the second its direction."""
    circles = [
        {"agent": i, "kind": "circle", "center_m": [8.0 * i - 16.0, 0.0, -30.0 - 2.0 * i], "radius_m": 10.0,
         "lap_s": 30.0, "phase_rad": 2.1 * i}
        for i in (1, 2, 3)
    ]  # fmt: skip
    rover = {"agent": ROVER, "kind": "line", "start_m": [3.0, -4.0, 0.0], "velocity_mps": [0.5, 1.0, 0.0]}
    return {
        "fleet": {"name": "t", "period_s": 0.2, "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
        "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{14570 + i}"} for i in (1, 2, 3)],
        "targets": [{"id": ROVER, "motion": "moving"}],
        "sim": {
            "seed": 3,
            "ranged_targets": False,
            "cameras": [{"agent": 1, "distance_sigma_m": 2.0}, {"agent": 2, "rate_hz": 2.0}],
            "paths": [*circles, rover],
        },
        "security": {"mode": "unsigned"},
    }


@pytest.mark.parametrize("fidelity", ["values", "bytes"])
def test_a_fleet_finds_a_rover_that_nobody_ranges(fidelity: Fidelity) -> None:
    config, latest = config_from(document(), "test"), {}

    def on_estimate(agent: OnboardAgent, ready: EstimateReady) -> None:
        latest[agent.agent_id] = ready

    report = FleetLockstep(config, make_estimator, on_estimate, fidelity).run(DURATION_S)
    for agent_id, ready in latest.items():
        # THEN all three have it, within what they say
        estimate, place = ready.estimate, slice(18, 21)
        assert not is_absent(estimate.age_ticks)[3], agent_id
        unix_s = min(ready.t_s + config.fleet.epoch_unix_s, float(report.truth.time_unix_s[-1]))
        error = estimate.mean[place] - report.truth.at(unix_s).reshape(-1, 6)[3, :3]
        assert np.linalg.norm(error) < 1.5
        assert error @ np.linalg.solve(estimate.covariance[place, place], error) < 16.0
    assert report.counters[1]["detection: used"] == pytest.approx(5 * DURATION_S, abs=3)
    assert report.counters[2]["detection: used"] > DURATION_S
    assert not any("detection" in name for name in report.counters[3])


@pytest.mark.parametrize(
    ("agent", "found"), [(9, "sim.cameras of agent 9, agent: expected ids of agents"), (1, "a second one of 1")]
)
def test_a_camera_of_nobody_and_a_second_one_are_refused(agent: int, found: str) -> None:
    wrong = document()
    wrong["sim"]["cameras"].append({"agent": agent})
    with pytest.raises(ConfigError, match=found):
        sim_table(config_from(wrong, "test"))
