"""Drones that turn, with antennas off their IMUs: as good as with antennas at them."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.config.reading import config_from
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import block
from sim_bridge.virtual.fleet_lockstep import FleetLockstep

BLIND, BLIND_FROM_S, DURATION_S, SETTLED_S = 4, 8.0, 16.0, 9.0


class Flight:
    """Four drones that all range each other and turn at 0.5 rad/s, the last one without GPS in the end."""

    def __init__(self, arms: dict[str, Any], seed: int = 1) -> None:
        document: dict[str, Any] = {
            "fleet": {"name": "levers", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
            "agents": [{"id": i, "mavlink": f"udpin:127.0.0.1:{14560 + i}", **arms} for i in range(1, 5)],
            "sensors": {
                "gps_speed": "norm",
                "gps_position_half_width_m": 0.15,
                "gps_speed_half_width_mps": 0.08,
                "uwb_bound_m": 0.1,
                "accel_sigma_mps2": 0.0577,
                "gps_latency_s": 0.0,
                "imu_latency_s": 0.0,
            },
            "sim": {
                "seed": seed,
                "yaw_rate_radps": 0.5,
                "gps_outages": [{"agent": BLIND, "from_s": BLIND_FROM_S, "to_s": 1000.0}],
            },
            "security": {"mode": "unsigned"},
        }
        config = config_from(document, "test")
        self._ready: list[tuple[int, EstimateReady]] = []
        self.report = FleetLockstep(config, make_estimator, self._on_estimate, "values").run(DURATION_S)
        errors: dict[bool, list[float]] = {True: [], False: []}
        squares: list[float] = []
        for agent_id, ready in self._ready:
            unix_s = ready.t_s + config.fleet.epoch_unix_s
            if unix_s < self.report.start_unix_s + SETTLED_S or ready.estimate.status is Status.NO_DATA:
                continue
            truth = self.report.truth.at(min(unix_s, self.report.truth.time_unix_s[-1]))
            at = block(agent_id - 1)
            error = ready.estimate.mean - truth.ravel()
            errors[agent_id == BLIND].append(float(error[at][:3] @ error[at][:3]))
            squares.append(float(error[at] @ np.linalg.solve(ready.estimate.covariance[at, at], error[at])) / 6)
        self.located_m, self.blind_m = (float(np.sqrt(np.mean(errors[blind]))) for blind in (False, True))
        self.anees = float(np.mean(squares))

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self._ready.append((agent.agent_id, ready))


def test_lever_arms_of_gps_and_uwb_cost_nothing_once_they_are_known() -> None:
    # GIVEN antennas 0.3 m off the IMU, the GPS speed a norm, as of the paper
    flight = Flight({"gps_antennas_m": [[0.3, 0.0, 0.0]], "uwb_tags_m": [[0.0, 0.3, 0.0], [0.0, -0.3, -0.1]]})
    # THEN located drones, the blind one and the covariances are as good as without arms
    assert flight.located_m <= 0.06
    assert flight.blind_m <= 0.3
    assert 0.3 <= flight.anees <= 1.5
    # AND every range was turned
    assert all(not counters.get("range: attitude unknown", 0) for counters in flight.report.counters.values())
