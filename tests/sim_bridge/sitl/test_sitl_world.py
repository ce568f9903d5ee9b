"""The bridge's world without sockets: vehicles' truths joined to tracks, ranges made of them, their record."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from agent.config.tables import FleetConfig
from sim_bridge.sitl.session import TimedTruth
from sim_bridge.sitl.world import SitlWorld, smoothed_position
from sim_bridge.world.truth import TruthError
from tests.support.sitl_fleet import fleet_config


def moving(time_s: float, agent: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """A figure of 5 m about a point of its own."""
    phase = 0.4 * time_s + agent
    position = (5.0 * math.cos(phase) + 10.0 * agent, 5.0 * math.sin(phase), -8.0)
    return position, (-2.0 * math.sin(phase), 2.0 * math.cos(phase), 0.0)


def flown(
    config: FleetConfig, until_s: float, silent: tuple[int, float] = (0, math.inf)
) -> tuple[SitlWorld, list[Any]]:
    world, taken = SitlWorld(config, unix_offset_s=1e6), []
    for step in range(round(until_s * 100)):
        now = 100.0 + 0.01 * step
        if step == 50:
            world.begin(now)
        for agent in config.ids:
            if step % 2 == 0 and not (agent == silent[0] and now >= silent[1]):
                position, velocity = moving(now, agent)
                quantised = (round(position[0] / 0.011) * 0.011, round(position[1] / 0.011) * 0.011, position[2])
                world.tracks[agent].put(TimedTruth(now, quantised, velocity, 0.0))
        taken += world.ranges(now)
    return world, taken


def test_ranges_have_the_true_distance_of_their_own_instant() -> None:
    config = fleet_config(sim={"seed": 5, "uwb_hz": 10.0})
    _, taken = flown(config, 8.0)
    assert len(taken) == pytest.approx(3 * 75, abs=3)
    errors = []
    for taken_s, ranges in taken:
        own, _ = moving(taken_s, ranges.observer)
        for measured in ranges.ranges:
            other, _ = moving(taken_s, measured.target)
            errors.append(measured.range_m - math.dist(own, other))
    # the paper's uniform noise of 0.1 m, the truth's own 11 mm steps, and nothing else
    assert max(map(abs, errors)) < 0.1 + 0.03
    assert np.std(errors) == pytest.approx(0.1 / math.sqrt(3.0), rel=0.1)


def test_a_silent_vehicle_is_neither_observer_nor_target() -> None:
    world, taken = flown(fleet_config(), 4.0, silent=(2, 102.0))
    late = [ranges for taken_s, ranges in taken if taken_s > 102.2]
    assert {ranges.observer for ranges in late} == {1, 3}
    assert {measured.target for ranges in late for measured in ranges.ranges} == {1, 3}
    assert world.stale_s == pytest.approx(1.9, abs=0.1)


def test_ranges_only_along_edges_and_within_reach() -> None:
    edges = {
        "name": "sitl",
        "origin": {"lat_deg": -35.0, "lon_deg": 149.0, "alt_m": 500.0},
        "edges": [[1, 2], [2, 3]],
    }
    _, taken = flown(fleet_config(fleet=edges), 2.0)
    assert {(ranges.observer, measured.target) for _, ranges in taken for measured in ranges.ranges} == {
        (1, 2), (2, 1), (2, 3), (3, 2)
    }  # fmt: skip
    _, taken = flown(fleet_config(sitl={"uwb_reach_m": 3.0}), 2.0)
    assert taken == []


def test_the_record_is_the_truth_in_position_and_velocity() -> None:
    world, _ = flown(fleet_config(), 6.0)
    assert world.start_s is not None
    assert world.start_s / 0.1 == pytest.approx(round(world.start_s / 0.1), abs=1e-6)
    truth = world.truth(106.0)
    assert truth.time_unix_s[0] == pytest.approx(1e6 + world.start_s)
    inside = truth.time_unix_s[30:-30]
    at = inside[:-1] + 0.007  # off the grid, where interpolation of 11 mm steps would show
    states = truth.at(at)
    for slot, agent in enumerate(truth.agents):
        expected = np.array([np.concatenate(moving(time_s - 1e6, agent)) for time_s in at])
        assert np.abs(states[:, slot, :3] - expected[:, :3]).max() < 0.01
        assert np.abs(states[:, slot, 3:] - expected[:, 3:]).max() < 0.1


def test_a_record_of_nothing_is_refused() -> None:
    world = SitlWorld(fleet_config(), 0.0)
    with pytest.raises(TruthError, match="begun"):
        world.truth(1.0)


def test_smoothing_changes_nothing_that_is_exact() -> None:
    time_s = np.sort(np.random.default_rng(1).uniform(0.0, 4.0, 200))
    velocity = np.tile((1.0, -2.0, 0.5), (200, 1))
    position = time_s[:, None] * velocity
    np.testing.assert_allclose(smoothed_position(time_s, position, velocity), position, atol=1e-12)
