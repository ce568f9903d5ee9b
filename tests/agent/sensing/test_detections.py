"""Detections of a camera: to sightings in NED, and a fleet that finds a rover with nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.fleet.membership import is_absent
from agent.onboard import OnboardAgent
from agent.sensing.detections import LEAST_SIGMA_RAD, DetectionAdapter, DetectionSample, ned_direction
from agent.sensing.samples import AttitudeSample, ImuSample
from agent.sensing.timeline import Orientation
from tests.support.circling_fleet import CirclingFleet, position_of
from tests.support.onboard import onboard_of
from transport.messages.detection_body import Detection, DetectionFrame, Frame, encode_detections

ROVER = 101
SIGMA_RAD, SIGMA_M = 0.01, 0.5


def config() -> FleetConfig:
    return config_from(
        {
            "fleet": {"name": "eyes", "period_s": 0.1, "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 0.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{24760 + i}"} for i in (1, 2, 3)],
            "targets": [{"id": ROVER}],
            "security": {"mode": "unsigned"},
        },
        "test",
    )


def payload(seq: int, detections: tuple[Detection, ...], observer: int = 1, axes: Frame = "ned") -> bytes:
    return encode_detections(DetectionFrame(seq, "none", 0, detections, observer, axes))


def test_what_is_no_target_is_left_out_and_no_direction_is_surer_than_an_attitude() -> None:
    adapter = DetectionAdapter(1, {ROVER})
    seen = Detection(ROVER, (0.0, 3.0, 4.0), 1e-5), Detection(2, (1.0, 0.0, 0.0), 0.1)
    ahead = Detection(ROVER, (1.0, 0.0, 0.0), 0.1, offset_s=0.5)
    (sample,) = adapter.receive(payload(1, (*seen, ahead)), now_s=10.0, host_s=10.0, unix_s=1e9)
    assert (sample.t_s, sample.target, sample.distance_m) == (10.0, ROVER, None)
    assert sample.direction == pytest.approx((0.0, 0.6, 0.8))
    assert sample.sigma_rad == LEAST_SIGMA_RAD
    assert adapter.skipped == {"not a target": 1, "wrong time": 1}


EAST = math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)
"""Attitude of a level drone that looks east."""


def test_a_direction_in_body_axes_is_turned_by_the_attitude() -> None:
    sample = DetectionSample(10.0, ROVER, "body", (0.6, 0.0, 0.8), SIGMA_RAD, None, None)
    assert ned_direction(sample, Orientation(EAST, (0.0, 0.0, 0.0))) == pytest.approx((0.0, 0.6, 0.8))
    assert ned_direction(replace(sample, axes="ned"), None) == (0.6, 0.0, 0.8)
    assert ned_direction(sample, None) is None


@pytest.mark.parametrize("attitude", [True, False])
def test_a_detection_in_body_axes_needs_an_attitude_of_its_instant(attitude: bool) -> None:
    agent = onboard_of(config())
    for t_s in np.arange(9.9, 10.1, 0.01).tolist():
        agent.on_sample(ImuSample(t_s, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)), t_s)
        if attitude:
            agent.on_sample(AttitudeSample(t_s, EAST), t_s)
    seen = Detection(ROVER, (0.6, 0.0, 0.8), SIGMA_RAD, 50.0, 2.0)
    agent.on_uwb(payload(1, (seen,), axes="body"), 10.1)
    counters = agent.core.counters
    assert counters["detection: used"] == int(attitude)
    assert counters["detection: attitude unknown"] == int(not attitude)


def test_a_bearing_of_a_target_that_nobody_has_found_is_of_no_use() -> None:
    agent = onboard_of(config())
    agent.on_uwb(payload(1, (Detection(ROVER, (0.6, 0.0, 0.8), SIGMA_RAD),)), 10.1)
    assert agent.core.counters["detection: bearing of a target not found"] == 1


class SeeingFleet(CirclingFleet):
    """Drone 1 sees a rover with its distance, drone 2 its direction alone; drone 3 sees nothing."""

    rover_m, rover_mps = np.array([20.0, -10.0, 0.0]), np.array([0.5, 1.0, 0.0])

    def rover_at(self, t_s: float) -> np.ndarray:
        return np.asarray(self.rover_m + (t_s - self.start_s) * self.rover_mps)

    def _sense_one(self, agent_id: int, agent: OnboardAgent, t_s: float, step: int) -> None:
        super()._sense_one(agent_id, agent, t_s, step)
        if step % 20 != 9 or agent_id == 3:
            return
        away = self.rover_at(t_s) - position_of(agent_id, t_s)[0]
        distance_m = float(np.linalg.norm(away))
        direction = away / distance_m + SIGMA_RAD * self.rng.normal(size=3)
        seen_m = (distance_m + SIGMA_M * float(self.rng.normal()), SIGMA_M) if agent_id == 1 else (None, None)
        north, east, down = direction.tolist()
        detection = Detection(ROVER, (north, east, down), SIGMA_RAD, *seen_m)
        agent.on_uwb(payload(step, (detection,), agent_id), t_s)


def test_a_fleet_finds_a_rover_that_two_cameras_see_without_any_ranges_to_it() -> None:
    # WHEN it has been seen for some seconds
    fleet = SeeingFleet(config())
    fleet.run(8.0)
    for agent_id in (1, 2, 3):
        # THEN every drone has it, also the one that sees nothing, within what it says
        ready = fleet.estimates[agent_id][-1]
        estimate, slot = ready.estimate, 3
        assert not is_absent(estimate.age_ticks)[slot]
        place = slice(6 * slot, 6 * slot + 3)
        error = estimate.mean[place] - fleet.rover_at(ready.t_s)
        covariance = estimate.covariance[place, place]
        assert np.linalg.norm(error) < 0.6
        assert error @ np.linalg.solve(covariance, error) < 16.0
        assert np.sqrt(covariance.diagonal().max()) < 0.5
        assert np.linalg.norm(estimate.mean[6 * slot + 3 : 6 * slot + 6] - fleet.rover_mps) < 0.5
    # and the drones themselves are where they are
    assert fleet.cores[2].counters["detection: used"] > 40
    assert all(fleet.own_error_m(i, skip=50).max() < 0.5 for i in (1, 2, 3))
